"""The study of the image step, in a size that takes seconds."""

import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.common.records.record import Record, read_record
from experiments.common.schema import build
from experiments.run import main
from experiments.studies.imaging.detectors import ImagingSettings, ImagingStore
from experiments.studies.imaging.study import Settings, calibrated, error_rows, judge, kind_rows
from mvest.errors import InputError
from mvest.imaging.detection.trained_model import (
    STAGES,
    DetectionModel,
    load_model,
    save_model,
)
from mvest.reading.npz import read_npz
from mvest.simulation.trials import KINDS, WITHOUT_VALVE
from tests.experiments.configured import composed, plain

STUDY = (
    "experiment=imaging",
    "imaging=small",
    "tracking.enabled=false",
    # Half the voxels in the same field of view.
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
    return build(Settings, values_of(*overrides)).imaging


def store_of(*overrides: str) -> ImagingStore:
    return ImagingStore(values_of(*overrides), settings_of(*overrides))


def record_of(place: Path, run: str = "run") -> Record:
    return read_record(place / run / "result.json")


def changed(place: Path) -> dict[str, int]:
    """Which writing each file of the store is of: reading one changes its time alone."""
    root = place / "outputs" / "detectors"
    return {str(p.relative_to(root)): p.stat().st_ino for p in root.rglob("*.npz")}


def test_the_study_says_how_far_detectors_are_off(done: Path):
    record = record_of(done)
    assert (record.status, record.reason) == ("converged", "trained and tested")
    kinds = record.table_of().rows
    assert {row["kind"]: row["volumes"] for row in kinds} == dict(
        zip(KINDS, (2, 2, 1, 1, 1, 2, 2, 1, 1), strict=True)
    )
    errors = {(row["error"], row["kind"]): row for row in record.table_of("errors").rows}
    assert errors["annulus_area", "shifted"]["unit"] == "%"
    assert ("surface", "calibration") not in errors
    coverage = record.table_of("coverage").rows
    assert [(row["kind"], row["frame"]) for row in coverage] == [
        (kind, frame) for kind in ("sequence", "shifted sequence") for frame in ("open", "closed")
    ]
    for row in coverage:
        assert min(row["within_95"], row["within_95_handed_on"]) >= 0
        assert max(row["within_95"], row["within_95_handed_on"]) <= 100
        assert min(row["rms_handed_on"], row["stated_handed_on"]) > 0


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


def test_the_model_states_its_errors(done: Path):
    model, record = load_model(done / "run" / "tee.npz"), record_of(done)
    assert model.accuracy is not None
    assert model.accuracy.samples.shape == (2, 2, 80, 3)
    assert model.accuracy.tip_samples.shape == (2, 2, 2, 3)
    assert (model.accuracy.std_mm > 0).all()
    about = model.accuracy.samples - model.accuracy.samples.mean(axis=0)
    std = np.sqrt((about**2).sum(axis=(0, 1, 3)) / 6)
    assert model.accuracy.std_mm == pytest.approx(std, rel=1e-5)
    length = record.numbers["correlation_length_mm"]
    assert model.accuracy.correlation_length_mm == pytest.approx(length)
    assert model.sha256 == record.numbers["model_sha256"]
    assert model.trained_on["config_hash"] == record.provenance.config_hash


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
    assert call(done, given, "imaging.evaluate=false") == 2
    assert "nothing would be done" in capsys.readouterr().err


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
    for trees in ("imaging.training.many_trees=5", "imaging.training.volumes=9"):
        # More volumes go on from those that are there.
        other = names(trees)
        assert other[:2] == base[:2]
        assert other[2] != base[2]
    assert names("imaging.training.draft_volumes=2")[1] != base[1]
    other = names("seed=3")
    assert other[0] == base[0]
    assert other[1] != base[1]
    assert not set(names("imaging.train.seed=9")) & set(base)


def test_the_first_volumes_make_a_draft_whose_mistakes_the_others_add(done: Path):
    files = (done / "outputs" / "detectors" / "samples").glob("*.npz")
    samples = [read_npz(file) for file in files]
    assert set(samples[0]) == {f"{stage}.{axis}" for stage in STAGES for axis in "xy"}
    assert {len(each["boundary.x"]) for each in samples} == {60}
    # Of six volumes three make the draft; six poses of each other one are mistakes.
    assert sorted(len(each["pose_fine.y"]) for each in samples) == [24, 24, 24, 30, 30, 30]


# -- tables of made-up trials ---------------------------------------------------------------------
def volume(kind: str, surface: float, confidence: float = 0.9, **more) -> dict:
    return {
        "kind": kind, "confidence": confidence, "surface": surface, "points": 2 * surface,
        "tips": 1.0, "annulus_area": 2.0, "ap_diameter": -0.5, "state_right": 100.0,
    } | more  # fmt: skip


def without(kind: str, confidence: float) -> dict:
    return {"kind": kind, "confidence": confidence}


def sequence(kind: str, confidence: float, off: float) -> dict:
    names = ("surface", "surface_open", "surface_closed", "points", "tips", "annulus_area",
             "ap_diameter", "state_right")  # fmt: skip
    return {
        "kind": kind, "confidence": confidence, "median_confidence": confidence - 0.1,
        "valve": f"{off}", **dict.fromkeys(names, off),
    }  # fmt: skip


ROWS = [
    volume("shifted", 1.0),
    volume("in distribution", 0.4, annulus_area=-6.0, ap_diameter=1.0),
    volume("in distribution", 0.6, annulus_area=2.0, ap_diameter=-1.5, state_right=0.0),
    volume("in distribution", 2.0, 0.95, annulus_area=1.0, ap_diameter=-1.0, state_right=None),
    volume("in distribution", 3.0, 0.1),
    without("walls only", 0.2),
]


def by_kind(rows: list[dict], *limits: float) -> dict:
    return {row.kind: row for row in kind_rows(judge(rows, *limits)).itertuples()}


def test_a_kind_is_summarised_over_its_volumes():
    # A valve that was not found is no valve below 1.5 mm.
    row = by_kind(ROWS, 0.5, 5.0, 0.85)["in distribution"]
    assert (row.volumes, row.called_a_valve, row.below_limit) == pytest.approx((4, 75.0, 50.0))
    assert (row.state_right, row.wrong_yet_like) == (50.0, 25.0)
    # Wrong detections with a confidence that is unlike the training's are not believed.
    assert by_kind(ROWS, 0.5, 5.0, 0.96)["in distribution"].wrong_yet_like == 0.0
    rows = [
        volume("in distribution", 1.0, 0.9),
        volume("in distribution", 8.0, 0.6),
        volume("in distribution", 1.0, 0.4),
        *(without(kind, 0.2) for kind in WITHOUT_VALVE),
        sequence("calibration", 0.8, 1.0),
    ]
    found = by_kind(rows, 0.5, 5.0, 0.75)
    row = found["in distribution"]
    assert (row.volumes, row.lowest, row.median, row.highest) == (3, 0.4, 0.6, 0.9)
    assert row.wrongly_so == pytest.approx(100 / 3)
    assert (row.lost, row.unlike) == (2, 2)
    assert (found["walls only"].lost, found["walls only"].wrongly_so) == (0, 0)
    # Over time the median frame decides whether a volume is unlike.
    assert (found["calibration"].lost, found["calibration"].unlike) == (0, 1)


def test_errors_are_summarised_over_detected_valves():
    over_time = [sequence("sequence", 0.9, 1.0), sequence("sequence", 0.8, 2.0),
                 sequence("sequence", 0.3, 9.0), sequence("calibration", 0.9, 5.0)]  # fmt: skip
    found = {
        (row.error, row.kind): row
        for row in error_rows(judge([*ROWS, *over_time], 0.5, 5.0, 0.0)).itertuples()
    }
    surface = found["surface", "in distribution"]
    assert (surface.volumes, surface.mean, surface.median) == pytest.approx((3, 1.0, 0.6))
    assert surface.percentile_90 == pytest.approx(1.72)
    diameter, closed = found["ap_diameter", "in distribution"], found["surface_closed", "sequence"]
    assert diameter.mean == pytest.approx(3.5 / 3)
    assert (closed.volumes, closed.mean) == (2, 1.5)
    assert not [key for key in found if key[1] == "calibration"]


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
