"""The tidy table of a sweep's runs, and statistics by setting, by hand-made numbers."""

import math
from io import StringIO

import numpy as np
import pytest
from pandas import read_csv

from experiments.sweeps.report import by_setting, runs_of, shortened
from mvest.estimation.estimate import NOT_THE_POSTERIOR
from tests.experiments.sweeps.made_up_sweeps import TRUTH, failed_run, job, run, sweep

PAPER = {"table": "Table 1", "estimate": [6.02, 2.13], "error_percent": [3.37, 1.91]}


def group(errors: list[float], *, failed: int = 0) -> dict:
    """Statistics of runs whose anterior estimate is off by these MPa, each with an SD of 0.1."""
    runs = [
        run(seed, np.add(TRUTH, [error, 0.0]), [0.1, 0.1], bound=[0.1, 0.1])
        for seed, error in enumerate(errors)
    ]
    runs += [failed_run(len(errors) + k, "no") for k in range(failed)]
    return by_setting(sweep("noise", [job({"kind": "white"}, runs)])).rows[0]


def test_errors_by_hand():
    found = group([0.1, -0.1, 0.3, -0.1], failed=2)
    assert (found["runs"], found["failed"]) == (4, 2)
    # Mean (0.1 - 0.1 + 0.3 - 0.1) / 4; mean square (0.01 + 0.01 + 0.09 + 0.01) / 4 = 0.03.
    assert found["error"] == pytest.approx(100 * 0.05 / 6.23)
    assert found["median error"] == pytest.approx(0.0)
    assert found["RMSE"] == pytest.approx(100 * math.sqrt(0.03) / 6.23)
    assert found["estimate"] == pytest.approx(6.28)
    # Around the mean: 0.05, -0.15, 0.25, -0.15, squares 0.11 in all, over n - 1 = 3.
    assert found["SD over runs"] == pytest.approx(math.sqrt(0.11 / 3))
    assert found["RMSE / bound"] == pytest.approx(math.sqrt(3))
    assert found["largest error"] == pytest.approx(100 * 0.3 / 6.23)


def test_coverage_by_hand():
    # Half width 1.9600 standard deviations of 0.1.
    found = group([0.1, -0.1, 0.3, -0.3], failed=1)
    assert found["coverage"] == 50.0
    # Wilson: z / (1 + z²/4) sqrt(0.25/4 + z²/64) = 0.34996 around one half, z = 1.95996.
    assert found["coverage, low"] == pytest.approx(50 - 34.996, abs=1e-3)
    assert found["coverage, high"] == pytest.approx(50 + 34.996, abs=1e-3)
    assert group([0.1959])["coverage"] == 100.0
    assert group([0.1961])["coverage"] == 0.0


def test_every_run_has_its_rows_with_factors_first_and_failures_kept():
    good = run(1, [6.43, 2.0], [0.1, 0.05], bound=[0.09, 0.03])
    jobs = [
        job({"kind": "white", "noise_mm": 0.5}, [good, failed_run(2, "went wrong")]),
        job({"kind": "white", "noise_mm": 1.0}, [], "out of memory", seed=4, repeats=3),
    ]
    rows = runs_of(sweep("noise", jobs)).rows
    assert list(rows[0])[:4] == ["kind", "noise", "job", "seed"]
    # A row for each parameter; a dead job counts as a failed run for each planned seed.
    assert [row["seed"] for row in rows[::2]] == [1, 2, 4, 5, 6]
    assert [row["status"] for row in rows[::2]] == ["converged", *["failed"] * 4]
    assert [row["reason"] for row in rows[::2]] == ["", "went wrong", *["out of memory"] * 3]
    anterior, posterior = rows[:2]
    assert (anterior["parameter"], posterior["parameter"]) == ("E_f.anterior", "E_f.posterior")
    # 6.43 is 0.2 above the truth of 6.23, 2.0 is 0.09 below 2.09.
    assert anterior["signed error"] == pytest.approx(100 * 0.2 / 6.23)
    assert posterior["signed error"] == pytest.approx(-100 * 0.09 / 2.09)
    # Of a lost run only its factors are known.
    assert (rows[-1]["noise"], rows[-1]["true value"], rows[-1]["estimate"]) == (1.0, None, None)


def test_the_file_is_plain_and_free_of_times():
    whole = sweep(
        "x", [job({"truth": "finer\nmesh", "start_anterior": 5.0}, [failed_run(1, "a\nb")])]
    )
    text = shortened(runs_of(whole)).csv()
    assert len(text.splitlines()) == 3
    assert "second" not in text.partition("\n")[0]
    back = read_csv(StringIO(text))
    assert list(back.columns)[:2] == ["truth", "start anterior [MPa]"]
    assert set(back["truth"]) == {"finer mesh"}
    assert list(back["true value [MPa]"]) == TRUTH.tolist()


def test_a_row_for_each_setting_below_the_papers():
    jobs = [
        job({"filter": "paper", "R": r, "seed": seed}, [run(seed, TRUTH * 1.01, [0.1, 0.1])])
        for r in (0.1, 1.0)
        for seed in (1, 2)
    ]
    rows = by_setting(sweep("x", jobs, paper=PAPER)).rows
    assert [(row["setting"], row["runs"]) for row in rows[::2]] == [
        ("paper, Table 1", None), ("R 0.1 mm²", 2), ("R 1 mm²", 2),
    ]  # fmt: skip
    assert (rows[0]["estimate"], rows[1]["largest error"]) == (6.02, 1.91)


def test_of_very_many_settings_with_one_run_numbers_are_repetitions():
    def of(count: int):
        jobs = [
            job({"start_anterior": float(k), "filter": f}, [run(1, TRUTH, [0.1, 0.1])])
            for f in ("a", "b")
            for k in range(count)
        ]
        return [(row["setting"], row["runs"]) for row in by_setting(sweep("x", jobs)).rows[::2]]

    assert of(1) == [("a", 1), ("b", 1)]
    assert len(of(75)) == 150
    assert of(76) == [("a", 76), ("b", 76)]


def test_failures_are_counted_by_their_kind_whatever_their_numbers():
    doubts = [f"no rounds left{NOT_THE_POSTERIOR}: {x} above 0.25" for x in (0.31, 0.72)]
    runs = [failed_run(k, reason) for k, reason in enumerate([*doubts, "no rounds left"], 2)]
    whole = sweep("x", [job({"a": 1}, [run(1, TRUTH, [0.1, 0.1]), *runs])])
    row = by_setting(whole).rows[0]
    assert row["failures"] == f"2 x no rounds left{NOT_THE_POSTERIOR}; no rounds left"
