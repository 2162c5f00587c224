"""The container recipes install and run the same, and what they name exists."""

import shlex
import subprocess

from tests.test_house import ROOT

DOCKER, APPTAINER = ROOT / "containers/Dockerfile", ROOT / "containers/mvest.def"


def lines(path, *starts):
    """Lines of a file that begin with a word, without it."""
    text = [line.strip() for line in path.read_text().splitlines()]
    return [line.split(" ", 1)[1] for line in text if line.split(" ")[0] in starts]


def test_both_recipes_do_the_same():
    inside = APPTAINER.read_text().partition("%post")[2].partition("%runscript")[0]
    post = [line.strip() for line in inside.splitlines() if line.strip()]
    assert lines(DOCKER, "RUN") == [line for line in post if not line.startswith("export ")]
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
