"""The RO-Crate of a run and of published results: what made what, and nothing that was typed."""

import json
from pathlib import Path

import pytest

from experiments.cli import main
from experiments.common.records.record import write_record
from experiments.runner.collecting.crate import CRATE, write_crate
from mvest.errors import InputError
from mvest.files import sha256_of
from tests.experiments.studies.made_up import made_up

DATA = {"citation": "somebody 2022", "sha256": "d" * 64}


def entities(folder: Path) -> dict[str, dict]:
    content = json.loads((folder / CRATE).read_text())
    assert content["@context"] == "https://w3id.org/ro/crate/1.1/context"
    found = {entity["@id"]: entity for entity in content["@graph"]}
    assert len(found) == len(content["@graph"])

    def references(value: object) -> list[str]:
        if isinstance(value, list):
            return [name for item in value for name in references(item)]
        return [value["@id"]] if isinstance(value, dict) else []

    # Whatever is referred to is described, but for terms of others.
    named = {name for e in found.values() for v in e.values() for name in references(v)}
    assert {name for name in named if not name.startswith("http")} <= set(found)
    assert found[CRATE]["about"] == {"@id": "./"}
    return found


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    case = {"about": {"licence": "CC BY 4.0"}}
    findings = {"estimate": [1.0], "std": [0.1], "data": DATA, "case": case}
    write_record(folder / "result.json", made_up(findings, experiment="own", title="A valve"))
    (folder / "config.json").write_text("{}")
    (folder / "log.txt").write_text("volume=DOE_JANE.dcm")
    (folder / ".lock").write_text("")
    (folder / "a picture.png").write_bytes(b"png")
    return folder


def test_a_run(run: Path, capsys) -> None:
    assert main(["crate", str(run)]) == 0
    assert capsys.readouterr().out.strip() == str(run / CRATE)
    found = entities(run)
    root = found["./"]
    assert (root["name"], root["license"]) == ("A valve", "CC BY 4.0")
    assert {part["@id"] for part in root["hasPart"]} == {
        "result.json", "config.json", "a%20picture.png",
    }  # fmt: skip
    assert found["result.json"]["sha256"] == sha256_of(run / "result.json")
    (action,) = [entity for entity in found.values() if entity["@type"] == "CreateAction"]
    assert root["mentions"] == [{"@id": action["@id"]}]
    assert {"@id": f"#data-{'d' * 64}"} in action["object"]
    assert {"@id": "config.json"} in action["object"]
    assert {"@id": "result.json"} in action["result"]
    assert {"@id": "config.json"} not in action["result"]
    assert found[action["instrument"]["@id"]]["version"] == "0" * 40
    assert action["actionStatus"]["@id"].endswith("CompletedActionStatus")
    assert "DOE_JANE" not in (run / CRATE).read_text()
    # It describes itself no second time.
    before = (run / CRATE).read_text()
    assert write_crate(run).read_text() == before


def test_published_results_and_failures(tmp_path: Path) -> None:
    for name, status in (("one", "converged"), ("two", "failed")):
        place = tmp_path / "records" / name
        place.mkdir(parents=True)
        write_record(place / f"{name}.json", made_up({}, experiment=name, status=status))
        (tmp_path / f"{name}.md").write_text(name)
    write_crate(tmp_path)
    found = entities(tmp_path)
    actions = {e["name"]: e for e in found.values() if e["@type"] == "CreateAction"}
    assert [part["@id"] for part in actions["one: r"]["result"]] == [
        "one.md",
        "records/one/one.json",
    ]
    assert "error" not in actions["one: r"]
    assert actions["two: r"]["error"] == "completed"
    assert actions["two: r"]["actionStatus"]["@id"].endswith("FailedActionStatus")


def test_what_is_refused(run: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no result.json of a run"):
        write_crate(tmp_path / "empty")
    record = run / "result.json"
    record.write_text(record.read_text().replace("A valve", "Another"))
    assert main(["crate", str(run)]) == 2
    assert "not what was written" in capsys.readouterr().err
    assert not (run / CRATE).exists()
