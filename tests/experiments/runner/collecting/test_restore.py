"""Results that were put back to another state, and a sweep that is done."""

import json

import pytest

from experiments.common.records.record import SCHEMA, write_record
from experiments.runner.collecting.restore import restore
from experiments.runner.jobs.folder import RESULT, mark_done
from experiments.runner.planning.plan import Plan, PlannedJob
from tests.reporting.records import failed_record, record, twin


@pytest.fixture
def job(tmp_path):
    """A planned job that has ended."""

    def ended(name, data, done=True, publish_as=None):
        folder = tmp_path / "outputs" / name
        folder.mkdir(parents=True)
        found = twin({**data, "schema": SCHEMA})
        write_record(folder / RESULT, found)
        if done:
            mark_done(folder)
        values = {"study": "twin", "paths": {"results": str(tmp_path / "results")}}
        digest = found.provenance.config_hash
        return PlannedJob(digest, folder, (), values, None, done, publish_as)

    return ended


def plan_of(tmp_path, *jobs):
    return Plan("table1", tmp_path / "outputs", {}, jobs, 1)


def test_what_is_done_is_published_where_results_have_others(job, tmp_path):
    plan = plan_of(
        tmp_path,
        job("a", record(row="one"), publish_as="table1-one"),
        job("b", record(row="two"), publish_as="table1-two"),
        # Without an estimate, which this study counts; as overridden; died before its marker.
        job("c", failed_record(row="three"), done=False, publish_as="table1-three"),
        job("d", record(row="four")),
        job("e", record(row="five"), done=False, publish_as="table1-five"),
    )
    assert restore(plan) == 3
    place = tmp_path / "results" / "records" / "table1"
    kept = {path.name: path.read_bytes() for path in place.iterdir()}
    assert set(kept) == {"table1-one.json", "table1-three.json", "table1-two.json"}
    table = (tmp_path / "results" / "table1.md").read_text(encoding="utf-8")
    assert "one" in table
    assert "two" in table
    assert restore(plan) == 0

    (place / "table1-one.json").unlink()
    other = json.loads(kept["table1-two.json"])
    other["provenance"]["config_hash"] = "0" * 64
    (place / "table1-two.json").write_text(json.dumps(other))
    (tmp_path / "results" / "table1.md").unlink()
    assert restore(plan) == 2
    assert {path.name: path.read_bytes() for path in place.iterdir()} == kept
    assert (tmp_path / "results" / "table1.md").read_text(encoding="utf-8") == table
