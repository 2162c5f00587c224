"""Programs are started without a shell, and stopped with all that they have started."""

import json
import sys
import time
from pathlib import Path

import pytest

from mvest.errors import ConfigurationError
from mvest.exchange.external.contract import Command

SHOW = "import json, os, sys; print(json.dumps([sys.argv[1:], os.getcwd(), os.environ.get('LAW')]))"


def python(code: str, *arguments: str, **settings) -> Command:
    return Command((sys.executable, "-I", "-S", "-c", code, *arguments), **settings)


def run(command: Command, folder: Path) -> str:
    with command.started(folder) as ended:
        return ended()


def said(folder: Path) -> list:
    return json.loads((folder / "stdout.txt").read_text())


def test_placeholders_are_filled_once_even_if_the_folder_looks_like_one(tmp_path):
    folder = tmp_path / "{request}; rm"
    folder.mkdir()
    command = python(SHOW, "{folder}", "a={request}", "{here}", environment={"LAW": "a;b $HOME"})
    assert run(command, folder) == ""
    arguments, place, law = said(folder)
    assert arguments == [str(folder), f"a={folder / 'request.json'}", str(Path.cwd())]
    assert (place, law) == (str(folder), "a;b $HOME")


def test_what_an_ended_program_leaves_behind_is_stopped(tmp_path):
    child = "import time, pathlib; time.sleep(0.8); pathlib.Path('late').touch()"
    code = f"import subprocess, sys; subprocess.Popen([sys.executable, '-S', '-c', {child!r}])"
    assert run(python(code), tmp_path) == ""
    time.sleep(1.2)
    assert not (tmp_path / "late").exists()


def test_the_end_of_a_crashed_program_is_told_with_its_last_words(tmp_path):
    lines = "import sys; [print('line', k, file=sys.stderr) for k in range(9)]; sys.exit(3)"
    reason = run(python(lines), tmp_path)
    assert reason == "exit status 3; its last words: line 5 | line 6 | line 7 | line 8"
    reason = run(python("import os; os.kill(os.getpid(), 11)"), tmp_path)
    assert reason == "killed by signal 11 (SIGSEGV)"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arguments": ()}, "command is empty"),
        ({"arguments": ("no-such-program-here",)}, "not found"),
        ({"arguments": ("./solve.sh",)}, "{here}/./solve.sh"),
        ({"time_limit_s": 0.0}, "time_limit_s"),
    ],
)
def test_an_inadmissible_command_is_refused_before_it_runs(change, message):
    with pytest.raises(ConfigurationError, match=message.replace("{", r"\{").replace(".", r"\.")):
        Command(**({"arguments": (sys.executable,)} | change))
