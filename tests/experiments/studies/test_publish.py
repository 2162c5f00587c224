import json

import pytest

from experiments.studies.twin.publish import publish, read_records, regenerate
from mvest.errors import InputError
from tests.reporting.records import failed_record, record


def test_tables_grow_with_the_records_and_need_nothing_else(tmp_path) -> None:
    publish(tmp_path, "table1", record(), tmp_path / "none.npz")
    publish(
        tmp_path,
        "table1_independent",
        record(row="independent truth", experiment="table1_independent"),
        tmp_path / "none.npz",
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
    publish(tmp_path, "table1", record(), tmp_path / "none.npz")
    publish(tmp_path, "meshes-a", failed_record(table="meshes", row="a"), tmp_path / "none.npz")
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
    [("{", "not JSON"), (json.dumps({"a": 1}), "lacks experiment"), ("3", "lacks")],
)
def test_a_damaged_record_is_named(tmp_path, text: str, words: str) -> None:
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "bad.json").write_text(text)
    with pytest.raises(InputError, match=words):
        read_records(tmp_path)
