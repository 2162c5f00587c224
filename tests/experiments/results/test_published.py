"""Published records: stored, checked, and everything that follows from them."""

import json

import numpy as np
import pytest

from experiments.cli import main
from experiments.common.records.record import Record
from experiments.results.published import publish, records_of, regenerate
from experiments.studies.twin import STUDY
from experiments.sweeps.collected import Sweep, write_sweep_file
from experiments.sweeps.report import write_sweep
from mvest.errors import InputError
from tests.experiments.studies.made_up import made_up_twin
from tests.experiments.sweeps.made_up_sweeps import TRUTH, job, run, sweep
from tests.places import ROOT


def kept(results, name: str, record: Record) -> None:
    """Publish a made-up run that left no arrays."""
    publish(STUDY, results, record.table, {name: (record, results / "no such folder")})


def files(folder, table: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob(f"{table}.*")}


def test_tables_grow_with_the_records_and_need_nothing_else(tmp_path) -> None:
    kept(tmp_path, "table1", made_up_twin())
    other = made_up_twin(row="independent truth", experiment="table1_independent")
    kept(tmp_path, "independent", other)
    before = files(tmp_path, "table1")
    assert set(before) == {"table1.csv", "table1.md", "table1.tex", "table1.png", "table1.pdf"}
    rows = (tmp_path / "table1.md").read_text(encoding="utf-8")
    assert rows.index("same model") < rows.index("independent truth")
    for name in before:
        (tmp_path / name).unlink()
    regenerate(tmp_path)
    assert before == files(tmp_path, "table1")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not JSON"),
        (json.dumps({"name": "a", "record": {"version": 2}}), "no record of this version"),
        (json.dumps({"name": "a", "record": {"version": 3}}), "record a: study: .*Field required"),
    ],
)
def test_a_damaged_record_is_named(tmp_path, text: str, words: str) -> None:
    place = tmp_path / "records"
    place.mkdir(parents=True)
    (place / "table1.jsonl").write_text(text)
    with pytest.raises(InputError, match=words):
        regenerate(tmp_path)


def test_a_record_with_other_numbers_is_refused(tmp_path) -> None:
    kept(tmp_path, "table1", made_up_twin())
    path = tmp_path / "records" / "table1.jsonl"
    before = path.read_text()
    data = json.loads(before)
    data["record"]["estimates"][0]["unknowns"][0]["estimate"] += 0.1
    without = json.loads(before)
    del without["record"]["sha256"]
    for changed in (data, without):
        path.write_text(json.dumps(changed))
        with pytest.raises(InputError, match=r"record table1: its content is not what was written"):
            regenerate(tmp_path)
    # The order of keys is no content.
    path.write_text(json.dumps(json.loads(before), sort_keys=True))
    assert regenerate(tmp_path)
    (tmp_path / "records" / "table1").mkdir()
    np.savez(tmp_path / "records" / "table1" / "table1.npz", x=np.ones(2))
    with pytest.raises(InputError, match="its file of arrays is not the one"):
        regenerate(tmp_path)


def test_every_committed_record_is_as_it_was_written() -> None:
    tables = sorted(path.stem for path in (ROOT / "results" / "records").glob("*.jsonl"))
    assert {"table1", "population", "volume"} <= set(tables)
    for table in tables:
        found = records_of(ROOT / "results", table)
        assert found.records
        assert all(record.table == table for record in found.records.values())


def test_the_tables_of_a_page_are_of_the_same_runs() -> None:
    # A table that its study no longer writes would stay as it was.
    pages: dict[str, set[str]] = {
        path.stem: set() for path in (ROOT / "results" / "records").glob("*.jsonl")
    }
    for path in (ROOT / "results").glob("*.csv"):
        of = [page for page in pages if f"{path.stem}_".startswith(f"{page}_")]
        if of:
            first, _, _ = path.read_text(encoding="utf-8").partition("\n")
            pages[max(of, key=len)].add(first)
    assert {page: first for page, first in pages.items() if len(first) != 1} == {}


def small() -> Sweep:
    jobs = [job({"filter": name}, [run(1, TRUTH * 1.02, [0.1, 0.1])]) for name in ("ekf", "iekf")]
    return sweep("filter", [*jobs, job({"filter": "lost"}, [], "killed (signal 9)")])


def test_tables_are_made_again_from_published_sweeps_alone(tmp_path, capsys) -> None:
    place = tmp_path / "sweeps" / "filter.json"
    place.parent.mkdir()
    write_sweep_file(place, small())
    write_sweep(tmp_path, small())
    before = {path.name: path.read_bytes() for path in tmp_path.glob("sweep_*")}
    for name in before:
        (tmp_path / name).unlink()
    assert main(["tables", str(tmp_path)]) == 0
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("sweep_*")}
    kept(tmp_path, "table1", made_up_twin())
    assert main(["tables", str(tmp_path)]) == 0
    assert (tmp_path / "table1.md").is_file()
    place.write_text("{", encoding="utf-8")
    assert main(["tables", str(tmp_path)]) == 2
    assert "filter.json is not JSON" in capsys.readouterr().err
