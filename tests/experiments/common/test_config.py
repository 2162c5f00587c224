import numpy as np
import pytest

from experiments.common.building.twin import build_twin
from experiments.common.config import hash_of
from experiments.results.published import as_published
from mvest.observation.errors import WhiteNoise
from tests.experiments.configured import composed, plain


def test_a_hash_depends_on_what_changes_the_result_only() -> None:
    base = hash_of(composed("experiment=table1"))
    assert hash_of(composed("experiment=table1", "paths.outputs=elsewhere")) == base
    assert hash_of(composed("experiment=table1", "tracking.enabled=false")) == base
    others = {
        hash_of(composed("experiment=table1", override))
        for override in (
            "seed=2",
            "filter.P0=0.02",
            "truth.values=[4.5,3.2]",
            "mechanics.reading=C",
        )
    }
    assert base not in others
    assert len(others) == 4


@pytest.mark.parametrize(
    ("experiment", "one", "other"),
    [
        ("table1", "filter.R=1", "filter.R=1.0"),
        ("table1", "filter.P0=[[1,0],[0,1]]", "filter.P0=[[1.0,0.0],[0.0,1.0]]"),
        ("donor", "donor.starts=[[1,2]]", "donor.starts=[[1.0,2.0]]"),
        ("models", "external.settings.cells=4", "external.settings.cells=4.0"),
    ],
)  # fmt: skip
def test_equal_numbers_have_one_hash(experiment, one, other) -> None:
    first, second = (hash_of(composed(f"experiment={experiment}", line)) for line in (one, other))
    assert first == second
    assert first != hash_of(composed(f"experiment={experiment}"))


def test_what_within_a_part_changes_no_number_is_no_part_of_the_hash() -> None:
    base = hash_of(composed("experiment=imaging"))
    assert hash_of(composed("experiment=imaging", "imaging.processes=7")) == base
    assert hash_of(composed("experiment=imaging", "imaging.evaluate=false")) != base
    assert as_published(["experiment=imaging", "imaging.processes=7"], None, "imaging")
    assert not as_published(["experiment=imaging", "imaging.evaluate=false"], None, "imaging")
    assert not as_published(["+imaging.train.count=7"], None, "imaging")
    assert as_published(["paths.outputs=elsewhere", "~sweep"], None, "twin")


def test_the_usual_overrides_reach_the_objects() -> None:
    words = ["truth.values=[4.5,3.2]", "filter.initial=[8,1.5]", "mechanics.reading=C",
             "observation.noise_mm=0.5", "filter.P0=[1,4]", "filter.R=[0.01,0.25]"]  # fmt: skip
    twin = build_twin(plain(composed("experiment=debug", *words)))
    assert list(twin.truth_values) == [4.5, 3.2]
    assert list(twin.problem.prior.mean) == [8.0, 1.5]
    assert twin.problem.prior.covariance.diagonal().tolist() == [1.0, 4.0]
    assert {tissue.reading for tissue in twin.model.settings.tissue.values()} == {"C"}
    assert twin.observe.keywords["errors"] == (WhiteNoise(0.5),)
    assert list(twin.observe.keywords["variance"]) == [0.01, 0.25]
    # Truth and estimator share the mesh here, but no object that could carry a value across.
    assert twin.truth_model is not twin.model
    assert twin.truth_model.fixed is not twin.model.fixed
    assert twin.truth_model.mesh.sha256 == twin.model.mesh.sha256


def test_a_population_is_drawn_from_what_its_estimator_states() -> None:
    config = plain(composed("experiment=population"))
    known, patient = config["personal"], config["patient"]
    geometry = known["nuisance_geometry"]
    choices = "shape_length_mm", "annulus_length_mm", "factor", "share", "renewals"
    assert {value for name, value in geometry.items() if name not in choices} == {0.0}
    for name in ("pressure", "chord_stiffness", "chord_rest_length"):
        unknown = "pressure_scale" if name == "pressure" else name
        assert known["unknowns"][unknown]["std"] == patient["deviations"][name]
    modulus = known["unknowns"]["E_f.anterior"]
    log_std = np.sqrt(np.log1p((modulus["std"] / modulus["mean"]) ** 2))
    assert patient["moduli_spread"] == pytest.approx(log_std, abs=0.005)
