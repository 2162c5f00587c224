"""What every test of the application needs."""

import json
import sys
from types import SimpleNamespace

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

from experiments.common.records.record import read_record
from tests.experiments.composed_once import composed_once


@pytest.fixture(autouse=True)
def no_heartbeat(monkeypatch):
    """Lines that are written after ten seconds would depend on how busy the machine is."""
    monkeypatch.setattr("experiments.common.progress.Heartbeat._beat", lambda self: None)


@pytest.fixture(autouse=True)
def no_hydra_left_over():
    yield
    GlobalHydra.instance().clear()
    HydraConfig.instance().cfg = None


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run the application in an empty folder: exit status, standard output and error."""
    from experiments.run import main

    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["experiments.run", *arguments])
        status = main()
        said = capsys.readouterr()
        return status, said.out, said.err

    return call


@pytest.fixture
def run_here(run, tmp_path):
    """Run it into ``here``: exit status, record if any, folder and what it said."""

    def call(*arguments: str, findings=None):
        status, out, err = run(*arguments, "hydra.run.dir=here")
        folder = tmp_path / "here"
        file, record = folder / "result.json", None
        if file.is_file():
            record = read_record(file, findings) if findings else json.loads(file.read_text())
        return status, record, folder, SimpleNamespace(out=out, err=err)

    return call


@pytest.fixture(autouse=True, scope="session")
def coarse_pictures():
    """Few dots: what is drawn is the same, and nobody looks at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvest.reporting.figures.DPI", 40)
        yield


@pytest.fixture(autouse=True, scope="session")
def configurations_composed_once():
    """Merging what the same choices of groups name takes longer than most that is tested here."""
    with composed_once():
        yield
