"""Files and folders are there whole, or as they were before."""

import os
from pathlib import Path

import pytest

import mvest.files
from mvest.errors import InputError
from mvest.files import remove_parts, sha256_of, write_atomically


@pytest.mark.parametrize("sync", [False, True])
@pytest.mark.parametrize(
    "content",
    ["\u00e5b\n", "\u00e5b\n".encode(), lambda part: part.write_bytes("\u00e5b\n".encode())],
)
def test_text_bytes_and_what_a_function_writes_take_the_name(tmp_path, content, sync):
    path = tmp_path / "table.seq.csv"
    path.write_text("before")
    assert write_atomically(str(path), content, sync=sync) == path
    assert path.read_bytes() == b"\xc3\xa5b\n"
    assert list(tmp_path.iterdir()) == [path]
    (tmp_path / "other").touch()
    assert path.stat().st_mode == (tmp_path / "other").stat().st_mode


def test_a_folder_takes_the_place_of_the_one_before_it(tmp_path):
    folder = tmp_path / "case.d"
    folder.mkdir()
    (folder / "old").touch()

    def fill(part: Path) -> None:
        # A hidden name with the same ending.
        assert part.name.startswith(".part-")
        assert part.name.endswith("-case.d")
        part.mkdir()
        (part / "new").touch()
        assert (folder / "old").exists()

    write_atomically(folder, fill)
    assert [path.name for path in folder.iterdir()] == ["new"]
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_an_interruption_leaves_what_was_there(tmp_path, kind):
    path = tmp_path / "result"
    path.write_text("before")

    def fill(part: Path) -> None:
        if kind == "folder":
            part.mkdir()
            part = part / "one"
        part.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fill)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_is_on_the_disk_before_it_takes_its_name_where_that_is_asked_for(
    tmp_path, monkeypatch
):
    path, synced = tmp_path / "result", []
    monkeypatch.setattr(os, "fsync", lambda _descriptor: synced.append(path.exists()))
    write_atomically(path, "a")
    assert synced == []
    path.unlink()
    write_atomically(path, "a", sync=True)
    assert synced == [False]


def test_leftovers_are_taken_away_and_nothing_else(tmp_path):
    for name in ("a.npz", ".part-01-a.npz", ".part-02-b.npz", ".part-03-aa.npz", ".lock"):
        (tmp_path / name).touch()
    (tmp_path / ".part-04-a.npz").mkdir()
    (tmp_path / ".part-04-a.npz" / "half").touch()
    remove_parts(tmp_path, "a.npz")
    left = {"a.npz", ".part-02-b.npz", ".part-03-aa.npz", ".lock"}
    assert {path.name for path in tmp_path.iterdir()} == left
    remove_parts(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"a.npz", ".lock"}
    remove_parts(tmp_path / "absent")


def test_an_old_file_is_read_once_until_it_changes(tmp_path, monkeypatch):
    file, reads = tmp_path / "volume.nrrd", []
    file.write_bytes(b"abc")
    true = mvest.files._digest
    monkeypatch.setattr(mvest.files, "_digest", lambda path: (reads.append(path), true(path))[1])
    monkeypatch.setattr(mvest.files, "SETTLED_NS", 0)
    # NIST's example for SHA-256.
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert sha256_of(file) == sha256_of(file) == known
    assert len(reads) == 1
    about = file.stat()
    file.write_bytes(b"abd")
    os.utime(file, ns=(about.st_atime_ns, about.st_mtime_ns))
    assert sha256_of(file) != known
    monkeypatch.setattr(mvest.files, "SETTLED_NS", 10**12)
    reads.clear()
    assert sha256_of(file) == sha256_of(file)
    assert len(reads) == 2


def test_of_a_folder_names_contents_and_what_links_lead_to_count(tmp_path):
    folder = tmp_path / "case"
    (folder / "frames").mkdir(parents=True)
    (folder / "frames" / "a").write_text("1")
    seen = [sha256_of(folder)]

    def changed() -> bool:
        seen.append(sha256_of(folder))
        return seen[-1] not in seen[:-1]

    (folder / "frames" / "a").write_text("2")
    assert changed()
    (folder / "frames" / "a").rename(folder / "frames" / "b")
    assert changed()
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "x").write_text("1")
    (folder / "link").symlink_to(tmp_path / "one")
    assert changed()
    (tmp_path / "one" / "x").write_text("2")
    assert changed()
    # One that leads back ends.
    (folder / "loop").symlink_to(folder)
    assert sha256_of(folder) == seen[-1]


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", "nothing"):
        with pytest.raises(InputError, match=f"cannot read .*{name}"):
            sha256_of(tmp_path / name)
