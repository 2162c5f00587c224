"""From a file of a volume to moduli: what the one command does around the detectors.

The detectors are stood for by the valve that is in the volume; they have tests of their own.
"""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mvest.cases.folder import read_case
from mvest.cases.from_images.detector_errors import valve_axes
from mvest.errors import InputError
from mvest.exchange.markups import PointList, write_markups
from mvest.exchange.volumes import write_sequence_nrrd
from mvest.files import sha256_of
from mvest.imaging.detection.detect import NoValveError
from mvest.imaging.detection.trained_model import DetectionAccuracy
from mvest.imaging.volume import Modality, VolumeSequence
from tests.cases.from_images.test_imaged_case import LAYOUT, sequence


@pytest.fixture
def volume(tmp_path):
    """A file with as many frames as the valve: noise, for no one looks at it."""
    rng = np.random.default_rng(1)
    frames = rng.integers(0, 255, (4, 20, 20, 20), dtype=np.uint8)
    seen = sequence()
    made = VolumeSequence(
        frames, np.full(3, 3.0), np.eye(3), np.full(3, -30.0), seen.times, Modality.ULTRASOUND
    )
    return write_sequence_nrrd(tmp_path / "my_tee.seq.nrrd", made)


@pytest.fixture
def run(run, monkeypatch, volume):
    """Run the one command: exit status, standard output and error; what detectors were told."""
    rng = np.random.default_rng(2)
    accuracy = DetectionAccuracy(
        np.full(LAYOUT.size, 0.5),
        9.0,
        0.05 * rng.standard_normal((20, 2, LAYOUT.size, 3)),
        0.5 * rng.standard_normal((20, 2, 2, 3)),
    )
    model = SimpleNamespace(
        accuracy=accuracy,
        sha256="0" * 64,
        trained_on={"seed": 1},
        shape=SimpleNamespace(layout=LAYOUT),
    )
    told = []

    def detect(volume, given, *, min_confidence, landmarks=None, progress=None):
        assert given is model
        told.append((volume, landmarks))
        return sequence()

    detected = "mvest.cases.from_images.detected"
    monkeypatch.setattr(f"{detected}.load_model", lambda path: model)
    monkeypatch.setattr(f"{detected}.default_model", lambda: model)
    monkeypatch.setattr(f"{detected}.detect_valve", detect)

    def call(*arguments, pressure=True):
        given = [*arguments, "imaged.pressure_mmHg=110"] if pressure else arguments
        # In this process, where the detectors are replaced.
        return run("experiment=volume", f"volume={volume}", *given, "time_limit_s=null")

    call.told, call.model = told, model
    return call


@pytest.fixture
def asked(monkeypatch):
    """Cases and images that would be personalised."""
    given = []

    def personalised(values, personal, case, images):
        given.append((case, images))
        raise InputError("not tried here")

    monkeypatch.setattr("experiments.common.cases.own_case.run_case", personalised)
    return given


def finds(monkeypatch, found):
    """Let the detectors find this, or fail with it; what confidence they are told."""
    told = []

    def detect(volume, model, *, min_confidence, landmarks=None, progress=None):
        told.append(min_confidence)
        if isinstance(found, NoValveError):
            raise found
        return found

    monkeypatch.setattr("mvest.cases.from_images.detected.detect_valve", detect)
    return told


def test_the_image_step_is_checked_written_and_drawn(run, volume, tmp_path):
    status, out, err = run("check=true")
    assert status == 0, err
    (folder,) = (tmp_path / "outputs" / "volume").iterdir()
    for name in ("montage.png", "measures_over_time.png", "images/measures.csv",
                 "images/valve.pvd", "case/case.yaml", "case/errors.npz"):  # fmt: skip
        assert (folder / name).is_file(), name
    case = read_case(folder / "case")
    # By its content: a file may be called after a patient.
    assert case.name == f"volume {sha256_of(volume)[:12]}"
    named = [
        path for path in folder.rglob("*") if path.is_file() and b"my_tee" in path.read_bytes()
    ]
    assert named == []
    assert not case.simulated
    assert [frame.name for frame in case.frames] == ["open", "closed"]
    assert case.frames[1].pressure_mmHg == 110.0
    # Each also as it would be on the other side.
    assert len(case.error_samples) == 40
    # Near where it was found, less what the detectors are off by on average.
    off = np.linalg.norm(case.surface.vertices - sequence().vertices[0], axis=1)
    mean = np.linalg.norm(run.model.accuracy.samples[:, 0].mean(axis=0), axis=1)
    np.testing.assert_allclose(off, mean, atol=1e-9)
    assert "trained and tested on simulated volumes only" in out
    assert "chordae: 34 laid out as in the template" in out
    assert list((folder / "images").glob("valve_*.mrk.json"))
    # The same again, over what is there.
    assert run("check=true")[0] == 0


def test_what_is_told_of_the_frames_is_taken(run, tmp_path):
    status, _, err = run(
        "check=true", "imaged.open_frame=1", "imaged.closed_frame=2",
        "imaged.thickness_mm=[1.5,1.1]", "imaged.name=mine",
        "imaged.simulated=true", "imaged.error_samples=5",
    )  # fmt: skip
    assert status == 0, err
    (case,) = (tmp_path / "outputs" / "volume").glob("*/case")
    case = read_case(case)
    assert [(f.name, f.pressure_mmHg) for f in case.frames] == [
        ("open", 0.0), ("closed", 110.0)
    ]  # fmt: skip
    assert (case.name, case.simulated) == ("mine", True)
    middle = [LAYOUT.column(phi) for phi in (90.0, 270.0)]
    np.testing.assert_allclose(case.surface.thickness[LAYOUT.annulus[middle]], [1.5, 1.1])
    assert case.error_samples.vertices.shape == (10, 2, LAYOUT.size, 3)
    # Where it was found, less what the detectors are off by on average.
    axes, mean = valve_axes(sequence(), 1), run.model.accuracy.samples.mean(axis=0)
    np.testing.assert_allclose(
        case.surface.vertices, sequence().vertices[1] - mean[0] @ axes.T, atol=1e-9
    )


def test_the_pressure_may_come_from_a_curve(run, tmp_path):
    (tmp_path / "curve.csv").write_text("time,pressure\n0,0\n0.1,96\n0.2,120\n")
    status, _, err = run(
        "check=true", "imaged.closed_frame=2", "imaged.pressure_curve=curve.csv", pressure=False
    )
    assert status == 0, err
    (case,) = (tmp_path / "outputs" / "volume").glob("*/case")
    assert read_case(case).frames[-1].pressure_mmHg == pytest.approx(96.0)


def test_landmarks_placed_by_hand_are_handed_on(run, tmp_path):
    points = PointList(("tip_0", "commissure_180"), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    write_markups(tmp_path / "hand.mrk.json", {"mine": points})
    assert run("check=true", "imaged.landmarks=[[2,hand.mrk.json]]")[0] == 0
    ((_, landmarks),) = run.told
    assert set(landmarks) == {2}
    np.testing.assert_array_equal(landmarks[2]["commissure_180"], [4.0, 5.0, 6.0])
    # One of them is not placed, and a line lies beside.
    lists = json.loads((tmp_path / "hand.mrk.json").read_text())
    lists["markups"][0]["controlPoints"][0] |= {"position": "", "positionStatus": "undefined"}
    lists["markups"].insert(0, {"type": "Line", "controlPoints": [{"position": [1, 2, 3]}]})
    (tmp_path / "hand.mrk.json").write_text(json.dumps(lists))
    status, out, _ = run("check=true", "imaged.landmarks=[[2,hand.mrk.json]]")
    assert status == 0
    assert "landmarks of frame 2: tip_0 not placed" in out
    assert set(run.told[-1][1][2]) == {"commissure_180"}
    strange = PointList(("apex",), np.zeros((1, 3)))
    write_markups(tmp_path / "hand.mrk.json", {"mine": strange})
    status, _, err = run("check=true", "imaged.landmarks=[[2,hand.mrk.json]]")
    assert status == 2
    assert "points apex, expected some of commissure_0" in err


@pytest.mark.parametrize(
    ("arguments", "pressure", "message"),
    [
        (("imaged.pressure_curve=curve.csv",), True, "expected one of them"),
        (("imaged.pressure_mmHg=16",), False, "16.0 mmHg on the closed valve"),
        (("imaged.closed_frame=9",), True, "closed frame 9, expected one of 0 to 3"),
        (("imaged.landmarks=[3,a]",), True, "imaged.landmarks has 3, expected [frame, FILE]"),
        (("imaged.thickness_mm=[1.2]",), True, "one number for each of anterior, posterior"),
        (("imaged.modality=xray",), True, "imaged.modality = 'xray'"),
        (("volume=null",), True, "volume is not given"),
        (("volume=nowhere.nrrd",), True, "nowhere.nrrd: no such file"),
        (("imaged.model=nowhere.npz", "imaged.modality=ct"), True, "modality"),
    ],
)
def test_what_is_missing_or_wrong_is_one_line(run, arguments, pressure, message):
    status, _, err = run("check=true", *arguments, pressure=pressure)
    assert status == 2
    assert message in err
    assert "Traceback" not in err


def test_a_volume_without_a_valve_and_a_model_without_accuracy_end_in_their_reason(
    run, monkeypatch
):
    finds(monkeypatch, NoValveError("my_tee.seq.nrrd: no valve found"))
    status, _, err = run("check=true")
    assert status == 2
    assert "no valve found" in err
    run.model.accuracy = None
    status, _, err = run("check=true")
    assert status == 2
    assert "accuracy was never measured" in err


def test_the_case_is_personalised_and_its_record_says_of_the_images(run, volume, asked):
    status, _, err = run("figures=false", "tracking.enabled=false")
    assert status == 2
    assert "not tried here" in err
    ((case, images),) = asked
    # By its content: a file may be called after a patient.
    assert case.name == f"volume {sha256_of(volume)[:12]}"
    assert [row["file"] for row in images["pictures"]] == ["montage.png", "measures_over_time.png"]
    (step,) = images["image_step"]
    assert len(images["image_frames"]) == len(step["confidence"]) == 4
    assert (step["open_frame"], step["shape"]) == (0, [4, 20, 20, 20])
    assert json.dumps(images, allow_nan=False)


def test_a_volume_unlike_those_of_training_is_said_to_be_and_its_errors_are_wider(run, asked):
    seen = sequence().confidence
    measured = run.model.accuracy
    for like_from, widening in ((seen - 0.05, (1.0, 0.0)), (seen + 0.05, (1.0, 7.0))):
        run.model.accuracy = replace(measured, like_from=like_from, widening=widening)
        assert run("figures=false", "tracking.enabled=false")[0] == 2
    (like, step), (unlike, other) = ((case, images["image_step"][0]) for case, images in asked)
    assert step["unlike"] == ""
    expected = f"{seen:.2f} in the median frame, expected at least {seen + 0.05:.2f}"
    assert expected in other["unlike"]
    assert "4.8 % of volumes" in other["unlike"]  # one in twenty-one
    assert any("unlike those that the detectors" in said for said in other["sentences"])
    spread = [np.std(case.error_samples.vertices, axis=0).mean() for case in (like, unlike)]
    assert spread[1] / spread[0] == pytest.approx(np.exp(7.0 * (1.0 - seen)))


def test_what_is_missing_is_said_before_the_volume_is_searched(run):
    # The search takes a second for every frame.
    status, _, err = run(pressure=False)
    assert status == 2
    assert "imaged.pressure_mmHg or imaged.pressure_curve" in err
    assert run.told == []


def test_a_check_without_a_pressure_draws_and_says_what_the_estimate_needs(run, tmp_path):
    status, out, err = run("check=true", pressure=False)
    assert status == 0, err
    (folder,) = (tmp_path / "outputs" / "volume").iterdir()
    assert (folder / "montage.png").is_file()
    assert (folder / "images" / "measures.csv").is_file()
    # A case with a pressure that nobody stated must not lie there to be estimated.
    assert not (folder / "case").exists()
    assert "an estimate will need imaged.pressure_mmHg" in out


def test_a_candidate_that_is_not_accepted_is_drawn_as_such(run, monkeypatch, tmp_path):
    titles = []

    def titled(figure, title, note):
        titles.append(title)

    finds(monkeypatch, NoValveError("no valve found; 0.31, expected at least 0.6", sequence()))
    monkeypatch.setattr("mvest.reporting.images.headline", titled)
    status, _, err = run("check=true")
    assert status == 2
    (drawn,) = (tmp_path / "outputs" / "volume").glob("*/candidate.png")
    assert "0.31, expected at least 0.6" in err
    assert f"not accepted, is drawn in {drawn}" in err
    (title,) = titles
    assert title.startswith("NO VALVE FOUND; best candidate, not accepted: volume ")
    assert not list((tmp_path / "outputs" / "volume").glob("*/case"))


def test_the_confidence_below_which_there_is_no_valve_is_a_setting(run, monkeypatch):
    told = finds(monkeypatch, sequence())
    assert run("check=true", "imaged.min_confidence=0.1")[0] == 0
    assert told == [0.1]


def test_one_frame_is_no_cycle(run, volume, tmp_path):
    # The largest and the smallest orifice would be the same frame.
    frames = np.random.default_rng(1).integers(0, 255, (1, 20, 20, 20), dtype=np.uint8)
    single = VolumeSequence(
        frames, np.full(3, 3.0), np.eye(3), np.full(3, -30.0), np.zeros(1), Modality.ULTRASOUND
    )
    write_sequence_nrrd(tmp_path / "single.seq.nrrd", single)
    status, _, err = run("check=true", f"volume={tmp_path / 'single.seq.nrrd'}")
    assert status == 2
    assert "single.seq.nrrd" in err
    assert "one frame, expected two or more" in err
    assert run.told == []
