"""Entries of a cache: made once, complete, and made again if they are damaged."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mvest.cache import Entry, code_digest, content_digest, get_or_make, source_key
from mvest.errors import InputError


def read(path: Path) -> str:
    return (path / "text").read_text() if path.is_dir() else json.loads(path.read_text())


def write(path: Path, value: object) -> None:
    path.write_text(json.dumps(value))


def write_folder(path: Path, value: str) -> None:
    path.mkdir()
    (path / "text").write_text(value)


def made(value):
    """A function that makes a value and counts its calls."""

    def make():
        make.calls += 1
        return value

    make.calls = 0
    return make


@pytest.mark.parametrize("how", [write, write_folder])
def test_a_cached_value_is_made_once_and_always_read_back(tmp_path, how):
    make = made("a")
    for _ in range(3):
        assert Entry(tmp_path / "below" / "entry", read).get_or_make(make, how) == "a"
    assert make.calls == 1
    assert Entry(tmp_path / "other", read).get_or_make(made((1, 2)), write) == [1, 2]


def test_a_value_that_is_not_to_be_cached_is_made_again(tmp_path):
    make, entry = made("a"), Entry(tmp_path / "entry", read)
    for _ in range(2):
        assert entry.get_or_make(make, write, lambda value: value != "a") == "a"
    assert make.calls == 2
    assert entry.found() is None


def unreadable(entry):
    inner = entry.path / "text" if entry.path.is_dir() else entry.path
    inner.write_bytes(b"\xff")


def other_numbers(entry):
    write(entry.path, "b")


def taken_from_another(entry):
    other = Entry(entry.path.with_name("other"), read)
    other.keep("b", write)
    other.path.replace(entry.path)
    entry.path.with_name(".other.sha256").replace(entry.path.with_name(".entry.sha256"))


@pytest.mark.parametrize(
    ("how", "harm"),
    [
        (write, unreadable),
        (write_folder, unreadable),
        (write, other_numbers),
        (write, taken_from_another),
    ],
)
def test_an_entry_that_is_not_as_it_was_written_is_made_again(tmp_path, how, harm, capsys):
    make, entry = made("a"), Entry(tmp_path / "entry", read)
    entry.get_or_make(make, how)
    harm(entry)
    assert entry.found() is None
    assert entry.get_or_make(make, how) == "a"
    assert make.calls == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"note: {entry.path} is damaged and is made again"
    assert entry.found() == "a"


def test_an_interruption_leaves_no_entry_and_lets_the_next_one_in(tmp_path):
    def interrupted(path, _value):
        path.write_text("half")
        raise KeyboardInterrupt

    entry = Entry(tmp_path / "entry", read)
    with pytest.raises(KeyboardInterrupt):
        entry.get_or_make(made("a"), interrupted)
    assert entry.get_or_make(made("a"), write) == "a"
    (tmp_path / ".part-killed-entry").touch()
    entry.path.unlink()
    entry.get_or_make(made("a"), write)
    assert {path.name for path in tmp_path.iterdir()} == {
        "entry", ".entry.lock", ".entry.sha256"
    }  # fmt: skip


def test_missing_entries_are_made_together_and_each_is_stored_at_once(tmp_path):
    entries = [Entry(tmp_path / str(k), read) for k in range(4)]
    entries[1].keep("old", write)
    asked = []

    def make(missing):
        asked.append(missing)
        for k in missing:
            if k == 3:
                assert entries[2].found() == 2
                raise KeyboardInterrupt
            yield k

    with pytest.raises(KeyboardInterrupt):
        get_or_make(entries, make, write)
    assert get_or_make(entries, lambda missing: [10 * k for k in missing], write) == [
        0, "old", 2, 30,
    ]  # fmt: skip
    assert asked == [[0, 2, 3]]


MAKER = """
import sys, time
from pathlib import Path
from mvest.cache import Entry

folder, name = Path(sys.argv[1]), sys.argv[2]

def write(path, value):
    path.write_text(value)
    (folder / f"{name} writes").touch()
    if name == "killed":
        time.sleep(60)

print(Entry(folder / "entry", Path.read_text).get_or_make(lambda: name, write))
"""


def test_after_a_process_was_killed_while_it_wrote_one_of_those_that_wait_makes_the_entry(tmp_path):
    def start(name):
        command = [sys.executable, "-c", MAKER, str(tmp_path), name]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    first = start("killed")
    while not (tmp_path / "killed writes").exists():
        assert first.poll() is None
        time.sleep(0.01)
    others = [start(name) for name in ("second", "third")]
    time.sleep(0.2)
    assert not (tmp_path / "entry").exists()
    first.kill()
    first.communicate()
    said = {other.communicate(timeout=30)[0].strip() for other in others}
    assert len(said) == 1
    assert said <= {"second", "third"}
    assert {path.name for path in tmp_path.iterdir()} == {
        "entry", ".entry.lock", ".entry.sha256", "killed writes", f"{said.pop()} writes",
    }  # fmt: skip


# -- keys of code ---------------------------------------------------------------------------------


@pytest.mark.parametrize("change", ["edit", "rename", "add", "data"])
def test_every_change_of_code_changes_its_digest(tmp_path, change):
    place = tmp_path / "package" / "units.py"
    place.parent.mkdir()
    place.write_text("SCALE = 2.0")
    before = code_digest(tmp_path)
    {
        "edit": lambda: place.write_text("SCALE = 3.0"),
        "rename": lambda: place.rename(place.with_name("other.py")),
        "add": lambda: place.with_name("another.py").touch(),
        "data": lambda: place.with_name("table.csv").touch(),
    }[change]()
    # A process keeps the code that it has loaded.
    assert code_digest(tmp_path) == before
    code_digest.cache_clear()
    assert (code_digest(tmp_path) == before) is (change == "data")


def test_a_key_covers_mvest_and_the_packages_given():
    assert source_key("mvest") == source_key()
    assert source_key("experiments") == source_key("experiments", "mvest")
    assert source_key("experiments") != source_key()


def test_a_digest_tells_values_apart_and_nothing_else():
    a = np.arange(6.0)
    values = [a, a.reshape(2, 3), a.astype(np.float32), list(a), ("ab", ""), ("a", "b")]
    values += [{"a": 1}, {"a": 1.0}, {"b": 1}, None, True, "True"]
    assert len({content_digest(v) for v in values}) == len(values)
    assert content_digest(a) == content_digest(a.copy())
    assert content_digest({"a": 1, "b": 2}) == content_digest({"b": 2, "a": 1})
    assert content_digest(np.float64(1.5)) == content_digest(1.5)
    with pytest.raises(InputError, match="no digest of a function"):
        content_digest(content_digest)
