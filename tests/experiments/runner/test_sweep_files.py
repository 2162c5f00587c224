"""The sweeps' configurations: every job of every size composes, and says what sets it apart."""

import json
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from experiments.common.building.filters import build_filter
from experiments.common.building.twin import build_twin
from experiments.common.cases.blind import SECRET
from experiments.common.config import hash_of, register
from experiments.common.schema import build
from experiments.runner.compose import expand, make_plan
from experiments.runner.jobs import TIME_LIMIT_S
from experiments.runner.plugins import register_plugins
from mvest.simulation.virtual_patient import PatientSettings
from tests.places import CONF

SWEEPS = ("initial_guess", "covariance", "noise", "discrepancy", "filter")


def jobs(name: str, size: str) -> list[list[str]]:
    config = compose("config", [f"sweep={name}", f"sweep.size={size}"], return_hydra_config=True)
    assert config.hydra.mode.name == "MULTIRUN"
    return expand(config, [], GlobalHydra.instance().config_loader())


def composed(*overrides: str) -> tuple[str, dict]:
    config = compose("config", list(overrides))
    plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    return hash_of(config), plain  # type: ignore[return-value]


@pytest.fixture
def configuration():
    register()
    register_plugins()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


@pytest.mark.parametrize("name", SWEEPS)
def test_every_job_composes_and_is_distinct(configuration, name: str) -> None:
    planned = jobs(name, "full")
    # Composing takes a tenth of a second: the last job and a regular choice of the others.
    chosen = [*planned[: -1 : len(planned) // 4 + 1], planned[-1]]
    hashes, seen = set(), {}
    for overrides in chosen:
        config_hash, config = composed(f"sweep={name}", "sweep.size=full", *overrides)
        hashes.add(config_hash)
        assert config["name"] == config["table"] == f"sweep_{name}"
        assert config["factors"]
        assert all(isinstance(v, str | int | float) for v in config["factors"].values())
        # Jobs that differ in the seed only are one cell of a table.
        cell = json.dumps([config["factors"], config["mesh"]["columns"]])
        assert seen.setdefault(cell, config["row"]) == config["row"]
        build_filter(config["filter"], tuple(config["parameters"]))
    assert len(hashes) == len(chosen)
    rows = {json.dumps(overrides) for overrides in planned}
    assert len(rows) == len(planned)


def test_jobs_composed_one_after_another_are_as_each_alone(configuration) -> None:
    config = compose("config", ["sweep=discrepancy"], return_hydra_config=True)
    loader = GlobalHydra.instance().config_loader()
    # Groups, values within what a group chose, and values on the command line.
    said = ["sweep=discrepancy", "seed=3,1", "filter.initial=[5.0,3.0],[9,6.0]"]
    plan = make_plan(config, loader, expand(config, said, loader))
    assert len({job.config_hash for job in plan.jobs}) == len(plan.jobs)
    for job in plan.jobs[::8]:
        config_hash, values = composed(*job.overrides)
        # Which a job by itself does not have.
        values["time_limit_s"] = TIME_LIMIT_S
        # What is varied on the command line is named besides.
        assert values["factors"].items() <= job.values["factors"].items()
        values["factors"] = job.values["factors"]
        assert json.dumps(job.values, sort_keys=True) == json.dumps(values, sort_keys=True)
        assert job.config_hash == config_hash
        assert job.folder == Path("outputs") / "sweep_discrepancy" / config_hash[:16]


def test_the_truth_of_a_discrepancy_is_another_one_and_its_key_too(configuration, tmp_path) -> None:
    keys = {}
    for overrides in jobs("discrepancy", "small"):
        usual = ("sweep=discrepancy", "mesh=coarse", f"paths.outputs={tmp_path}")
        _, config = composed(*usual, *overrides)
        twin = build_twin(config)
        keys[config["truth"]["label"]] = twin.source.key
        assert twin.model.settings.tissue["anterior"].reading == "A"
        assert twin.model.fixed == {}
        if config["truth"]["label"] == "Poisson reading C":
            assert {t.reading for t in twin.truth_model.settings.tissue.values()} == {"C"}
        if config["truth"]["label"] == "E_f/E_perp +20 %":
            assert twin.truth_model.settings.tissue["anterior"].ratio == 3.181
            assert twin.model.settings.tissue["anterior"].ratio == pytest.approx(2.651, abs=1e-3)
    assert len(keys) == len(set(keys.values())) == 12


def test_each_world_changes_what_its_estimator_is_not_given(configuration) -> None:
    misspecifications = sorted(path.stem for path in (CONF / "misspecification").glob("*.yaml"))
    config = compose("config", ["sweep=calibration"], return_hydra_config=True)
    planned = expand(config, [], GlobalHydra.instance().config_loader())
    assert len(planned) == 20 * len(misspecifications)
    # A seed is one valve with every misspecification, so an unfinished sweep has all of them.
    assert {line.partition("=")[2] for job in planned[: len(misspecifications)] for line in job
            if line.startswith("misspecification=")} == set(misspecifications)  # fmt: skip
    assert all("seed=6501" in job for job in planned[: len(misspecifications)])
    made, given = [], set()
    for misspecification in misspecifications[::3]:
        config = composed("sweep=calibration", f"misspecification={misspecification}", "row=r")[1]
        made.append(build(PatientSettings, config["patient"]))
        # All else, and with it what the estimator is given, is the same.
        given.add(json.dumps({key: config[key] for key in config.keys() - SECRET}, sort_keys=True))
    assert len(given) == 1
    assert len({repr(one.simulation) for one in made}) == len(made)
