"""Tissue and reference of a valve, by one word, for estimates and for truths."""

import pytest

from experiments.common.building.closure import mechanics_of
from experiments.common.building.twin import truth_mechanics
from mvest.errors import ConfigurationError
from tests.experiments.configured import composed, plain
from tests.places import CONF

CHOICES = {path.stem for path in (CONF / "tissue").glob("*.yaml")} - {"linear"}


@pytest.mark.parametrize("experiment", ["table1", "gate", "closure", "patients", "own_valve"])
def test_one_word_changes_the_tissue_of_an_experiment(experiment) -> None:
    values = plain(
        composed(f"experiment={experiment}", "tissue=exponential", "reference=relaxation")
    )
    settings = mechanics_of(values)
    assert {tissue.law for tissue in settings.tissue.values()} == {"exponential"}
    assert settings.relaxation is not None
    assert set(settings.relaxation.E_f) == set(settings.tissue)


@pytest.mark.parametrize("choice", sorted(CHOICES))
def test_a_truth_has_the_tissue_of_the_same_word(choice) -> None:
    values = plain(composed(f"truth={choice}"))
    settings = mechanics_of(values)
    true = truth_mechanics(settings, values["truth"])
    assert true.tissue == mechanics_of(plain(composed(f"tissue={choice}"))).tissue
    assert true.tissue != settings.tissue
    assert true.relaxation is None


def test_a_relaxed_truth_is_not_that_of_the_estimate() -> None:
    values = plain(composed("truth=relaxation"))
    settings = mechanics_of(values)
    true = truth_mechanics(settings, values["truth"])
    relaxed = mechanics_of(plain(composed("reference=relaxation")))
    assert settings.relaxation is None
    assert true.relaxation == relaxed.relaxation
    assert true.tissue == settings.tissue
    values["truth"]["tissue"] = {"septal": {"ratio": 1.0}}
    with pytest.raises(ConfigurationError, match="of septal, expected of anterior, posterior"):
        truth_mechanics(settings, values["truth"])
