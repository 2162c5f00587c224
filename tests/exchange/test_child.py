"""The process in which files of others are read: what crosses, and what it survives."""

import os
from pathlib import Path

import numpy as np
import pytest

from mvest.errors import ConfigurationError, GeometryError, InputError
from mvest.exchange.child import in_child

HERE = Path(__file__)


def echo(path, *arguments):
    arrays = {"whole": np.arange(6, dtype=np.int16).reshape(2, 3), "none": np.zeros((0, 3))}
    return {"name": path.name, "given": arguments, "arrays": [arrays, {"flag": np.bool_(True)}]}


def process(path):
    return os.getpid()


def raises(path, kind):
    kinds = {"Geometry": GeometryError(f"{path}: torn\napart"), "Value": ValueError("odd")}
    raise {**kinds, "Import": ModuleNotFoundError("No module named 'x'")}[kind]


def ends(path, how):
    if how == "abort":
        os.abort()
    while how == "spin":
        pass
    return np.ones(2**31).sum()


def prints(path):
    print("noise")
    os.write(1, b"more noise")
    return 7


def test_a_tree_of_arrays_comes_back():
    found = in_child(echo, HERE, 1, "two", [3.5, None])
    assert (found["name"], found["given"]) == (HERE.name, [1, "two", [3.5, None]])
    arrays, others = found["arrays"]
    np.testing.assert_array_equal(arrays["whole"], [[0, 1, 2], [3, 4, 5]])
    assert (arrays["whole"].dtype, arrays["none"].shape) == (np.int16, (0, 3))
    assert others == {"flag": True}


def test_one_child_serves_all_and_what_it_prints_is_lost():
    first = in_child(process, HERE)
    assert first != os.getpid()
    assert in_child(prints, HERE) == 7
    assert in_child(process, HERE) == first


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        ("Geometry", GeometryError, "torn apart"),
        ("Value", InputError, "damaged: odd"),
        ("Import", ConfigurationError, "No module named 'x'; pip install 'mvest[files]' has it"),
    ],
)
def test_errors_cross_with_their_kind_and_the_name_of_the_file(kind, error, message):
    child = in_child(process, HERE)
    with pytest.raises(error) as raised:
        in_child(raises, HERE, kind)
    assert str(raised.value) == f"{HERE}: {message}"
    assert in_child(process, HERE) == child


@pytest.mark.parametrize(
    ("how", "limits", "message"),
    [
        ("abort", {}, "killed by signal 6"),
        ("spin", {"seconds": 0.5}, "more than 0.5 s"),
        ("fill", {"memory_gb": 0.5}, "more than 0.5 GiB"),
    ],
)
def test_what_ends_the_child_is_one_line_and_the_next_file_is_read(how, limits, message):
    with pytest.raises(InputError, match=message) as raised:
        in_child(ends, HERE, how, **limits)
    assert str(raised.value).startswith(f"{HERE}: ")
    assert "\n" not in str(raised.value)
    assert in_child(prints, HERE) == 7


def test_a_forked_process_has_a_child_of_its_own(tmp_path):
    own = in_child(process, HERE)
    pid = os.fork()
    if pid == 0:
        (tmp_path / "answer").write_text(str(in_child(process, HERE)))
        os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0
    assert int((tmp_path / "answer").read_text()) != own
    assert in_child(process, HERE) == own
