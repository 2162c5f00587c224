"""The container recipes install and run the same, and what they name exists."""

import shlex
import shutil
import subprocess

import pytest

from tests.test_house import ROOT

DOCKER, APPTAINER = ROOT / "containers/Dockerfile", ROOT / "containers/mvest.def"


def lines(path, *starts):
    """Lines of a file that begin with a word, without it."""
    text = [line.strip() for line in path.read_text().splitlines()]
    return [line.split(" ", 1)[1] for line in text if line.split(" ")[0] in starts]


def post():
    """Commands of Apptainer's recipe that are no settings of the environment."""
    inside = APPTAINER.read_text().partition("%post")[2].partition("%runscript")[0]
    return [line.strip() for line in inside.splitlines() if line.strip()]


def test_both_recipes_do_the_same():
    commands = [line for line in post() if not line.startswith("export ")]
    assert lines(DOCKER, "RUN") == commands
    environment = lines(DOCKER, "ENV")
    assert lines(APPTAINER, "export") == 2 * environment
    assert lines(DOCKER, "FROM") == lines(APPTAINER, "From:")


def test_commands_of_the_recipes_exist():
    make, run = (line for line in lines(DOCKER, "RUN") if line.startswith(("make ", "mvest ")))
    target = shlex.split(make)[-1]
    planned = subprocess.run(
        ["make", "--dry-run", target], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert planned.returncode == 0, planned.stderr
    name = shlex.split(run)[2].partition("=")[2]
    assert (ROOT / f"conf/experiment/{name}.yaml").exists()


def docker_runs():
    """Whether there is a daemon that builds images."""
    if shutil.which("docker") is None:
        return False
    return subprocess.run(["docker", "info"], capture_output=True, check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not docker_runs(), reason="no docker daemon runs here")
def test_the_image_runs():
    subprocess.run(["docker", "build", "-t", "mvest-test", "-f", DOCKER, ROOT], check=True)
    shown = subprocess.run(
        ["docker", "run", "--rm", "mvest-test", "--version"], capture_output=True, check=True
    )
    assert shown.stdout.startswith(b"mvest ")
