import math

import numpy as np
import pytest

from experiments.sweeps.collected import Sweep
from experiments.sweeps.conclusions import conclusions, question
from experiments.sweeps.families import covariance_lines, discrepancies, noise_groups
from experiments.sweeps.rows import runs_of
from experiments.sweeps.tables import failure_rows, summary, table_note
from mvest.estimation.estimate import NOT_THE_POSTERIOR
from tests.experiments.sweeps.synthetic_sweeps import (
    ALL,
    FAILED,
    TRUTH,
    all_failed,
    correlated_noise,
    empty,
    failed_run,
    filter_conditions,
    filters,
    initial_guess,
    job,
    run,
    sweep,
    truths,
)


def noisy() -> Sweep:
    """White noise near the bound, correlated noise with twice its errors."""
    jobs = []
    for kind, factor in (("white", 1.0), ("correlated", 2.0)):
        errors = [factor * e for e in (0.05, -0.05, 0.15, -0.15)]
        runs = [
            run(s, np.add(TRUTH, [e, 0.0]), [0.1, 0.1], bound=[0.1, 0.1])
            for s, e in enumerate(errors, 1)
        ]
        jobs.append(job({"kind": kind, "noise_mm": 0.5}, [*runs, failed_run(9, "no")]))
    return sweep("noise", jobs)


def test_noise_table_answers_both_questions_in_columns() -> None:
    rows, reading = summary(noisy())
    assert [(r["kind"], r["noise [mm]"], r["parameter"]) for r in rows] == [
        ("white", 0.5, "E_f.anterior"),
        ("white", 0.5, "E_f.posterior"),
        ("correlated", 0.5, "E_f.anterior"),
        ("correlated", 0.5, "E_f.posterior"),
    ]
    white, _, correlated, _ = rows
    # Mean square (2 x 0.0025 + 2 x 0.0225) / 4 = 0.0125, four times that for the other.
    assert white["RMSE [MPa]"] == pytest.approx(math.sqrt(0.0125))
    assert white["RMSE / bound"] == pytest.approx(math.sqrt(1.25))
    assert correlated["RMSE / bound"] == pytest.approx(2 * math.sqrt(1.25))
    assert [r["RMSE within 1.5 x bound"] for r in rows] == ["yes", "yes", "no", "yes"]
    # 0.15 is within 1.96 x 0.1; of 0.1, 0.1, 0.3, 0.3 one half is.
    assert white["coverage of 95 % [%]"] == 100
    assert correlated["coverage of 95 % [%]"] == 50
    assert (white["runs"], white["failed"]) == (4, 1)
    assert reading[0]["n"] == "4 (+1 failed)"
    assert reading[2]["RMSE / bound"] == "2.24 ± 0.79"
    assert reading[2]["≤ 1.5"] == "no"
    assert reading[2]["90–98 %"] == "no"
    assert reading[0]["RMSE [MPa]"] == "0.11"


def test_without_noise_nothing_is_judged() -> None:
    runs = [run(s, TRUTH, [0.1, 0.1], bound=[0.1, 0.1]) for s in (1, 2)]
    rows, reading = summary(sweep("noise", [job({"kind": "white", "noise_mm": 0.0}, runs)]))
    assert rows[0]["RMSE within 1.5 x bound"] == ""
    assert reading[0]["90–98 %"] == "–"


def test_noise_conclusions_follow_from_the_numbers() -> None:
    said = conclusions(noisy())
    assert "in 3 of 4 combinations" in said[0]
    assert "largest ratio is 2.24 (correlated, 0.5 mm; anterior)" in said[0]
    assert said[1] == "It is above that for “correlated, 0.5 mm”."
    assert "smallest coverage is 50 % (correlated, 0.5 mm; anterior)" in said[2]
    assert said[-1] == "2 of 10 runs failed: 2 × no."


def test_failures_are_counted_by_their_kind_whatever_their_numbers() -> None:
    doubts = [f"no rounds left{NOT_THE_POSTERIOR}: {x} above 0.25" for x in (0.31, 0.72)]
    lost = [failed_run(k, reason) for k, reason in enumerate([*doubts, "no rounds left"], 2)]
    runs = [run(1, TRUTH, [0.1, 0.1]), *lost]
    made = sweep("noise", [job({"kind": "white", "noise_mm": 0.5}, runs)])
    assert conclusions(made)[-1] == (
        f"3 of 4 runs failed: 2 × no rounds left{NOT_THE_POSTERIOR}; 1 × no rounds left."
    )
    assert [row["seed"] for row in failure_rows(made)] == ["2, 3", "4"]


def test_starts_are_counted_per_filter_below_the_papers_row() -> None:
    rows, reading = summary(initial_guess())
    assert [row["setting"] for row in rows] == ["paper, Table 1", "iterated", "paper"]
    assert rows[0]["estimate E_f.anterior [MPa]"] == 6.02
    assert rows[0]["largest error E_f.posterior [%]"] == 1.91
    assert rows[0]["starts"] is None
    assert [row["starts"] for row in rows[1:]] == [36, 36]
    assert reading[1]["within 0.1 %"] == "35 of 36"
    assert reading[0]["starts"] == "–"
    assert {tuple(row) for row in reading} == {tuple(reading[0])}


def starts(errors: dict[str, list[float | None]]) -> Sweep:
    """A sweep over guesses with these errors in percent; None is a failure."""
    jobs = []
    for mode, percent in errors.items():
        for k, error in enumerate(percent):
            factors = {"start_anterior": 1.0 + k, "start_posterior": 1.0, "filter": mode}
            good = error is not None
            runs = [run(1, TRUTH * (1 + error / 100), [0.1, 0.1])] if good else []
            jobs.append(job(factors, runs, "" if good else FAILED["time"], filter=mode))
    return sweep("initial_guess", jobs)


def test_basin_is_told_in_one_sentence() -> None:
    said = conclusions(starts({"iterated": [0.01, 0.02, 0.0], "paper": [0.05, 2.0, None]}))
    assert said[0] == (
        "3 of 3 starts converge to within 0.1 % in the iterated mode, 1 of 3 in the paper mode."
    )
    assert any("2 starts outside this basin in the paper mode, 1 failed" in s for s in said)
    assert FAILED["time"] in said[-1]
    # With other numbers it says something else.
    said = conclusions(starts({"iterated": [0.2, None]}))
    assert said[0] == "0 of 2 starts converge to within 0.1 % in the iterated mode."


def test_discrepancies_are_ranked_without_sign() -> None:
    percent = {"none": 0.001, "pressure +10 %": -12.0, "finer mesh": 3.0, "other law": -4.0}
    jobs = [
        job({"discrepancy": name}, [run(1, TRUTH * [1 + e / 100, 1.0], [0.1, 0.1])])
        for name, e in percent.items()
    ]
    said = conclusions(sweep("discrepancy", jobs))
    assert said[0] == (
        "The largest error comes from “pressure +10 %”: -12 % of the anterior modulus."
    )
    assert said[1] == "Next come “other law” (-4 %, anterior) and “finer mesh” (+3 %, anterior)."
    # 3 % and 4 % of 6.23 are 0.19 and 0.25 MPa, the interval reaches 0.196; posterior is exact.
    assert "contains the truth in 4 of 6 moduli" in said[3]


def test_a_large_error_on_one_mesh_is_not_lost_in_the_mean_over_meshes() -> None:
    errors = {"tet10": (16.4, 8.0, 5.0), "finer": (9.0, 2.0, -2.0), "law": (-1.0, 0.5, 0.1),
              "ratio": (-12.0, -12.5, -12.1), "chords": (1.2, 1.3, 1.1)}  # fmt: skip
    cells = [(36, 4, 1), (54, 6, 1), (72, 8, 1)]
    jobs = [
        job(
            {"truth": name},
            [run(1, TRUTH * [1.0, 1 + e / 100], [0.1, 0.1])],
            hash=f"{name}{k}",
            model={"element": "hex18", "cells": cells[k]},
        )
        for name, percent in errors.items()
        for k, e in enumerate(percent)
    ]
    said = conclusions(sweep("discrepancy", jobs))
    assert said[0].endswith("“tet10”: +16.4 % of the posterior modulus on 36 x 4 x 1 cells.")
    assert said[1] == (
        "Next come “ratio” (-12.5 %, posterior on 54 x 6 x 1 cells), “finer” (+9 %, posterior on "
        "36 x 4 x 1 cells) and “chords” (+1.3 %, posterior on 54 x 6 x 1 cells)."
    )


def test_covariance_says_which_matters() -> None:
    jobs = []
    for varied, error, std in (("P0", 5.0, 0.1), ("R", 0.05, 1.0)):
        for scale in (0.1, 10.0):
            factors = {"varied": varied, "scale": scale, "filter": "paper"}
            estimate = TRUTH * (1 + (error if scale > 1 else 0.01) / 100)
            jobs.append(job(factors, [run(1, estimate, [0.1, std if scale > 1 else 0.1])]))
    said = conclusions(sweep("covariance", jobs))
    assert "depends most on P0 in the paper mode: from 0.1 to 10" in said[0]
    assert "between 0.01 and 5 %" in said[0]
    assert said[1].endswith("of R in the paper mode.")
    assert "depends most on R in the paper mode: it changes by a factor of 10." in said[2]


def test_filters_are_compared_and_failures_keep_their_reason() -> None:
    rows, reading = summary(filters())
    assert "coverage of 95 % E_f.anterior, low [%]" in rows[0]
    assert reading[-1]["failures"] == FAILED["time"]
    assert reading[-1]["E_f.anterior [MPa]"] == "–"
    assert "takes the fewest forward solves: 2, at" in conclusions(filters())[1]


def test_values_of_a_covariance_are_followed_with_the_others_kept() -> None:
    jobs = []
    for p0, q, error in ((0.1, 0.0, 4.0), (9.0, 0.0, 1.0), (0.1, 1.0, 3.0), (9.0, 1.0, 0.5)):
        factors = {"filter": "paper", "P0": p0, "Q": q, "R": 0.01}
        jobs.append(job(factors, [run(1, TRUTH * (1 + error / 100), [0.1, 0.1])], filter="paper"))
    whole = sweep("covariance", jobs)
    lines = covariance_lines(runs_of(whole))
    assert [(line.quantity, line.others) for line in lines] == [
        ("P0", "Q 0"), ("P0", "Q 1"), ("Q", "P0 0.1"), ("Q", "P0 9")
    ]  # fmt: skip
    # Along P0 the error falls by 3 (Q = 0) and 2.5, along Q by 1 and 0.5.
    assert (
        "depends most on P0 in the paper mode: from 0.1 to 9, Q 0, the largest error of a modulus "
        "lies between 1 and 4 %"
    ) in conclusions(whole)[0]
    assert summary(whole)[1][0]["setting"] == "P0 0.1, Q 0"


def test_noise_of_one_kind_is_parted_by_what_the_filter_is_told() -> None:
    groups = noise_groups(runs_of(correlated_noise(2)))
    assert [(group.label, len(group.runs)) for group in groups] == [
        ("white, 0.1 mm", 4),
        ("white, 0.5 mm", 4),
        ("white, 1 mm", 4),
        ("correlated over 5 mm, R correlation 0 mm, 0.5 mm", 4),
        ("correlated over 5 mm, R correlation 5 mm, 0.5 mm", 4),
        ("white, coaptation hidden, 0.5 mm", 4),
        ("white, annulus 1 mm off, 0.5 mm", 4),
    ]
    rows, _ = summary(correlated_noise(2))
    assert [row["noise [mm]"] for row in rows[6:8]] == [0.0, 0.0]
    # Correlated errors are errors: what they do to the intervals is judged.
    assert rows[6]["95 % interval covers 90-98 %"] != ""


def test_a_truth_is_a_discrepancy_unless_it_is_the_model() -> None:
    said, named = conclusions(truths()), conclusions(ALL["discrepancy"]())
    assert said == named
    jobs = [
        job({"truth": "finer mesh", "mesh": mesh}, [run(1, TRUTH * (1 + e / 100), [0.1, 0.1])])
        for mesh, e in (("medium", 2.0), ("fine", 1.0))
    ]
    assert list(discrepancies(runs_of(sweep("discrepancy", jobs)))) == [
        "finer mesh, medium", "finer mesh, fine"
    ]  # fmt: skip


def test_filters_are_compared_under_equal_conditions() -> None:
    said = conclusions(filter_conditions())
    for condition in ("posterior 3 MPa, noise 0 mm", "6 MPa, noise 0 mm", "3 MPa, noise 0.5 mm"):
        assert sum(f"{condition}) is that of" in s and "smallest" in s for s in said) == 1
    assert "“paper, log”" in " ".join(said)


def test_an_unknown_kind_is_tabulated_and_says_so() -> None:
    rows, reading = summary(ALL["astrology"]())
    assert [row["moon phase"] for row in rows] == [0, 1]
    assert [row["setting"] for row in reading] == ["moon phase 0", "moon phase 1"]
    assert "kind “astrology” have no figures of their own" in conclusions(ALL["astrology"]())[0]
    incomplete = sweep("noise", [job({"kind": "white"}, [run(1, TRUTH, [0.1, 0.1])])])
    assert "lacks the factor noise_mm" in conclusions(incomplete)[0]


def test_failures_of_one_job_for_one_reason_are_one_row() -> None:
    runs = [failed_run(s, "bad") for s in (1, 2, 3)] + [failed_run(5, "worse")]
    found = failure_rows(sweep("x", [job({"a": 1}, runs), job({"a": 2}, [], "killed")]))
    assert [(row["seed"], row["reason"]) for row in found] == [
        ("1 to 3", "bad"),
        ("5", "worse"),
        ("all (no result)", "killed"),
    ]


@pytest.mark.parametrize("kind", list(ALL))
def test_nothing_follows_from_nothing(kind: str) -> None:
    assert summary(empty(kind)) == ([], [])
    assert conclusions(empty(kind)) == ["The sweep has no jobs, so nothing follows from it."]
    lost = all_failed(kind)
    rows, reading = summary(lost)
    assert rows
    assert {tuple(row) for row in reading} == {tuple(reading[0])}
    first, last = conclusions(lost)
    assert first.startswith("None of the ")
    assert FAILED["memory"] in last
    assert question(lost).endswith("?")
    assert "simulated" in table_note(lost)
