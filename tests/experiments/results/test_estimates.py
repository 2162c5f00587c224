"""The table of all estimates: its rows, its types, its dictionary, and what it refuses."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from pandas import read_csv, read_parquet

from experiments.cli import main
from experiments.common.records.record import write_record
from experiments.results.estimates import COLUMNS, estimate_table, write_estimates
from experiments.sweeps.collected import write_sweep_file
from mvest.errors import InputError
from mvest.problem.record import EstimateRecord, Unknown
from mvest.problem.verdict import Verdict
from tests.experiments.studies.made_up import made_up, made_up_estimate
from tests.experiments.sweeps.made_up_sweeps import TRUTH, failed_run, job, run, sweep

MODULUS = Unknown(
    name="E_f.anterior", unit="MPa", prior_mean=6.0, prior_std=3.0, estimate=5.0, std=0.5, low=4.1,
    high=6.2, truth=4.0,
)  # fmt: skip
PRESSURE = Unknown(name="pressure_scale", kind="nuisance", estimate=1.0, std=0.1)


def record(folder: Path, **header) -> Path:
    folder.mkdir(parents=True)
    write_record(folder / "result.json", made_up(**header))
    return folder / "result.json"


def swept():
    """Two jobs, the first with a failed seed, the second lost."""
    good = [run(1, TRUTH, [0.1, 0.1]), failed_run(2, "it buckled")]
    return sweep("x", [job({"noise": 0.0, "R": [0.1, 0.2]}, good), job({"noise": 0.5}, [])])


def test_a_row_for_each_unknown_of_a_case(tmp_path: Path) -> None:
    verdict = Verdict(trust="doubtful")
    whole = {"status": "converged", "reason": "", "simulated": True, "verdict": verdict}
    estimate = EstimateRecord(**whole, unknowns=(MODULUS, PRESSURE))
    record(tmp_path / "a", estimates=(estimate,))
    table = estimate_table(tmp_path)
    assert list(table.columns) == list(COLUMNS)
    assert list(table["parameter"]) == ["E_f.anterior", "pressure_scale"]
    first = table.iloc[0]
    assert (first["unit"], first["low"], first["high"]) == ("MPa", 4.1, 6.2)
    # 5 instead of 4.
    assert first["relative_error"] == pytest.approx(0.25)
    assert first["verdict"] == "doubtful"
    assert np.isnan(table["relative_error"][1])


def test_a_sweep_stands_for_its_jobs(tmp_path: Path) -> None:
    record(tmp_path / "sweep" / "jobs" / "a", estimates=(made_up_estimate(),))
    write_sweep_file(tmp_path / "sweep" / "sweep.json", swept())
    table = estimate_table(tmp_path)
    assert set(table["record"]) == {"sweep/sweep.json"}
    # Two parameters of two seeds of the first job, and the lost second one.
    assert list(table["seed"]) == [1, 1, 2, 2, 1]
    assert list(table["parameter"].isna()) == [False] * 4 + [True]


def test_both_forms_hold_the_same_and_the_dictionary_all_columns(tmp_path: Path) -> None:
    write_sweep_file(tmp_path / "sweep.json", swept())
    for name in ("t.csv", "t.parquet"):
        assert main(["table", str(tmp_path), str(tmp_path / name)]) == 0
    text, binary = read_csv(tmp_path / "t.csv"), read_parquet(tmp_path / "t.parquet")
    assert list(text.columns) == list(binary.columns)
    assert text["estimate"].to_numpy() == pytest.approx(binary["estimate"].to_numpy(), nan_ok=True)
    assert json.loads(text["factors"][0]) == {"noise": 0.0, "R": [0.1, 0.2]}
    with (tmp_path / "t.columns.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["column"] for row in rows] == list(text.columns)
    assert all(row["meaning"] and row["type"] for row in rows)
    # Every number has a unit, its own or that of its row.
    assert all(row["unit"] for row in rows if row["type"] == "number")


def test_what_is_refused(tmp_path: Path, capsys) -> None:
    with pytest.raises(InputError, match="no record of a run or sweep"):
        estimate_table(tmp_path)
    with pytest.raises(InputError, match="there is no such folder"):
        estimate_table(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"ends with .csv or .parquet"):
        write_estimates(tmp_path, tmp_path / "t.xlsx")
    place = record(tmp_path / "a", estimates=(made_up_estimate((1.0, 2.0)),))
    place.write_text(place.read_text().replace("1.0", "1.5", 1))
    assert main(["table", str(tmp_path), str(tmp_path / "t.csv")]) == 2
    damaged, nothing = capsys.readouterr().err.splitlines()
    assert "a/result.json" in damaged
    assert "no record of a run or sweep" in nothing
    assert not (tmp_path / "t.csv").exists()


def test_a_folder_of_outputs_has_copies_and_foreign_files(tmp_path: Path, capsys) -> None:
    mine = record(tmp_path / "debug" / "a", estimates=(made_up_estimate(),))
    # The record of a run with arrays, which MLflow keeps without them.
    copy = tmp_path / "mlartifacts" / "run" / "artifacts" / "result.json"
    copy.parent.mkdir(parents=True)
    copy.write_text(mine.read_text().replace('"arrays_sha256": null', '"arrays_sha256": "1"'))
    foreign = {"other/result.json": '{"a": 1}', "cut/result.json": "{", "old/sweep.json": "[]"}
    for name, text in foreign.items():
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(text)
    # What an unreadable sweep stands for is read from its jobs.
    record(tmp_path / "old" / "job", estimates=(made_up_estimate(),))
    assert main(["table", str(tmp_path), str(tmp_path / "t.csv")]) == 0
    assert set(read_csv(tmp_path / "t.csv")["record"]) == {
        "debug/a/result.json", "old/job/result.json",
    }  # fmt: skip
    warned = capsys.readouterr().err
    assert all(name in warned for name in foreign)
