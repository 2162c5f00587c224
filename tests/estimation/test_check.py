"""Checks of a filter's posterior: alarms on bent models, and none on linear ones."""

import numpy as np
import pytest

from mvest.estimation import (
    EnsembleFilter,
    ExtendedFilter,
    Gaussian,
    IteratedFilter,
    PaperFilter,
    UnscentedFilter,
)
from tests.estimation.problems import Linear, banana

BENT = Gaussian(np.array([0.3, 0.0]), np.eye(2))
"""Prior of the banana, not quite on its axis of symmetry."""


@pytest.mark.parametrize(("y", "R"), [(0.0, 0.01), (1.0, 0.05), (2.0, 0.01)])
@pytest.mark.parametrize(
    "filter_",
    [ExtendedFilter(), UnscentedFilter(), EnsembleFilter(), EnsembleFilter(steps=4)],
    ids=["extended", "unscented", "ensemble", "smoother"],
)
def test_a_filter_whose_runs_lie_apart_passes_no_banana_for_an_ellipse(filter_, y, R) -> None:
    found = filter_(banana, BENT, np.array([y]), R)
    assert found.converged
    assert not found.trusted
    assert found.check is not None
    assert not found.check.holds
    assert "but the posterior is not what the filter assumes: " in found.why
    assert found.check.sentence in str(found)


@pytest.mark.parametrize("p", [1, 2, 5])
def test_no_filter_raises_an_alarm_on_linear_models(p) -> None:
    kinds = (IteratedFilter, ExtendedFilter, UnscentedFilter, EnsembleFilter, PaperFilter)
    filters = [*(kind() for kind in kinds), EnsembleFilter(steps=4)]
    for seed in range(20):
        problem = Linear(p=p, seed=seed)
        for filter_ in filters:
            found = problem.by(filter_)
            assert found.trusted, (seed, filter_, found.why)
            assert found.check is not None
            # An exact quadratic; the paper's filter stops a little before its fixed point.
            if not isinstance(filter_, PaperFilter):
                assert found.check.value < 1e-6 * found.check.limit
