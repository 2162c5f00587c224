from mvest.problem.record import EstimateRecord, Unknown
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY, Verdict
from mvest.reporting.skill import moduli_figure, skill_table, stated, trust_of


def answered(truth, estimate, low, high, generic) -> Unknown:
    # Believed within a factor of 1.48.
    return Unknown(
        name="E_f.anterior", unit="MPa", prior_mean=generic, prior_std=0.2 * generic,
        estimate=estimate, low=low, high=high, truth=truth,
    )  # fmt: skip


ASKED = [
    answered(10.0, 11.0, 9.0, 13.0, 5.0),
    answered(10.0, 8.0, 7.0, 9.0, 15.0),
    answered(2.0, 3.0, 1.0, 5.0, 2.0),
    answered(1.0, None, None, None, 2.0),
]


def test_a_table_has_a_row_for_each_group_that_is_not_empty():
    rows = skill_table("group", {"all": ASKED, "none": []}).rows
    assert [(row["group"], row["n"], row["inside"]) for row in rows] == [("all", 4, 2)]
    assert skill_table("group", {"all": ASKED}).readable()[0]["coverage (%)"] == "67 (9 to 99)"


def test_what_the_verdict_denies_has_no_numbers():
    whole = {"reason": "converged", "unknowns": tuple(ASKED[:1])}
    sure = EstimateRecord(status="converged", verdict=Verdict(TRUSTWORTHY), **whole)
    denied = sure.model_copy(update={"verdict": Verdict(NONE)})
    lost = EstimateRecord(status="failed", **whole)
    assert [trust_of(one) for one in (sure, denied, lost)] == [TRUSTWORTHY, NONE, NONE]
    assert [one.estimate for record in (sure, denied, lost) for one in stated(record)] == [
        11.0, None, None
    ]  # fmt: skip
    assert denied.unknowns[0].estimate == 11.0


def test_the_figure_draws_every_interval_over_its_truth():
    drawn = moduli_figure({"all": [(own, DOUBTFUL) for own in ASKED]})
    (axes,) = drawn.axes
    ends = [tuple(line.get_xdata()) for line in axes.lines if len(line.get_xdata()) == 2]
    assert set(ends) >= {(0.9, 1.3), (0.7, 0.9), (0.5, 2.5)}
    assert [text.get_text() for text in axes.texts] == ["no estimate"]
