"""The study of all filters, on models that are computed in no time."""

import sys
from types import SimpleNamespace

import pytest

from experiments.common.config import plain
from experiments.common.records.record import read_record
from experiments.run import main
from experiments.studies.filters import STUDY, run
from mvest.errors import ConfigurationError
from tests.experiments.configured import composed
from tests.experiments.studies.test_gate import SMALL

NAMES = ("E_f.anterior", "E_f.posterior")


def test_a_reference_without_draws_is_refused() -> None:
    one = ("~filters.problems.chordae", "~filters.problems.rest_length")
    values = plain(composed("experiment=filters", *SMALL, *one))
    values["filters"]["reference"] = {
        "_target_": "mvest.estimation.filters.iterated.ExtendedFilter"
    }
    settings = STUDY.settings_of(values)
    with pytest.raises(ConfigurationError, match=r"filters\.reference: no draws"):
        run(SimpleNamespace(settings=settings, values=values))


def test_the_study_runs_and_its_tables_follow_from_the_record(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [
        "experiments.run",
        "experiment=filters",
        *SMALL,
        "~filters.problems.chordae",
        "~filters.problems.rest_length",
        "~filters.methods.perturbed",
        "~filters.methods.smoother",
        "filters.problems.moduli.noise_mm=0.05",
        "filters.methods.ensemble.members=6",
        "filters.methods.paper.max_iterations=3",
        "+filters.methods.importance.runs=20",
        "+filters.methods.importance.batch=10",
        "filters.reference.runs=30",
        "filters.reference.batch=15",
        "hydra.run.dir=here",
    ]
    monkeypatch.setattr(sys, "argv", arguments)
    assert main() == 0
    record = read_record(tmp_path / "here" / "result.json")
    assert record.mesh is not None
    assert record.provenance.mesh_hash == record.mesh.sha256
    found = {row["filter"]: row for row in record.table_of().rows if row["parameter"] == NAMES[0]}
    assert list(found) == ["paper", "extended", "iterated", "unscented", "ensemble", "importance"]
    # What each costs is what the model was run: 2; 6 members and the estimate.
    assert found["extended"]["runs"] == 2
    assert found["iterated"]["check"] <= found["iterated"]["check limit"]
    assert found["ensemble"]["runs"] == 7
    # So few draws are not enough, and it is recorded.
    by = record.table_of("reference").rows[0]
    assert not by["ended"].startswith("converged")
    assert (by["width ratio"], by["lower end off"]) == (1.0, 0.0)
    # The unscented and the extended filter agree where the data are strong.
    shift = found["unscented"]["log mean"] - found["iterated"]["log mean"]
    assert shift == pytest.approx(0.0, abs=0.01)
