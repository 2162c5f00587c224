"""The gate's verdict: one table for all anatomies, and what other studies say of theirs."""

import json
from dataclasses import replace

import pytest

from experiments.common.building.gate import anatomy_digest, gate_of
from experiments.common.places import ANATOMIES, GATE_RECORDS
from experiments.common.records.record import (
    NOT_GATED,
    Mesh,
    Outcome,
    has_passed,
    read_record,
    stamp,
    write_record,
)
from experiments.common.records.report import cautions, page
from experiments.studies.gate.findings import Findings, Followed, Limits, Row
from experiments.studies.gate.report import gate_answer, gate_table, gate_words, write_gate
from mvest.closure.robustness import MAX_LIMIT, MEAN_LIMIT
from mvest.closure.smoothness import JUMP_LIMIT, SEEN, SIDE_LIMIT, SLOPE_LIMIT
from tests.experiments.configured import composed, plain
from tests.places import CONF

LIMITS = Limits(MEAN_LIMIT, MAX_LIMIT, JUMP_LIMIT, SEEN, SLOPE_LIMIT, SIDE_LIMIT)


def findings(values, *rows, path=None, gap=0.0):
    path = path or Followed("E_f", 0.004, 0.01, 0.03, 4, True, "")
    passed = path.passed and all(row.passed for row in rows)
    reference = Row("reference", 0.0, 0.0, True, 1.0, "converged")
    return Findings(
        anatomy=anatomy_digest(values),
        passed=passed,
        gap_mm2=gap,
        passing_ball_mm=0.0,
        rows=(reference, *rows),
        paths=(path,),
        limits=LIMITS,
    )


def record_of(values, found):
    outcome = Outcome(findings=found, mesh=Mesh("a" * 64, 10), row=values["valve_name"])
    return stamp(values, "b" * 64, outcome, 0.0)


def settings(name, *more):
    return plain(composed("experiment=gate", f"valve={name}", *more)) | {"valve_name": name}


@pytest.fixture(scope="module")
def calm():
    values = settings("template")
    return record_of(values, findings(values, Row("mesh x 1.5", 0.01, 0.07, True, 2.0, "")))


@pytest.fixture(scope="module")
def jumping():
    values = settings("prolapse")
    reason = "a jump of 0.7 mm at 9 vertices between +5 % and +6 %"
    path = Followed("E_f", 0.7, 0.2, 0.06, 9, False, reason)
    rows = (
        Row("mesh x 1.5", None, None, False, 2.0, "it buckled"),
        Row("ramp / 3", 0.05, 0.61, False, 2.0, "converged"),
    )
    return record_of(values, findings(values, *rows, path=path, gap=1.9))


def test_the_answer_names_who_fails_and_by_what(calm, jumping):
    said = gate_answer({"a": calm, "b": jumping})
    assert said.startswith("Gate passed by 1 of 2 anatomies (template); NOT passed by prolapse (")
    assert "mesh x 1.5: it buckled; ramp / 3: 0.61 mm off; E_f: a jump of 0.7 mm" in said
    assert "NOT" not in gate_answer({"a": calm})


def test_all_anatomies_are_one_table_and_what_was_not_run_says_so(calm, jumping, tmp_path):
    words = gate_words({"a": calm, "b": jumping})
    assert "| mesh x 1.5 | 0.01 / 0.07 | - **no** |" in words
    assert "| ramp / 3 | not run | 0.05 / 0.61 **no** |" in words
    assert "| E_f | 0.004 mm, 1 % (3 %) | 0.7 mm, 20 % (6 %) **no** |" in words
    assert "| template | passed | 0 | 0 |" in words
    assert "| prolapse | **NOT passed**: mesh x 1.5: it buckled" in words
    assert "| 1.9 | 0 |" in words
    table = gate_table({"a": calm, "b": jumping})
    assert list(table.anatomy) == ["template"] * 2 + ["prolapse"] * 3 + ["template", "prolapse"]
    assert list(table.passed) == [True, True, True, False, False, True, False]
    files = write_gate(tmp_path, {"a": calm, "b": jumping}, {})
    assert {path.name for path in files} == {"gate.csv", "gate.md"}
    others = sorted(set(ANATOMIES) - {"template", "prolapse"})
    assert f"Not asked yet: {', '.join(others)}." in (tmp_path / "gate.md").read_text()


def test_a_record_comes_back_as_it_was_written(jumping, tmp_path):
    write_record(tmp_path / "gate.json", jumping)
    assert read_record(tmp_path / "gate.json", Findings).findings == jumping.findings


def test_a_verdict_is_looked_up_by_the_anatomy_and_not_by_its_name(calm, jumping, tmp_path):
    write_record(tmp_path / "one.json", calm)
    write_record(tmp_path / "two.json", jumping)
    (tmp_path / "torn.json").write_text("{", encoding="utf-8")
    (tmp_path / "other.json").write_text(json.dumps({"findings": []}), encoding="utf-8")
    assert gate_of(settings("template"), tmp_path) == "passed on 54 x 6 hex18"
    assert gate_of(settings("prolapse"), tmp_path) == "NOT passed on 54 x 6 hex18"
    # Whatever else is configured, the anatomy is the same; a millimetre is another one.
    assert gate_of(settings("template", "mesh.columns=40"), tmp_path).startswith("passed")
    wider = settings("template", "valve.annulus.anteroposterior_half_axis=15.0")
    assert gate_of(wider, tmp_path) == NOT_GATED
    assert gate_of(settings("half_open"), tmp_path) == NOT_GATED
    assert gate_of(settings("template"), tmp_path / "none") == NOT_GATED


def test_a_record_says_the_verdict_in_its_line_where_it_has_one(calm):
    values = settings("template")
    outcome = Outcome(findings=None, gate="NOT passed on 54 x 6 hex18")
    line = stamp(values, "b" * 64, outcome, 0.0).line
    assert line.endswith("seed 1; gate of the anatomy: NOT passed on 54 x 6 hex18")
    assert "gate of" not in stamp(values, "b" * 64, replace(outcome, gate=None), 0.0).line


def test_every_anatomy_that_ships_is_one_of_those_that_are_asked():
    asked = CONF.joinpath("experiment", "gate.yaml").read_text(encoding="utf-8")
    (line,) = (line for line in asked.splitlines() if line.strip().startswith("valve:"))
    assert sorted(line.partition(":")[2].strip().split(",")) == list(ANATOMIES)


@pytest.mark.parametrize("path", sorted(GATE_RECORDS.glob("*.json")), ids=lambda path: path.stem)
def test_kept_verdicts_are_of_the_anatomies_as_they_ship(path):
    record = read_record(path, Findings)
    assert record.findings.anatomy == anatomy_digest(settings(record.row))
    rows, paths = record.findings.rows, record.findings.paths
    assert record.findings.passed == all(one.passed for one in (*rows, *paths))
    assert record.findings.limits == LIMITS
    # Dilated and tethered leaflets alone leak; all others close, seen as predictions see them.
    assert (record.findings.gap_mm2 == 0.0) == (record.row != "functional_mr")


def test_what_has_not_passed_says_so_before_its_results(calm):
    values = settings("template")

    def stamped(gate):
        return stamp(values, "b" * 64, Outcome(findings=None, row=f"on {gate}", gate=gate), 0.0)

    passed, failed = stamped("passed on 54 x 6 hex18"), stamped("NOT passed on 54 x 6 hex18")
    never, none = stamped(NOT_GATED), stamped(None)
    assert [has_passed(r.gate) for r in (passed, failed, never)] == [True, False, None]
    assert passed.caution == none.caution == ""
    assert "did NOT pass the gate (NOT passed on 54 x 6 hex18)" in failed.caution
    assert "experiment=gate" in never.caution
    title = "# One closed state\n\n"
    assert page(passed, "words").startswith(f"{title}words")
    assert page(failed, "words").startswith(f"{title}**The anatomy did NOT pass the gate")
    # Of several, those that it is said of are named.
    assert cautions([failed]) == [failed.caution]
    assert cautions([passed, failed]) == [f"on NOT passed on 54 x 6 hex18: {failed.caution}"]
    assert cautions([passed, none]) == []
