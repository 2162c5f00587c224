import csv
import io
from dataclasses import replace

import pytest

from experiments.sweeps.collected import Sweep, check_sweep
from experiments.sweeps.rows import (
    cost_rows,
    csv_text,
    factor_label,
    kind_of,
    runs_of,
    short_names,
    sweep_line,
    tidy_rows,
)
from mvest.errors import InputError
from tests.experiments.sweeps.synthetic_sweeps import (
    ALL,
    FAILED,
    failed_run,
    job,
    noise,
    run,
    sweep,
    sweep_data,
)


def two_jobs() -> Sweep:
    """One job with a good and a bad seed, one that was killed."""
    return check_sweep(two_jobs_data(), "made up")


def two_jobs_data() -> dict:
    return sweep_data(
        "noise",
        [
            job(
                {"kind": "white", "noise_mm": 0.5},
                [run(1, [6.43, 2.0], [0.1, 0.05], bound=[0.09, 0.03]), failed_run(2, "went wrong")],
                P0=[[9.0, 0.1], [0.1, 4.0]],
                Q=[0.1, 0.2],
            ),
            job({"kind": "white", "noise_mm": 1.0}, [], FAILED["memory"]),
        ],
    )


def test_every_run_has_its_row_with_factors_first_and_failures_kept() -> None:
    rows = tidy_rows(two_jobs())
    assert list(rows[0])[:5] == ["kind", "noise [mm]", "run", "job", "seed"]
    assert [row["status"] for row in rows] == ["converged", "failed", "failed"]
    assert [row["reason"] for row in rows[1:]] == ["went wrong", FAILED["memory"]]
    assert [row["seed"] for row in rows] == [1, 2, None]
    assert rows[0]["estimate E_f.anterior [MPa]"] == 6.43
    # 6.43 is 0.2 above the truth of 6.23, 2.0 is 0.09 below 2.09.
    assert rows[0]["signed error E_f.anterior [%]"] == pytest.approx(100 * 0.2 / 6.23)
    assert rows[0]["signed error E_f.posterior [%]"] == pytest.approx(-100 * 0.09 / 2.09)
    assert rows[0]["P0 E_f.posterior [filter coordinates²]"] == 4.0
    assert rows[0]["Q E_f.posterior [filter coordinates²]"] == 0.2
    assert rows[0]["R [mm²]"] == 0.01


def test_seeds_of_a_killed_job_are_counted_where_it_says_how_many() -> None:
    killed = job({"a": 1}, [run(4, [6.2, 2.0], [0.1, 0.1])], "killed", seed=3, repeats=3)
    assert [(r.seed, r.converged) for r in runs_of(sweep("noise", [killed]))] == [
        (4, True),
        (3, False),
        (5, False),
    ]


def test_csv_is_plain_and_free_of_times() -> None:
    whole = two_jobs()
    rows = tidy_rows(whole)
    text = csv_text(rows, list(rows[0]), [sweep_line(whole)])
    assert not any("second" in name or "time" in name for name in rows[0])
    comment, *body = text.splitlines()
    assert comment.startswith("# sweep_noise: mvest 0.1.0, commit 0123456789ab, configuration cdcd")
    back = list(csv.DictReader(io.StringIO("\n".join(body))))
    assert [row["estimate E_f.anterior [MPa]"] for row in back] == ["6.43", "", ""]
    assert [row["seed"] for row in back] == ["1", "2", ""]


def test_a_line_break_in_a_reason_does_not_break_the_file() -> None:
    text = csv_text([{"reason": 'one, "two"\nthree'}], ["reason"], ["a\nb"])
    assert text == '# a b\nreason\n"one, ""two"" three"\n'


def test_costs_stand_apart() -> None:
    rows = cost_rows(two_jobs())
    # A run with 5 rounds takes 6 solves of 3.2 s, the failed one 3 solves in 9 s; 0.3 s are other.
    assert rows[0]["forward solves of all seeds"] == 9
    assert rows[0]["estimation [s]"] == pytest.approx(6 * 3.2 + 9.0)
    assert rows[0]["rest of the job [s]"] == pytest.approx(0.3)
    assert rows[1]["estimation [s]"] is None


def test_jobs_from_several_commits_are_all_named() -> None:
    whole = replace(two_jobs(), commits=("a" * 40, "b" * 40))
    assert "commit aaaaaaaaaaaa, bbbbbbbbbbbb, configuration" in sweep_line(whole)


def test_names_carry_units() -> None:
    assert factor_label("noise_mm") == "noise [mm]"
    assert factor_label("start_anterior") == "start anterior [MPa]"
    assert factor_label("kind") == "kind"
    assert short_names(["E_f.anterior", "E_f.posterior"]) == ["anterior", "posterior"]
    assert short_names(["E_f.anterior", "G.anterior"]) == ["E_f.anterior", "G.anterior"]


def test_a_kind_without_its_factors_is_no_such_kind() -> None:
    assert kind_of(noise(2)) == "noise"
    assert kind_of(sweep("noise", [job({"kind": "white"}, [])])) == ""
    assert kind_of(ALL["astrology"]()) == ""


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda s: s.pop("jobs"), "lacks jobs"),
        (lambda s: s.update(schema=1), "schema 1"),
        (lambda s: s.update(sweep={"name": "x"}), "its name and its kind"),
        (lambda s: s["jobs"][1].pop("reason"), "job 1 lacks reason"),
        (lambda s: s["jobs"][0]["runs"][0].update(estimate=[1.0]), "1 values for 2 parameters"),
    ],
)
def test_a_damaged_sweep_is_named(damage, words: str) -> None:
    whole = two_jobs_data()
    damage(whole)
    with pytest.raises(InputError, match=words):
        check_sweep(whole, "there.json")
    with pytest.raises(InputError, match=r"there\.json is no collected sweep but a list"):
        check_sweep([], "there.json")
