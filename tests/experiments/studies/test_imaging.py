"""The study of the image step, in a size that takes seconds."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.common.records.record import Record, read_record
from experiments.results.published import records_of
from experiments.run import main
from experiments.studies.imaging.detectors import ImagingSettings, ImagingStore
from experiments.studies.imaging.study import STUDY as IMAGING
from experiments.studies.imaging.study import calibrated, error_rows, judge, kind_rows
from mvest.errors import InputError
from mvest.imaging.detection.trained_model import DetectionModel, load_model, save_model
from mvest.reporting.tables import table
from mvest.simulation.trials import KINDS
from tests.experiments.configured import composed, plain
from tests.places import ROOT

STUDY = (
    "experiment=imaging",
    "imaging=small",
    "tracking.enabled=false",
    # Two frames, and half the voxels in the same field of view.
    "imaging.motion.frames=2",
    "imaging.training.acquisition.voxel_mm=2.5",
    "imaging.training.acquisition.shape=[40,32,40]",
)


def values_of(*overrides: str) -> dict:
    return plain(composed("experiment=imaging", "imaging=small", *overrides))


def call(place: Path, *arguments: str) -> int:
    """Run the study in a folder; returns the exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setattr(sys, "argv", ["experiments.run", *STUDY, *arguments])
        return main()


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Path:
    """A folder in which the whole study was run, in ``run``."""
    place = tmp_path_factory.mktemp("imaging")
    assert call(place, "hydra.run.dir=run") == 0
    return place


def settings_of(*overrides: str) -> ImagingSettings:
    return IMAGING.settings_of(values_of(*overrides))


def store_of(*overrides: str) -> ImagingStore:
    return ImagingStore(values_of(*overrides), settings_of(*overrides))


def record_of(place: Path, run: str = "run") -> Record:
    return read_record(place / run / "result.json")


def changed(place: Path) -> dict[str, int]:
    """Which writing each file of the store is of: reading one changes its time alone."""
    root = place / "outputs" / "detectors"
    return {str(p.relative_to(root)): p.stat().st_ino for p in root.rglob("*.npz")}


@pytest.mark.slow
def test_the_study_says_how_far_detectors_are_off(done: Path):
    record = record_of(done)
    assert (record.status, record.reason) == ("converged", "trained and tested")
    kinds = record.table_of().rows
    assert {row["kind"]: row["volumes"] for row in kinds} == dict(
        zip(KINDS, (2, 2, 1, 1, 1, 2, 2, 1, 1), strict=True)
    )
    coverage = record.table_of("coverage").rows
    assert [(row["kind"], row["frame"]) for row in coverage] == [
        (kind, frame) for kind in ("sequence", "shifted sequence") for frame in ("open", "closed")
    ]
    for row in coverage:
        assert min(row["rms_handed_on"], row["stated_handed_on"]) > 0


@pytest.mark.slow
def test_what_is_tested_on_was_not_trained_on(done: Path):
    record, trained = record_of(done), load_model(done / "run" / "tee.npz").trained_on
    trials = record.table_of("trials").rows
    calibrated_on = {row["valve"] for row in trials if "calibration" in row["kind"]}
    tested = {row["valve"] for row in trials} - calibrated_on
    assert len(trained["valves"]) == 4
    assert set(trained["calibrated_on"]) == calibrated_on
    assert len(calibrated_on) == len(tested) == 2
    groups = (set(trained["valves"]), calibrated_on, tested)
    assert len(set.union(*groups)) == sum(map(len, groups))


@pytest.mark.slow
def test_an_interrupted_study_goes_on_where_it_was(done: Path):
    again, before = done / "again", record_of(done)
    store = changed(done)
    parts = ("trials", "samples", "models")
    lost = {next(name for name in store if name.startswith(part)) for part in parts}
    for name in lost:
        # Kept elsewhere, so that what is written anew cannot get its inode.
        (done / "outputs" / "detectors" / name).rename(done / name.replace("/", "_"))
    assert call(done, f"hydra.run.dir={again.name}") == 0
    now = changed(done)
    assert set(now) == set(store)
    assert {name for name in now if now[name] != store[name]} == lost
    after = record_of(done, "again")
    assert after.tables == before.tables
    assert after.numbers == before.numbers


@pytest.mark.slow
def test_given_detectors_are_tested_and_none_is_trained(done: Path, capsys):
    before, first = changed(done), load_model(done / "run" / "tee.npz")
    # The measured accuracy of detectors does not affect detection, so their trials are cached.
    own = done / "given.npz"
    save_model(own, DetectionModel(first.shape, first.boosters, {**first.trained_on, "by": 2}))
    given = f"imaging.model={own}"
    assert call(done, given, "hydra.run.dir=given") == 0
    record = record_of(done, "given")
    assert record.reason == "tested"
    assert record.numbers["training_volumes"] == 6
    assert record.tables == record_of(done).tables
    assert load_model(done / "given" / "tee.npz").accuracy.widening == first.accuracy.widening
    assert changed(done) == before
    capsys.readouterr()
    assert call(done, given, "imaging.train.seed=9", "imaging.calibration.seed=1") == 2
    assert "was trained on, expected other valves" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("imaging.test.seed=1", "expected different seeds"),
        ("imaging.train.count=0", "imaging.train.count = 0, expected 1 to"),
        ("imaging.training.modes=7", "imaging.training.modes = 7, expected 8 to"),
        ("imaging.motion.columns=12", "no column"),
    ],
)
def test_wrong_settings_are_refused_in_one_line(tmp_path: Path, override: str, words: str, capsys):
    assert call(tmp_path, override) == 2
    told = capsys.readouterr().err.strip()
    assert len(told.splitlines()) == 1
    assert words in told
    assert not (tmp_path / "outputs" / "detectors").exists()


def test_cached_parts_are_named_by_what_they_are_made_of():
    def names(*overrides: str) -> tuple[str, str, str]:
        store = store_of(*overrides)
        entries = store._valves("train"), store.samples_entry(0), store.model_entry()
        return tuple(entry.path.stem for entry in entries)

    base = names()
    assert names("imaging.processes=2", "imaging.held_out.volumes=9") == base
    # More volumes go on from those that are there.
    other = names("imaging.training.volumes=9")
    assert other[:2] == base[:2]
    assert other[2] != base[2]
    assert names("imaging.training.draft_volumes=2")[1] != base[1]
    other = names("seed=3")
    assert other[0] == base[0]
    assert other[1] != base[1]
    assert not set(names("imaging.train.seed=9")) & set(base)


# -- tables ---------------------------------------------------------------------------------------
def test_the_published_tables_follow_from_the_published_trials():
    record = records_of(ROOT / "results", "imaging").first
    limits = ("called_a_valve_from_confidence", "not_the_valve_from_mm", "unlike_below_confidence")
    published = pd.DataFrame(record.table_of("trials").values)
    trials = judge(record.table_of("trials").rows, *(record.numbers[name] for name in limits))
    for name in ("called", "right", "unlike"):
        stored = published[name].notna()
        assert trials.loc[stored, name].tolist() == published.loc[stored, name].tolist()
    for name, rows in (("", kind_rows(trials)), ("errors", error_rows(trials))):
        # The published counts of unlike sequences follow from an earlier limit.
        now = pd.DataFrame(table(rows).values).drop(columns="unlike", errors="ignore")
        then = pd.DataFrame(record.table_of(name).values)[list(now)]
        pd.testing.assert_frame_equal(now, then, check_dtype=False, rtol=1e-12)


def sequence(kind: str, confidence: float, off: float) -> dict:
    names = ("surface", "surface_open", "surface_closed", "points", "tips", "annulus_area",
             "ap_diameter", "state_right")  # fmt: skip
    return {
        "kind": kind, "confidence": confidence, "median_confidence": confidence - 0.1,
        "valve": f"{off}", **dict.fromkeys(names, off),
    }  # fmt: skip


def test_errors_are_stated_of_valves_that_were_detected_only():
    rng = np.random.default_rng(0)

    def seen(kind: str, confidence: float, off: float):
        names = {"errors": 4, "tip_errors": 2, "shapes": 4, "tip_shapes": 2}
        arrays = {name: off + 0.1 * rng.standard_normal((2, n, 3)) for name, n in names.items()}
        rest = np.arange(12.0).reshape(4, 3)
        return sequence(kind, confidence, off), arrays | {"rest": rest}

    right = [seen("calibration", 0.9, 1.0), seen("calibration", 0.9, 2.0)]
    others = [seen("calibration", 0.8, 30.0), seen("calibration", 0.3, 3.0), seen("sequence", 1, 1)]
    accuracy, valves = calibrated([*right, *others], 0.5, 5.0)
    assert valves == ["1.0", "2.0"]
    assert len(accuracy.samples) == len(accuracy.shapes) == 2
    assert accuracy.samples.max() < 3.0
    with pytest.raises(InputError, match="in 1 of 3 volumes the valve was detected"):
        calibrated([right[0], *others], 0.5, 5.0)
