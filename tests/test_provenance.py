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
from mvest.provenance import (
    canonical_json,
    config_hash,
    git_state,
    provenance,
    require_sealed,
    sealed,
    write_json,
)


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


def test_a_clean_checkout_is_named_by_its_commit(checkout: Path) -> None:
    assert git_state(checkout) == {"sha": git(checkout, "rev-parse", "HEAD"), "dirty": False}


def test_results_are_written_by_runs_and_do_not_make_them_dirty(checkout: Path) -> None:
    for name in ("results", "code"):
        (checkout / name).mkdir()
        (checkout / name / "kept.txt").write_text("one")
    git(checkout, "add", ".")
    git(checkout, "commit", "-qm", "more")
    (checkout / "results" / "kept.txt").write_text("two")
    assert git_state(checkout / "code")["dirty"] is False
    (checkout / "code" / "kept.txt").write_text("two")
    assert git_state(checkout / "results")["dirty"] is True


def test_a_changed_tracked_file_is_dirty_and_an_untracked_one_is_not(checkout: Path) -> None:
    (checkout / "output.txt").write_text("left behind by a run\n")
    assert git_state(checkout)["dirty"] is False
    (checkout / "file.txt").write_text("two\n")
    assert git_state(checkout)["dirty"] is True


def test_outside_a_checkout_there_is_no_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert git_state(tmp_path) == {"sha": None, "dirty": None}
    assert git_state(tmp_path / "absent") == {"sha": None, "dirty": None}


def test_packages_installed_within_a_checkout_are_not_of_its_commit(checkout: Path) -> None:
    (checkout / "env").mkdir()
    (checkout / "env" / "module.py").write_text("")
    assert git_state(checkout / "env") == {"sha": None, "dirty": None}


def test_without_git_there_is_no_commit(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert git_state(checkout) == {"sha": None, "dirty": None}


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


def test_the_hash_does_not_depend_on_order_or_container() -> None:
    one = {"b": [1, 2.5], "a": {"y": True, "x": None}}
    other = {"a": {"x": None, "y": True}, "b": (np.int64(1), np.float64(2.5))}
    assert canonical_json(one) == canonical_json(other) == '{"a":{"x":null,"y":true},"b":[1,2.5]}'
    assert config_hash(one) == config_hash(other)


def test_the_hash_is_sha256_of_the_text() -> None:
    # printf '{"a":1}' | sha256sum
    expected = "015abd7f5cc57a2dd94b7590f04ad8084273905ee33ec5cebeae62276a97f862"
    assert config_hash({"a": 1}) == expected


@pytest.mark.parametrize("other", [{"a": 2}, {"A": 1}, {"a": 1.0}, {"a": "1"}, {"a": [1]}, {}])
def test_any_difference_changes_the_hash(other: dict[str, object]) -> None:
    assert config_hash(other) != config_hash({"a": 1})


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"a": {"b": [1.0, float("nan")]}}, r"value\.a\.b\[1\] is nan"),
        ({"a": np.array([np.inf])}, r"value\.a\[0\] is inf"),
        ({"a": {1, 2}}, r"value\.a is a set"),
        ({"a": {3: 1}}, r"value\.a has the key 3"),
    ],
)
def test_what_has_no_json_form_is_named(value: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        canonical_json(value)


def test_a_written_file_reads_back_and_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text("old")
    write_json(path, {"σ": np.array([1.5, 2.0]), "path": Path("a") / "b", "n": 3})
    assert json.loads(path.read_text(encoding="utf-8")) == {"σ": [1.5, 2.0], "path": "a/b", "n": 3}
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.json"]


def test_data_without_a_json_form_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    write_json(path, {"run": 1})
    with pytest.raises(InputError, match="nan"):
        write_json(path, {"run": float("nan")})
    assert json.loads(path.read_text()) == {"run": 1}


def test_sealed_data_are_known_again_and_every_change_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    # Half of a surrogate pair is written as a ?.
    data = {"x": np.array([0.1, 1e-300]), "n": 1, "words": "σ \ud800", "none": None}
    write_json(path, sealed(data))
    read = json.loads(path.read_text(encoding="utf-8"))
    require_sealed(read, "it")
    assert sealed(read) == read
    changes = [{"x": [0.1, 0.0]}, {"n": 1.0}, {"words": "s"}, {"more": 1}, {"sha256": "0" * 64}]
    others = [read | change for change in changes]
    others += [{k: v for k, v in read.items() if k != name} for name in ("none", "sha256")]
    for other in others:
        with pytest.raises(InputError, match="it: its content is not what was written"):
            require_sealed(other, "it")
