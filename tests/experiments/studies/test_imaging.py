"""The study of the image step, in a size that takes seconds."""

import copy
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import tables
from experiments.common.records.record import Record, read_record
from experiments.common.schema import build
from experiments.results.keep import publish
from experiments.run import main
from experiments.studies.imaging import study as imaging
from experiments.studies.imaging.evaluation import (
    _threshold,
    confidences,
    detected_volume,
    learning_rows,
)
from experiments.studies.imaging.findings import Findings
from experiments.studies.imaging.held_out import HeldOut
from experiments.studies.imaging.settings import ImagingSettings, Settings
from experiments.studies.imaging.store import ImagingStore, StoredSamples
from experiments.studies.imaging.trials import KINDS, Trial
from mvest.errors import ConfigurationError, InputError
from mvest.imaging.detection import trained_model as detection_model
from mvest.imaging.detection.trained_model import (
    STAGES,
    DetectionModel,
    default_model,
    load_model,
    save_model,
)
from mvest.imaging.simulator import SMALL
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


def record_of(place: Path, run: str = "run") -> Record[Findings]:
    return read_record(place / run / "result.json", Findings)


def changed(place: Path) -> dict[str, int]:
    """Which writing each file of the store is of: reading one changes its time alone."""
    root = place / "outputs" / "detectors"
    return {str(p.relative_to(root)): p.stat().st_ino for p in root.rglob("*.npz")}


def test_the_study_tells_how_far_detectors_are_off(done: Path):
    record = record_of(done)
    assert (record.status, record.reason) == ("converged", "trained and tested")
    findings, tested = record.findings, record.findings.tested
    assert tested is not None
    assert [row.setting for row in tested.rows] == ["in distribution"] * 2 + ["shifted"] * 2
    assert all(row.seconds > 0 for row in tested.rows)
    # The curve has both trainings, on the same volumes.
    found = {(row.stage, row.training_volumes, row.setting) for row in tested.training}
    stages = ("position", "pose", "landmarks", "hinge", "surface")
    settings = ("in distribution", "shifted")
    assert found == {(stage, n, s) for stage in stages for n in (3, 6) for s in settings}
    assert {row.volumes for row in tested.training} == {1}
    units = {row.stage: row.unit for row in tested.training}
    assert units["pose"] == "degrees"
    # Confidences with a valve and without one.
    assert set(tested.confidence.values) == set(KINDS)
    accuracy = tested.accuracy
    assert len(accuracy.std_mm) == 16 * 5
    assert {(row.setting, row.frame) for row in accuracy.within_95} == {
        (s, f) for s in settings for f in ("open", "closed")
    }
    for row in accuracy.within_95:
        assert min(row.share, row.share_handed_on) >= 0
        assert max(row.share, row.share_handed_on) <= 1
        assert min(row.rms_handed_on_mm, row.stated_handed_on_mm) > 0
    # Where valves were found goes with the detectors, in the axes of each.
    shapes = load_model(done / "run" / "tee.npz").accuracy.shapes
    annulus = shapes[:, :, :16]
    assert shapes.shape == (2, 2, 16 * 5, 3)
    np.testing.assert_allclose(annulus.mean(axis=2), 0.0, atol=1e-4)
    assert np.ptp(annulus[..., :2]) > 3 * np.ptp(annulus[..., 2])
    parts = ("valves", "volumes", "draft", "trees")
    for part in (*parts, "training"):
        assert findings.spent[part].cpu_s > 0
    total = sum(findings.spent[part].cpu_s for part in parts)
    assert findings.spent["training"].cpu_s == pytest.approx(total)
    assert findings.measures["training_cpu_s"] == pytest.approx(total)


def test_what_is_tested_on_was_not_trained_on(done: Path):
    record, trained = record_of(done), load_model(done / "run" / "tee.npz").trained_on
    of = record.findings.tested
    tested = {row["valve"] for rows in of.volumes.values() for row in rows}
    tested |= {row.valve for row in of.sequences}
    calibrated = {row["valve"] for row in of.sequence_frames["calibration"]}
    assert len(trained["valves"]) == 4
    assert set(trained["calibrated_on"]) == calibrated
    assert len(calibrated) == len(tested) == 2
    groups = (set(trained["valves"]), calibrated, tested)
    assert len(set.union(*groups)) == sum(map(len, groups))
    # By seed, as their names say.
    assert [{name.split("_")[1] for name in group} for group in groups] == [{"1"}, {"3"}, {"2"}]


def test_the_model_tells_its_errors(done: Path):
    model, record = load_model(done / "run" / "tee.npz"), record_of(done)
    assert model.accuracy is not None
    assert model.accuracy.samples.shape == (2, 2, 80, 3)
    assert model.accuracy.tip_samples.shape == (2, 2, 2, 3)
    assert (model.accuracy.std_mm > 0).all()
    about = model.accuracy.samples - model.accuracy.samples.mean(axis=0)
    std = np.sqrt((about**2).sum(axis=(0, 1, 3)) / 6)
    assert model.accuracy.std_mm == pytest.approx(std, rel=1e-5)
    length = record.findings.tested.accuracy.correlation_length_mm
    assert model.accuracy.correlation_length_mm == pytest.approx(length)
    assert model.sha256 == record.findings.model_file.sha256
    assert model.trained_on["config_hash"] == record.provenance.config_hash


def test_tables_and_figures_are_made_and_made_again(
    done: Path, tmp_path: Path, monkeypatch, capsys
):
    names = {path.name for path in (done / "run").iterdir()}
    for name in ("imaging", "imaging_sequences", "imaging_confidence"):
        assert {f"{name}.csv", f"{name}.md", f"{name}.tex"} <= names
    for name in ("distance", "training", "confidence", "std", "correlation"):
        assert {f"imaging_{name}.png", f"imaging_{name}.pdf"} <= names
    text = (done / "run" / "imaging.md").read_text(encoding="utf-8")
    assert "imulated" in text
    assert "CPU time" in text
    # Overrides keep a run out of the results.
    assert not (done / "results").exists()
    results = tmp_path / "results"
    record = read_record(done / "run" / "result.json", imaging.STUDY.findings)
    publish(imaging.STUDY, results, {"imaging": (record, done / "run")})
    assert (results / "imaging.md").read_text(encoding="utf-8") == text
    kept = json.loads((results / "records" / "imaging" / "imaging.json").read_text("utf-8"))
    assert record.findings.tested.volumes
    assert not kept["findings"]["tested"]["volumes"]
    assert not kept["findings"]["tested"]["sequence_frames"]
    for path in results.glob("imaging*.md"):
        path.unlink()
    assert tables.main([str(results)]) == 0
    assert (results / "imaging.md").read_text(encoding="utf-8") == text
    assert "imaging_std.png" in capsys.readouterr().out


def test_an_interrupted_study_goes_on_where_it_was(done: Path):
    again, before = done / "again", record_of(done)
    store = changed(done)
    lost = [
        next(name for name in store if name.startswith(part)) for part in ("volumes", "samples")
    ]
    for name in lost:
        (done / "outputs" / "detectors" / name).unlink()
    assert call(done, f"hydra.run.dir={again.name}") == 0
    now = changed(done)
    assert set(now) == set(store)
    assert {name for name in now if now[name] != store[name]} <= set(lost)
    after = record_of(done, "again")
    assert after.findings.tested.accuracy == before.findings.tested.accuracy
    without_time = [
        [replace(row, seconds=0.0) for row in record.findings.tested.rows]
        for record in (before, after)
    ]
    assert without_time[0] == without_time[1]


def test_the_seed_decides_and_not_the_processes(done: Path, tmp_path: Path):
    valves = tmp_path / "outputs" / "detectors" / "valves"
    shutil.copytree(done / "outputs" / "detectors" / "valves", valves)
    first = load_model(done / "run" / "tee.npz")
    assert call(tmp_path, "imaging.evaluate=false", "imaging.processes=2", "hydra.run.dir=two") == 0
    record = record_of(tmp_path, "two")
    assert (record.reason, record.findings.tested) == ("trained", None)
    second = load_model(tmp_path / "two" / "tee.npz")
    assert second.accuracy is None
    for name in STAGES:
        assert first.boosters[name].texts == second.boosters[name].texts
    assert np.array_equal(first.shape.modes, second.shape.modes)
    # Only a training: nothing else was drawn or written.
    assert not (tmp_path / "outputs" / "detectors" / "volumes").exists()
    assert not (tmp_path / "two" / "imaging.md").exists()
    assert call(tmp_path, "imaging.evaluate=false", "seed=3", "hydra.run.dir=other") == 0
    other = load_model(tmp_path / "other" / "tee.npz")
    assert other.boosters["boundary"].texts != first.boosters["boundary"].texts


def test_given_detectors_are_tested_and_calibrated_and_none_is_trained(
    done: Path, tmp_path: Path, capsys
):
    valves = tmp_path / "outputs" / "detectors" / "valves"
    shutil.copytree(done / "outputs" / "detectors" / "valves", valves)
    given = f"imaging.model={done / 'run' / 'tee.npz'}"
    assert call(tmp_path, given, "hydra.run.dir=run") == 0
    record, first = record_of(tmp_path), load_model(done / "run" / "tee.npz")
    assert record.reason == "tested"
    assert record.findings.spent["training"].cpu_s is None
    assert record.findings.training_volumes == 6
    assert not (tmp_path / "outputs" / "detectors" / "samples").exists()
    again = load_model(tmp_path / "run" / "tee.npz")
    for name in STAGES:
        assert first.boosters[name].texts == again.boosters[name].texts
    assert again.accuracy.widening == first.accuracy.widening
    # What was measured of detectors changes nothing of what they find, other trees do.
    made, own = changed(tmp_path), tmp_path / "run" / "tee.npz"
    save_model(own, DetectionModel(again.shape, again.boosters, {**again.trained_on, "by": 2}))
    assert call(tmp_path, f"imaging.model={own}", "hydra.run.dir=again") == 0
    assert changed(tmp_path) == made
    boosters = again.boosters | {"annulus": again.boosters["free_edge"]}
    save_model(tmp_path / "other.npz", DetectionModel(again.shape, boosters, again.trained_on))
    keys = [
        store_of(f"imaging.model={file}").model_key(6) for file in (own, tmp_path / "other.npz")
    ]
    assert keys[0] == record.findings.detectors != keys[1]
    capsys.readouterr()
    assert call(tmp_path, given, "imaging.train.seed=9", "imaging.calibration.seed=1") == 2
    assert "was trained on, expected other valves" in capsys.readouterr().err
    assert call(tmp_path, given, "imaging.evaluate=false") == 2
    assert "nothing would be done" in capsys.readouterr().err


def test_a_model_is_made_the_one_of_the_package_without_training_again(
    done: Path, tmp_path: Path, monkeypatch, capsys
):
    place = tmp_path / "models" / "tee.npz"
    for module in (imaging, detection_model):
        monkeypatch.setattr(module, "MODEL_FILE", place)
    with pytest.raises(InputError, match="no trained detectors come with this installation"):
        default_model()
    store = changed(done)
    assert call(done, "hydra.run.dir=run", "imaging.publish_model=true") == 0
    assert "Done on" in capsys.readouterr().out
    assert changed(done) == store
    assert place.read_bytes() == (done / "run" / "tee.npz").read_bytes()
    assert default_model().accuracy is not None


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("imaging.test.seed=1", "expected different seeds"),
        ("imaging.train.count=0", "imaging.train.count = 0, expected a number >= 1"),
        ("imaging.calibration.count=1", "imaging.calibration.count = 1"),
        ("imaging.curve=[6]", "imaging.curve has 6 volumes, expected 1 to 5"),
        ("imaging.curve=[3,3]", "expected other numbers"),
        ("imaging.processes=0", "imaging.processes = 0"),
        ("imaging.held_out.shifted=0", "imaging.held_out.shifted = 0"),
        ("imaging.held_out.curve_volumes=3", "expected at most 2"),
        ("imaging.held_out.wrong_mm=0", "imaging.held_out.wrong_mm = 0"),
        ("imaging.training.modes=7", "expected at least 8"),
        ("imaging.training.acquisition.beats=0", "beats"),
        ("imaging.population.motion.columns=12", "no column"),
        ("imaging.population.motion.frames=30", "frames = 30"),
        ("imaging.targets={shifted:{colour:1}}", "imaging.targets"),
        ("imaging.procesess=3", "did you mean processes?"),
        ("imaging.training.volumes=many", "imaging.training.volumes"),
    ],
)
def test_wrong_settings_are_told_in_one_line(tmp_path: Path, override: str, words: str, capsys):
    assert call(tmp_path, override) == 2
    told = capsys.readouterr().err.strip()
    assert len(told.splitlines()) == 1
    assert words in told
    assert not (tmp_path / "outputs" / "detectors").exists()


def test_populations_with_a_valve_in_common_are_refused(done: Path):
    store = store_of(f"paths.outputs={done / 'outputs'}")
    train, test = (store.population(which).valves for which in ("train", "test"))
    imaging.require_apart(train, test)
    with pytest.raises(ConfigurationError, match="two populations"):
        imaging.require_apart(train, (*test, train[1]))
    # The same shape under another name.
    twin = copy.copy(test[0])
    object.__setattr__(twin, "vertices", train[0].vertices)
    with pytest.raises(ConfigurationError, match="two populations"):
        imaging.require_apart(train, (twin,))


def test_keys_follow_what_they_are_of():
    def keys(*overrides: str) -> tuple[str, ...]:
        store = store_of(*overrides)
        return store.population_key("train"), store.samples_key, store.model_key(6)

    base = keys()
    assert keys("imaging.processes=2", "imaging.held_out.volumes=9") == base
    trees = keys("imaging.training.many_trees=5")
    assert trees[:2] == base[:2]
    assert trees[2] != base[2]
    # More volumes go on from those that are there.
    more = keys("imaging.training.volumes=9")
    assert more == base
    assert keys("imaging.training.draft_volumes=2")[1] != base[1]
    other = keys("seed=3")
    assert other[0] == base[0]
    assert other[1] != base[1]
    assert not set(keys("imaging.train.seed=9")) & set(base)
    assert store_of().model_key(3) != base[2]


def test_samples_in_files_are_read_stage_by_stage(done: Path):
    path = next((done / "outputs" / "detectors" / "samples").rglob("00000.npz"))
    samples = StoredSamples(path)
    assert list(samples) == list(STAGES)
    x, y = samples["boundary"]
    assert len(x) == len(y) == 60
    assert samples.cpu_s > 0


def test_every_trial_has_a_stream_of_its_own():
    trials = [Trial(kind, k, 1, SMALL) for kind in KINDS for k in range(3)]
    states = {tuple(trial.random.generate_state(2)) for trial in trials}
    states |= {tuple(np.random.SeedSequence(1, spawn_key=(k,)).generate_state(2)) for k in range(3)}
    assert len(states) == len(trials) + 3
    assert {trial.spread for trial in trials if "shifted" in trial.kind} == {"shifted"}
    within = [trial for trial in trials if "shifted" not in trial.kind]
    assert {trial.spread for trial in within if "wide" in trial.kind} == {"wide"}
    assert {trial.spread for trial in within if "wide" not in trial.kind} == {"training"}


def volume(kind: str, number: int, size: float, confidence: float = 0.9) -> dict:
    errors = dict.fromkeys(("position", "turn", "annulus", "surface", "points", "tips"), size)
    measured = {"annulus_area_mm2": 100.0, "ap_diameter_mm": 30.0, "is_open": True}
    return {
        "kind": kind, "number": number, "valve": "a", "frame": 0, "cpu_s": 2.0,
        "confidence": confidence,
        "errors": errors | {"surface": 2 * size, "stages": {"landmarks": 3 * size}},
        "true": measured,
        "estimated": {"annulus_area_mm2": 90.0, "ap_diameter_mm": 31.5, "is_open": False},
    }  # fmt: skip


def test_rows_have_signs_and_nothing_where_no_valve_was_detected():
    row = detected_volume(volume("shifted", 0, 1.0), 0.5)
    assert row.surface_mm == 2.0
    assert row.annulus_area_error_percent == pytest.approx(-10.0)
    assert row.ap_error_mm == pytest.approx(1.5)
    assert row.state_right is False
    lost = detected_volume(volume("shifted", 0, 1.0, 0.4), 0.5)
    assert lost.surface_mm is lost.ap_error_mm is lost.state_right is None
    assert lost.seconds == 2.0


def test_trainings_are_compared_on_the_same_volumes():
    rows = {
        10: [volume("shifted", 0, 4.0)],
        20: [volume("shifted", 0, 1.0), volume("shifted", 1, 100.0), volume("walls only", 0, 9.0)],
    }
    found = {(row.training_volumes, row.stage): row.median for row in learning_rows(rows)}
    assert found[10, "surface"] == 8.0
    assert found[20, "surface"] == 2.0
    assert found[20, "landmarks"] == 3.0
    assert found[20, "pose"] == 1.0


def test_the_threshold_tells_with_from_without():
    assert _threshold(np.array([0.6, 0.8, 0.9]), np.array([0.1, 0.4])) == pytest.approx(0.5)
    # One outlier does not move it.
    assert 0.4 < _threshold(np.array([0.3, 0.8, 0.9]), np.array([0.1, 0.4])) < 0.8


def sequence(confidence: float, off: float) -> tuple[dict, dict]:
    frames = [
        {"confidence": confidence - 0.1, "points": off},
        {"confidence": confidence, "points": off},
    ]
    return {"frames": frames, "valve": f"{off}"}, {"errors": np.full((2, 4, 3), off)}


def test_errors_are_stated_of_valves_that_were_detected_only():
    held_out = HeldOut(
        {}, {"calibration": [sequence(0.9, 1.0), sequence(0.8, 30.0), sequence(0.3, 2.0)]}
    )
    right = held_out.detected("calibration", 0.5, 5.0)
    assert right.stacked("calibration", "errors").max() == 1.0
    assert len(held_out.detected("calibration", 0.5).sequences["calibration"]) == 2
    settings = settings_of("imaging.detection.min_confidence=0.5", "imaging.held_out.wrong_mm=5.0")
    with pytest.raises(InputError, match="in 1 of 3 volumes the valve was detected"):
        imaging._calibrated(settings, held_out)


def test_a_wrong_valve_counts_as_none():
    volumes = [
        volume("in distribution", 0, 1.0, 0.9),
        volume("in distribution", 1, 8.0, 0.6),
        *({"kind": kind, "confidence": 0.2} for kind in ("walls only", "no tissue", "white noise")),
    ]
    sequences = {"calibration": [sequence(0.8, 1.0)[0]], "sequence": [], "shifted sequence": []}
    found = confidences(volumes, sequences, 0.5, 5.0)
    assert found.highest_without_valve == 0.2
    assert found.highest_wrong == 0.6
    assert found.lowest_right == 0.8
    assert found.best_threshold == pytest.approx(0.7)
    rows = {row.kind: row for row in found.rows}
    assert rows["in distribution"].called_percent == 100
    assert rows["in distribution"].wrongly_percent == 50
    assert rows["walls only"].wrongly_percent == 0
    assert "sequence" not in rows


def test_the_small_scanner_is_the_simulators():
    assert store_of().training.acquisition == SMALL
