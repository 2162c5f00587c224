"""From a file of a volume to moduli: what the one command does around the detectors.

The detectors are replaced by the valve that is in the volume; they have tests of their own.
"""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mvest.cases.folder import read_case
from mvest.cases.from_images.detector_errors import valve_axes
from mvest.errors import InputError
from mvest.exchange.volumes import write_sequence_nrrd
from mvest.files import sha256_of
from mvest.imaging.detection.detect import NoValveError
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.volume import Modality, VolumeSequence
from tests.cases.from_images.test_imaged_case import LAYOUT, sequence


def written(path, times):
    """A file of noise, which nobody looks at."""
    rng = np.random.default_rng(1)
    frames = rng.integers(0, 255, (len(times), 20, 20, 20), dtype=np.uint8)
    grid = np.full(3, 3.0), np.eye(3), np.full(3, -30.0)
    return write_sequence_nrrd(path, VolumeSequence(frames, *grid, times, Modality.ULTRASOUND))


@pytest.fixture
def volume(tmp_path):
    return written(tmp_path / "my_tee.seq.nrrd", sequence().times)


@pytest.fixture
def run(run, monkeypatch, volume):
    """Run the one command; `found` is detected, or raised, and `told` has the given arguments."""
    rng = np.random.default_rng(2)
    accuracy = DetectionAccuracy(
        np.full(LAYOUT.size, 0.5),
        9.0,
        0.05 * rng.standard_normal((20, 2, LAYOUT.size, 3)),
        0.5 * rng.standard_normal((20, 2, 2, 3)),
    )
    shape = SimpleNamespace(layout=LAYOUT)
    hashes = {"sha256": "0" * 64, "digest": "1" * 64}
    model = SimpleNamespace(accuracy=accuracy, trained_on={"seed": 1}, shape=shape, **hashes)

    def detect(volume, given, *, min_confidence, progress=None):
        call.told.append(min_confidence)
        if isinstance(call.found, NoValveError):
            raise call.found
        return call.found

    detected = "mvest.cases.from_images.detected"
    monkeypatch.setattr(f"{detected}.load_model", lambda path: model)
    monkeypatch.setattr(f"{detected}.default_model", lambda: model)
    monkeypatch.setattr(f"{detected}.detect_valve", detect)
    monkeypatch.setattr("mvest.reporting.figures.DPI", 20)

    def call(*arguments, pressure=True):
        given = [*arguments, "imaged.pressure_mmHg=110"] if pressure else arguments
        # In this process, where the detectors are replaced.
        return run("experiment=volume", f"volume={volume}", *given, "time_limit_s=null")

    call.told, call.model, call.found = [], model, sequence()
    return call


def test_the_image_step_is_checked_written_and_drawn(run, volume, tmp_path):
    status, out, err = run("check=true")
    assert status == 0, err
    (folder,) = (tmp_path / "outputs" / "volume").iterdir()
    for name in ("montage.png", "measures_over_time.png", "images/measures.csv",
                 "images/valve.pvd", "case/case.yaml", "case/errors.npz"):  # fmt: skip
        assert (folder / name).is_file(), name
    case = read_case(folder / "case")
    # Named by its content: a file may be called after a patient.
    assert case.name == f"volume {sha256_of(volume)[:12]}"
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert not [path for path in files if b"my_tee" in path.read_bytes()]
    assert not case.simulated
    assert [(f.name, f.pressure_mmHg) for f in case.frames] == [("open", 0.0), ("closed", 110.0)]
    # Each sample also mirrored.
    assert len(case.error_samples) == 40
    # At the detected position minus the mean error of the detectors.
    off = np.linalg.norm(case.surface.vertices - sequence().vertices[0], axis=1)
    mean = np.linalg.norm(run.model.accuracy.samples[:, 0].mean(axis=0), axis=1)
    np.testing.assert_allclose(off, mean, atol=1e-9)
    assert "trained and tested on simulated volumes only" in out


def test_settings_of_the_frames_are_used(run, tmp_path):
    (tmp_path / "curve.csv").write_text("time,pressure\n0,0\n0.1,96\n0.2,120\n")
    status, _, err = run(
        "check=true", "imaged.open_frame=1", "imaged.closed_frame=2",
        "imaged.thickness_mm=[1.5,1.1]", "imaged.name=mine", "imaged.simulated=true",
        "imaged.error_samples=5", "imaged.pressure_curve=curve.csv",
        "imaged.min_confidence=0.1", pressure=False,
    )  # fmt: skip
    assert status == 0, err
    assert run.told == [0.1]
    (case,) = (tmp_path / "outputs" / "volume").glob("*/case")
    case = read_case(case)
    assert case.frames[-1].pressure_mmHg == pytest.approx(96.0)
    assert (case.name, case.simulated) == ("mine", True)
    middle = [LAYOUT.column(phi) for phi in (90.0, 270.0)]
    np.testing.assert_allclose(case.surface.thickness[LAYOUT.annulus[middle]], [1.5, 1.1])
    assert case.error_samples.vertices.shape == (10, 2, LAYOUT.size, 3)
    axes, mean = valve_axes(sequence(), 1), run.model.accuracy.samples.mean(axis=0)
    np.testing.assert_allclose(
        case.surface.vertices, sequence().vertices[1] - mean[0] @ axes.T, atol=1e-9
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("imaged.pressure_curve=curve.csv",), "expected one of them"),
        (("imaged.closed_frame=9",), "closed frame 9, expected one of 0 to 3"),
        (("volume=null",), "volume is not given"),
    ],
)
def test_a_wrong_request_is_one_line(run, arguments, message):
    status, _, err = run("check=true", *arguments)
    assert status == 2
    assert message in err
    assert "Traceback" not in err


def test_a_volume_unlike_those_of_training_is_named_and_its_errors_are_wider(
    run, volume, monkeypatch
):
    personalised = []

    def not_here(values, personal, case, images):
        personalised.append((case, images))
        raise InputError("not tried here")

    monkeypatch.setattr("experiments.common.cases.own_case.run_case", not_here)
    seen, measured = sequence().confidence, run.model.accuracy
    for figures, like_from, widening in (
        (True, seen - 0.05, (1.0, 0.0)),
        (False, seen + 0.05, (1.0, 7.0)),
    ):
        run.model.accuracy = replace(measured, like_from=like_from, widening=widening)
        assert run(f"figures={figures}", "tracking.enabled=false")[0] == 2
    (like, images), (unlike, other) = personalised
    assert like.name == f"volume {sha256_of(volume)[:12]}"
    assert [row["file"] for row in images["pictures"]] == ["montage.png", "measures_over_time.png"]
    assert not other["pictures"]
    (step,), (unlike_step,) = images["image_step"], other["image_step"]
    assert len(images["image_frames"]) == len(step["confidence"]) == 4
    assert (step["open_frame"], step["shape"], step["unlike"]) == (0, [4, 20, 20, 20], "")
    assert json.dumps(images, allow_nan=False)
    expected = f"{seen:.2f} in the median frame, expected at least {seen + 0.05:.2f}"
    assert expected in unlike_step["unlike"]
    assert "4.8 % of volumes" in unlike_step["unlike"]  # one in twenty-one
    spread = [np.std(case.error_samples.vertices, axis=0).mean() for case in (like, unlike)]
    assert spread[1] / spread[0] == pytest.approx(np.exp(7.0 * (1.0 - seen)))


def test_an_estimate_needs_a_pressure_and_a_check_does_not(run, tmp_path):
    # The search of the volume takes a second for every frame.
    status, _, err = run(pressure=False)
    assert (status, run.told) == (2, [])
    assert "imaged.pressure_mmHg or imaged.pressure_curve" in err
    status, out, err = run("check=true", pressure=False)
    assert status == 0, err
    assert "an estimate will need imaged.pressure_mmHg" in out
    (montage,) = (tmp_path / "outputs" / "volume").glob("*/montage.png")
    # A case with a pressure that nobody stated must not exist.
    assert not (montage.parent / "case").exists()


def test_no_valve_no_accuracy_or_one_frame_end_in_their_reason(run, monkeypatch, tmp_path):
    titles = []
    monkeypatch.setattr("mvest.reporting.images.headline", lambda *given: titles.append(given[1]))
    run.found = NoValveError("no valve found; 0.31, expected at least 0.6", sequence())
    status, _, err = run("check=true")
    assert status == 2
    (drawn,) = (tmp_path / "outputs" / "volume").glob("*/candidate.png")
    assert (
        f"0.31, expected at least 0.6; the best candidate, not accepted, is drawn in {drawn}"
        in (err)
    )
    assert titles[0].startswith("NO VALVE FOUND; best candidate, not accepted: volume ")
    assert not list((tmp_path / "outputs" / "volume").glob("*/case"))
    run.model.accuracy = None
    status, _, err = run("check=true")
    assert status == 2
    assert "accuracy was never measured" in err
    # The largest and the smallest orifice would be the same frame.
    single = written(tmp_path / "single.seq.nrrd", np.zeros(1))
    status, _, err = run("check=true", f"volume={single}")
    assert status == 2
    assert "one frame, expected two or more" in err
