import math

import numpy as np
import pytest

from experiments.sweeps.rows import Run, runs_of
from experiments.sweeps.statistics import (
    Coverage,
    accuracy,
    coverage,
    grouped,
    in_basin,
    verdict,
)
from tests.experiments.sweeps.synthetic_sweeps import TRUTH, failed_run, job, run, sweep


def group(errors: list[float], *, failed: int = 0, bound: float | None = 0.1) -> list[Run]:
    """Runs whose anterior estimate is off by these MPa, each with a standard deviation of 0.1."""
    bounds = None if bound is None else [bound, bound]
    runs = [
        run(seed, np.add(TRUTH, [error, 0.0]), [0.1, 0.1], bound=bounds)
        for seed, error in enumerate(errors)
    ]
    runs += [failed_run(100 + k, "no") for k in range(failed)]
    return runs_of(sweep("noise", [job({"kind": "white", "noise_mm": 1.0}, runs)]))


def test_errors_by_hand() -> None:
    found = accuracy(group([0.1, -0.1, 0.3, -0.1], failed=2), 0)
    assert (found.n, found.failed) == (4, 2)
    # Mean (0.1 - 0.1 + 0.3 - 0.1) / 4; mean square (0.01 + 0.01 + 0.09 + 0.01) / 4 = 0.03.
    assert found.bias == pytest.approx(0.05)
    assert found.rmse == pytest.approx(math.sqrt(0.03))
    assert found.mean == pytest.approx(6.28)
    # Around the mean: 0.05, -0.15, 0.25, -0.15, squares 0.11 in all, over n - 1 = 3.
    assert found.spread == pytest.approx(math.sqrt(0.11 / 3))
    assert found.ratio == pytest.approx(math.sqrt(3))
    assert found.ratio_std == pytest.approx(math.sqrt(3 / 8))
    assert found.bias_percent == pytest.approx(100 * 0.05 / 6.23)
    assert found.worst_percent == pytest.approx(100 * 0.3 / 6.23)
    assert found.reported == pytest.approx(0.1)


def test_what_a_failed_run_left_behind_is_no_estimate() -> None:
    astray = failed_run(9, "too many rounds", estimate=[60.0, 20.0], std=[0.1, 0.1])
    runs = runs_of(sweep("x", [job({}, [run(1, TRUTH, [0.1, 0.1]), astray])]))
    found = accuracy(runs, 0)
    assert (found.n, found.failed, found.worst_percent) == (1, 1, 0.0)
    assert coverage(runs, 0).n == 1


def test_without_a_bound_or_a_run_there_is_no_ratio() -> None:
    assert math.isnan(accuracy(group([0.1], bound=None), 0).ratio)
    nothing = accuracy(group([], failed=3), 0)
    assert (nothing.n, nothing.failed) == (0, 3)
    assert math.isnan(nothing.rmse)
    assert math.isnan(nothing.worst_percent)


def test_coverage_by_hand() -> None:
    runs = group([0.1, -0.1, 0.3, -0.3], failed=1)
    # Half widths: 0.6745, 1.2816 and 1.9600 standard deviations of 0.1.
    assert [coverage(runs, 0, level).inside for level in (0.5, 0.8, 0.95)] == [0, 2, 2]
    found = coverage(runs, 0)
    assert (found.n, found.share) == (4, 0.5)
    # Wilson: z / (1 + z²/4) sqrt(0.25/4 + z²/64) = 0.34996 around one half, z = 1.95996.
    assert found.low == pytest.approx(0.5 - 0.34996, abs=1e-5)
    assert found.high == pytest.approx(0.5 + 0.34996, abs=1e-5)


def test_an_interval_just_wide_enough_counts() -> None:
    assert coverage(group([0.1959]), 0).inside == 1
    assert coverage(group([0.1961]), 0).inside == 0


@pytest.mark.parametrize(
    ("found", "word"),
    [
        (Coverage(94, 100, 0.94, 0.875, 0.972), "yes"),
        (Coverage(80, 100, 0.80, 0.711, 0.867), "no"),
        (Coverage(20, 20, 1.00, 0.839, 1.000), "too few runs to tell"),
        (Coverage(999, 999, 1.0, 0.996, 1.0), "no"),
        (Coverage(0, 0, np.nan, np.nan, np.nan), ""),
    ],
)
def test_coverage_is_judged_with_its_own_error(found: Coverage, word: str) -> None:
    assert verdict(found) == word


def test_the_basin_asks_for_every_parameter() -> None:
    start = {"start_anterior": 1.0, "start_posterior": 2.0, "filter": "paper"}
    near, far = ([6.23 * 1.0009, 2.09], [6.23, 2.09 * 0.9989])
    runs = runs_of(
        sweep("initial_guess", [job(start, [run(1, m, [0.1, 0.1])]) for m in (near, far)])
    )
    assert [in_basin(r) for r in runs] == [True, False]
    lost = [failed_run(1, "no", estimate=[6.23, 2.09], std=[0.1, 0.1])]
    assert not in_basin(runs_of(sweep("initial_guess", [job(start, lost)]))[0])


def test_groups_keep_their_order_and_every_run_has_a_filter() -> None:
    jobs = [job({"a": a}, [run(1, TRUTH, [0.1, 0.1])], filter="paper") for a in (2, 1, 2)]
    groups = grouped(runs_of(sweep("x", jobs)), ["a", "filter"])
    assert {key: len(found) for key, found in groups.items()} == {(2, "paper"): 2, (1, "paper"): 1}
    assert list(groups) == [(2, "paper"), (1, "paper")]
