"""Programs end with the process that started them, with all their children."""

import ast
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mvest.processes import run
from tests.places import ROOT
from tests.processes import alive, gone, linux, until

MAY_START = {"mvest/processes.py", "mvest/provenance.py"}
"""The second asks git for seconds at most, and computes nothing."""
STARTERS = {"joblib", "loky", "multiprocessing"}
CALLS = {"Popen", "run", "check_call", "check_output", "call", "fork", "posix_spawn", "system"}
"""Modules, and functions of `os` and `subprocess`, that start processes."""


def starts(tree: ast.AST) -> bool:
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Attribute(value=ast.Name(id="subprocess" | "os"), attr=name)):
                if name in CALLS:
                    return True
            case ast.Import(names=names) if {n.name.split(".")[0] for n in names} & STARTERS:
                return True
            case ast.ImportFrom(module=str(module)) if module.split(".")[0] in STARTERS:
                # Ending a pool is no start of one.
                if [name.name for name in node.names] != ["get_reusable_executor"]:
                    return True
    return False


def test_one_module_starts_all_processes():
    places = [*(ROOT / "mvest").rglob("*.py"), *(ROOT / "experiments").rglob("*.py")]
    texts = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in places}
    words = re.compile(r"subprocess|os\.|" + "|".join(STARTERS))
    assert {n for n, text in texts.items() if words.search(text) and starts(ast.parse(text))} == (
        MAY_START
    )
    # Another Python would import from the folder where a command is typed. The mesher is a file
    # that is started with -P, and a second model a file of the user's.
    found = {Path(name).name for name, text in texts.items() if "sys.executable" in text}
    assert found == {"processes.py", "tetwild.py", "external.py"}


@pytest.mark.parametrize(
    ("code", "status"),
    [("exit 7", 7), ("kill -SEGV $$", -11), ("kill -KILL $$", -9), ("kill -PIPE $$", -13)],
)
def test_the_exit_status_of_a_program_is_passed_on(code, status):
    assert run(["/bin/sh", "-c", code], stderr=subprocess.DEVNULL).returncode == status


def test_what_cannot_be_started_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        run(["no-such-program-here"])
    (tmp_path / "plain").touch()
    with pytest.raises(PermissionError):
        run([str(tmp_path / "plain")])


STUBBORN = "trap '' TERM HUP INT; sleep 300 & setsid sleep 300 & (sleep 300 &) ; : > up; wait; wait"
"""A program that does not listen, with a child, one in a session of its own and an orphan."""

PARENT = """
import sys, threading
from mvest.processes import Program
kept = []
def begin(): kept.append(Program(["/bin/sh", "-c", sys.argv[1]]))
if sys.argv[2] == "thread":
    # The thread that starts it ends long before the process.
    thread = threading.Thread(target=begin)
    thread.start()
    thread.join()
else:
    begin()
threading.Event().wait()
"""


@linux
@pytest.mark.parametrize("how", ["main", "thread"])
def test_a_kill_of_the_parent_ends_a_program_that_does_not_listen(tmp_path, how):
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, STUBBORN, how],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    try:
        # Parent, supervisor, shell and three.
        until(lambda: len(alive(tmp_path)) == 6 and (tmp_path / "up").exists())
    finally:
        parent.kill()
        parent.wait()
    assert gone(tmp_path), alive(tmp_path)


@linux
def test_a_time_limit_ends_all_that_was_started(tmp_path):
    with pytest.raises(subprocess.TimeoutExpired):
        run(["/bin/sh", "-c", STUBBORN], timeout=0.3, cwd=tmp_path)
    assert alive(tmp_path) == []


def forever(number: int) -> None:
    (Path(os.environ["UP"]) / str(number)).touch()
    time.sleep(300)


POOL = """
from mvest.processes import side_by_side
from tests import test_processes
list(side_by_side(test_processes.forever, ((k,) for k in range(2)), 2))
"""


@linux
def test_a_pool_ends_with_its_parent(tmp_path):
    parent = subprocess.Popen(
        [sys.executable, "-c", POOL],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT), "UP": str(tmp_path)},
        stderr=subprocess.DEVNULL,
    )
    try:
        until(lambda: len(list(tmp_path.iterdir())) == 2)
    finally:
        parent.kill()
        parent.wait()
    assert gone(tmp_path), alive(tmp_path)
