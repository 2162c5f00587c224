"""Arrays of others: stated sizes against the file's, and every damage one line."""

import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.reading import npz
from mvest.reading.npz import read_npz


def npy(descr="'<f8'", shape="(2,)", data=bytes(16), version=b"\x01\x00"):
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    header += " " * (-(len(header) + 11) % 64) + "\n"
    return b"\x93NUMPY" + version + len(header).to_bytes(2, "little") + header.encode() + data


def packed(path, content, method=zipfile.ZIP_STORED, names=("a.npy",)):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name in names:
            archive.writestr(name, content)
    return path


def test_arrays_are_those_that_were_written(tmp_path):
    wanted = {
        "real": np.arange(6.0).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "other": np.arange(3, dtype=">i4"),
        "words": np.array(["ab", "é\U0001f600", ""]),
        "flags": np.array(True),
        "none": np.zeros((0, 5, 3)),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **wanted)
        found = read_npz(tmp_path / "a.npz")
        assert list(found) == list(wanted)
        for name, array in wanted.items():
            np.testing.assert_array_equal(found[name], array)
            assert found[name].dtype == array.dtype.newbyteorder("=")
    assert list(read_npz(tmp_path / "a.npz", ["words", "real"])) == ["words", "real"]
    found["real"][0, 0] = 7.0


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (npy(shape="(1000000000000,)"), "cannot be read"),
        (npy("'|O'"), "plain arrays"),
        (npy("'<U0'", "(1000000000000,)", b""), "plain array"),
        (npy("'<U2'", "(1,)", b"\xff" * 8), "no Unicode"),
        (npy(descr="(" * 3000), "cannot be read"),
        (b"", "plain array"),
    ],
)
def test_what_no_array_can_be_is_one_line_that_names_it(tmp_path, content, words):
    path = packed(tmp_path / "a.npz", content)
    with pytest.raises(InputError, match=words) as caught:
        read_npz(path)
    said = str(caught.value)
    assert said.startswith(str(path))
    assert said.isprintable()
    assert len(said) - len(str(path)) <= 250


def wrong_checksum(path):
    content = bytearray(packed(path, npy()).read_bytes())
    content[content.index(b"PK\x01\x02") - 1] ^= 1
    path.write_bytes(content)


def cut_off(path):
    path.write_bytes(packed(path, npy()).read_bytes()[:-30])


@pytest.mark.parametrize(
    "make",
    [wrong_checksum, cut_off, Path.mkdir, lambda _: None],
)
def test_a_damaged_archive_is_one_line(tmp_path, make):
    path = tmp_path / "a.npz"
    make(path)
    with pytest.raises(InputError) as caught:
        read_npz(path)
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).isprintable()


def test_a_small_file_makes_no_large_array(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "MAX_BYTES", 10**6)
    content = npy(shape="(4000000,)", data=bytes(32_000_000))
    path = packed(tmp_path / "a.npz", content, zipfile.ZIP_DEFLATED)
    tracemalloc.start()
    with pytest.raises(InputError, match="bytes of arrays, expected at most"):
        read_npz(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 10**6
    # What is not asked for is not made either.
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("b.npy", npy())
    assert read_npz(path, ["b"])["b"].tolist() == [0, 0]


def test_arrays_that_are_missing_or_too_many_are_named(tmp_path):
    path = packed(tmp_path / "a.npz", npy(), names=("a.npy", "b.npy"))
    with pytest.raises(InputError, match="arrays c are missing"):
        read_npz(path, ["a", "c"])
    with pytest.raises(InputError, match="holds arrays b in addition"):
        read_npz(path, ["a"], exact=True)
