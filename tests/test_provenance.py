"""Provenance of results: commit, hash of the configuration, files that are whole or absent."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mvest import provenance as module
from mvest.errors import InputError
from mvest.provenance import config_hash, git_state, provenance, require_sealed, sealed, write_json


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=mvest developers", "-c", "user.email=mvest@example.org"]
    return subprocess.run(
        ["git", "-C", str(folder), *identity, *arguments],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()


@pytest.fixture(autouse=True)
def _no_outer_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    # A git hook that runs the tests hands its own repository down; these must not touch it.
    for name in [name for name in os.environ if name.startswith("GIT_")]:
        monkeypatch.delenv(name)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    git(tmp_path, "init", "--quiet")
    (tmp_path / "file.txt").write_text("one\n")
    git(tmp_path, "add", "file.txt")
    git(tmp_path, "commit", "--quiet", "--no-verify", "--message", "Begin")
    return tmp_path


def test_a_checkout_is_named_by_its_commit_and_dirty_if_code_was_changed(checkout: Path) -> None:
    for name in ("results", "code"):
        (checkout / name).mkdir()
        (checkout / name / "kept.txt").write_text("one")
    git(checkout, "add", ".")
    git(checkout, "commit", "-qm", "more")
    (checkout / "output.txt").write_text("an untracked file")
    # Runs write to the results.
    (checkout / "results" / "kept.txt").write_text("two")
    sha = git(checkout, "rev-parse", "HEAD")
    assert git_state(checkout / "code") == {"sha": sha, "dirty": False}
    (checkout / "code" / "kept.txt").write_text("two")
    assert git_state(checkout / "results") == {"sha": sha, "dirty": True}


def test_without_git_a_checkout_or_tracked_files_there_is_no_commit(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = {"sha": None, "dirty": None}
    assert git_state(checkout / "absent") == nothing
    # Packages may be installed within somebody's checkout.
    (checkout / "env").mkdir()
    (checkout / "env" / "module.py").write_text("")
    assert git_state(checkout / "env") == nothing
    monkeypatch.setenv("PATH", "")
    assert git_state(checkout) == nothing


def test_provenance_is_plain_data_with_versions_and_threads(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    monkeypatch.setattr(module, "KEY_PACKAGES", ("numpy", "no-such-distribution"))
    record = provenance(checkout)
    assert record["versions"] == {"numpy": np.__version__, "no-such-distribution": None}
    assert record["threads"]["OMP_NUM_THREADS"] == "1"
    assert record["threads"]["MKL_NUM_THREADS"] is None
    assert record["git"]["sha"] == git(checkout, "rev-parse", "HEAD")
    assert json.loads(json.dumps(record)) == record


def test_the_hash_is_that_of_the_content() -> None:
    one = {"b": [1, 2.5], "a": {"y": True, "x": None}}
    other = {"a": {"x": None, "y": True}, "b": (np.int64(1), np.float64(2.5))}
    assert config_hash(one) == config_hash(other)
    # printf '{"a":1}' | sha256sum
    expected = "015abd7f5cc57a2dd94b7590f04ad8084273905ee33ec5cebeae62276a97f862"
    assert config_hash({"a": 1}) == expected
    for changed in ({"a": 2}, {"A": 1}, {"a": 1.0}, {"a": "1"}, {"a": [1]}, {}):
        assert config_hash(changed) != expected


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"a": {"b": [1.0, float("nan")]}}, r"value\.a\.b\[1\] is nan"),
        ({"a": {1, 2}}, r"value\.a is a set"),
    ],
)
def test_what_has_no_json_form_is_named(value: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        config_hash(value)


def test_sealed_data_are_known_again_and_every_change_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    # Half of a surrogate pair is written as a ?.
    data = {"x": np.array([0.1, 1e-300]), "n": 1, "words": "σ \ud800", "none": None}
    write_json(path, sealed(data))
    read = json.loads(path.read_text(encoding="utf-8"))
    require_sealed(read, "it")
    assert sealed(read) == read
    others = [read | change for change in ({"x": [0.1, 0.0]}, {"n": 1.0}, {"more": 1})]
    others += [{k: v for k, v in read.items() if k != name} for name in ("none", "sha256")]
    for other in others:
        with pytest.raises(InputError, match="it: its content is not what was written"):
            require_sealed(other, "it")
