import json
from typing import Any

import numpy as np
import pytest

from experiments.common.records.record import require_written
from experiments.results.keep import publish, regenerate
from experiments.studies.twin.study import STUDY
from experiments.tables import main
from mvest.errors import InputError
from mvest.provenance import require_sealed
from tests.places import ROOT
from tests.reporting.records import failed_record, record, twin


def kept(results, name: str, data: dict[str, Any]) -> None:
    """Publish a made-up run that left no arrays."""
    publish(STUDY, results, {name: (twin(data), results / "no such folder")})


def test_tables_grow_with_the_records_and_need_nothing_else(tmp_path) -> None:
    kept(tmp_path, "table1", record())
    kept(
        tmp_path,
        "table1_independent",
        record(row="independent truth", experiment="table1_independent"),
    )
    before = {path.name: path.read_bytes() for path in tmp_path.glob("table1.*")}
    assert set(before) == {"table1.csv", "table1.md", "table1.tex", "table1.png", "table1.pdf"}
    rows = (tmp_path / "table1.md").read_text(encoding="utf-8")
    assert rows.index("same model") < rows.index("independent truth")
    for path in tmp_path.glob("table1.*"):
        path.unlink()
    regenerate(tmp_path)
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("table1.*")}


def test_each_table_takes_its_own_records(tmp_path) -> None:
    kept(tmp_path, "table1", record())
    kept(tmp_path, "meshes-a", failed_record(table="meshes", row="a"))
    assert "a" not in [
        line.split("|")[1].strip() for line in (tmp_path / "table1.md").read_text().splitlines()[3:]
        if line.startswith("|")
    ]  # fmt: skip
    assert "not converged" in (tmp_path / "meshes.md").read_text()


def test_an_empty_folder_says_what_to_run(tmp_path) -> None:
    with pytest.raises(InputError, match=r"experiments\.run experiment=table1"):
        regenerate(tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not JSON"),
        (json.dumps({"study": "twin", "a": 1}), "no record of a run: schema: Field required"),
        (json.dumps({"a": 1}), "study = 'None', expected one of"),
        ("3", "holds a int"),
    ],
)
def test_a_damaged_record_is_named(tmp_path, text: str, words: str) -> None:
    place = tmp_path / "records" / "table1"
    place.mkdir(parents=True)
    (place / "bad.json").write_text(text)
    with pytest.raises(InputError, match=words):
        regenerate(tmp_path)


def test_a_record_with_other_numbers_is_refused(tmp_path) -> None:
    kept(tmp_path, "table1", record())
    path = tmp_path / "records" / "table1" / "table1.json"
    before = path.read_text()
    data = json.loads(before)
    data["findings"]["repeats"][0]["estimate"][0] += 0.1
    without = {key: value for key, value in json.loads(before).items() if key != "sha256"}
    for changed in (data, without):
        path.write_text(json.dumps(changed))
        with pytest.raises(InputError, match=r"table1\.json: its content is not what was written"):
            regenerate(tmp_path)
    # How it is laid out is none of its content.
    path.write_text(json.dumps(json.loads(before), indent=8, sort_keys=True))
    assert regenerate(tmp_path)
    np.savez(path.with_suffix(".npz"), x=np.ones(2))
    with pytest.raises(InputError, match=r"table1\.json: the arrays beside it are not those"):
        regenerate(tmp_path)


def test_every_committed_result_is_as_it_was_written(capsys) -> None:
    results = ROOT / "results"
    paths = [*(results / "records").glob("*/*.json"), *(results / "sweeps").glob("*.json")]
    assert len(paths) > 70
    for path in paths:
        data = json.loads(path.read_text(encoding="utf-8"))
        require_sealed(data, str(path))
        if path.parent.parent.name == "records":
            require_written(data, path)


def test_the_tables_command_refuses_a_changed_record_in_one_line(tmp_path, capsys) -> None:
    kept(tmp_path, "table1", record())
    path = tmp_path / "records" / "table1" / "table1.json"
    path.write_text(path.read_text().replace('"seed": ', '"seed": 1'))
    assert main([str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {path}: its content is not what was written")
