"""The console command: what it says, what it hands on, and all of it from an installed wheel."""

import os
import re
import subprocess
import sys
import sysconfig
import venv
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from experiments import cli
from experiments.common.places import CONF
from mvest.cases.folder import write_case
from mvest.errors import ConfigurationError
from tests.made_up_closure import made_up_case
from tests.places import ROOT


@pytest.fixture
def handed(monkeypatch):
    """Overrides that the application would have been given."""
    given = []
    monkeypatch.setattr(cli, "run_command", lambda overrides: given.append(overrides) or 0)
    return given


def test_every_experiment_is_listed_with_one_sentence(capsys):
    assert cli.main(["list"]) == 0
    said = capsys.readouterr().out
    sentences = cli.experiments_in(CONF / "experiment")
    assert len(sentences) >= 26
    for name, sentence in sentences.items():
        assert re.search(rf"^{name} ", said, re.MULTILINE)
        assert sentence


def test_what_is_about_one_path_is_handed_on(handed):
    assert cli.main(["own-valve", "my case", "--check", "seed=2"]) == 0
    assert cli.main(["volume", "v.nrrd", "imaged.pressure_mmHg=120", "figures=false"]) == 0
    assert cli.main(["run", "-m", "experiment=table1", "seed=1,2"]) == 0
    assert handed == [
        ["experiment=own_valve", "case='my case'", "check=true", "seed=2"],
        ["experiment=volume", "volume='v.nrrd'", "imaged.pressure_mmHg=120", "figures=false"],
        ["-m", "experiment=table1", "seed=1,2"],
    ]


@pytest.mark.parametrize(
    "text", ["plain", "with space, comma=equal", "it's", r"a\b", r"a\'b", "end\\", "${seed}", "(x)"]
)
def test_a_path_is_taken_literally(text):
    (override,) = OverridesParser.create().parse_overrides([f"case={cli.quoted(text)}"])
    value = override.value()
    assert value.replace(r"\${", "${") == text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lsit"], "lsit: no such command; did you mean list?"),
        (["own-valve", "pyproject.toml"], "for a volume over time: mvest volume pyproject.toml"),
        (["own-valve", "a", "b"], "b: expected NAME=VALUE"),
        (["volume", "a", "--chekc"], "unrecognized arguments: --chekc"),
    ],
)
def test_a_wrong_request_is_one_line_and_status_2(arguments, message, capsys, handed):
    try:
        status = cli.main(arguments)
    except SystemExit as left:
        status = left.code
    assert status == 2
    assert handed == []
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert message in line


def test_the_name_of_an_experiment_stands_for_it():
    assert cli.named("table1") == "experiment=table1"
    others = ["-m", "seed=1,2", "~filter"]
    assert [cli.named(one) for one in others] == others
    with pytest.raises(ConfigurationError, match=r"tabel1: no such .*mean experiment=table1"):
        cli.named("tabel1")


def test_every_command_has_help_with_an_example(capsys):
    for name in cli.COMMANDS:
        with suppress(SystemExit):
            cli.main([name, "--help"])
        assert f"example: mvest {name}" in capsys.readouterr().out


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_the_completion_knows_the_words(shell, tmp_path, capsys):
    assert cli.main(["completion", shell]) == 0
    script = tmp_path / "script"
    script.write_text(capsys.readouterr().out.removeprefix("autoload -U +X bashcompinit && "))
    for words, expected in (
        ("mvest ow", "own-valve"),
        ("mvest run experiment=table1_te", "table1_tet4"),
        ("mvest import slicer", "slicerheart"),
        ("mvest volume --ch", "--check"),
    ):
        *before, word = words.split(" ")
        code = (
            f"bashcompinit() {{ :; }}; source {script}; COMP_LINE='{words}' "
            f"COMP_POINT={len(words)} COMP_WORDS=({words}) COMP_CWORD={len(before)}; "
            "_mvest; echo ${COMPREPLY[@]}"
        )
        done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.split() == [expected], word


WORDS = "from experiments.cli import main\ntry: main({})\nexcept SystemExit: pass"
TWIN = """import experiments.run
from experiments.runner import job
from experiments.common.study import load_study
load_study('twin')"""
HEAVY = {
    WORDS.format(["list"]): {"numpy", "hydra", "yaml", "mlflow"},
    WORDS.format(["run", "--help"]): {"numpy", "hydra", "yaml", "mlflow"},
    TWIN: {"matplotlib", "pandas", "mlflow", "mvest.personalisation.chain"},
}


@pytest.mark.parametrize("code", HEAVY, ids=["list", "help", "twin"])
def test_nothing_is_loaded_that_is_not_needed(code, tmp_path):
    code = f"{code}\nimport sys\nheavy = {HEAVY[code]} & set(sys.modules)\nassert not heavy, heavy"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=environment)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The command of a wheel in an environment of its own, to be run in an empty folder.

    What the wheel depends on is lent by the environment of the tests; this project itself is not:
    the path that lends it leaves out the links of editable installations.
    """
    place = tmp_path_factory.mktemp("new_user")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(place)]
    subprocess.run(build, check=True, cwd=ROOT, capture_output=True)
    (wheel,) = place.glob("*.whl")
    venv.create(place / "env", with_pip=False)
    python = place / "env" / ("Scripts" if os.name == "nt" else "bin") / "python"
    packages = sysconfig.get_path("purelib", vars={"base": str(place / "env")})
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", str(wheel)]
    subprocess.run(pip, check=True, capture_output=True)
    lent = Path(packages) / "lent.pth"
    lent.write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    folder = place / "empty"
    folder.mkdir()
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [python.with_name("mvest"), *arguments],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=900,
        )

    return run, folder


@pytest.mark.slow
def test_an_installed_wheel_does_everything(installed):
    run, folder = installed
    write_case(folder / "my valve", made_up_case(0.3, 8.0, np.random.default_rng(1)))
    outputs = folder / "outputs"
    for words, pattern, count in (
        (["run", "experiment=debug"], "debug/*/result.json", 1),
        (["run", "-m", "experiment=debug", "seed=2,3"], "debug/*/result.json", 3),
        (
            ["own-valve", "my valve", "--check", "personal.mesh.source=structured"],
            "own_valve/*/case.png",
            1,
        ),
    ):
        done = run(*words)
        assert done.returncode == 0, done.stderr
        found = list(outputs.glob(pattern))
        assert len(found) == count
        # No commit made it.
        assert ".json" not in pattern or '"sha": null' in found[0].read_text(encoding="utf-8")
    wrong = run("own-valve", "nowhere", "--check")
    assert wrong.returncode == 2
    (line,) = wrong.stderr.strip().splitlines()
    assert line.startswith("error: ")
