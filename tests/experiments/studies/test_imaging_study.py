"""What a study of the image step says: numbers in words, and what figures show."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.common.records.record import Record
from experiments.studies.imaging.findings import (
    Accuracy,
    Confidences,
    Correlations,
    Coverage,
    DetectedVolume,
    Evaluation,
    Findings,
    ModelFile,
    Population,
    Spent,
)
from experiments.studies.imaging.report import (
    confidence_figure,
    correlation_figure,
    imaging_text,
    study_words,
    write_imaging,
)
from mvest.imaging.layout import ValveLayout
from tests.experiments.studies.made_up import made_up

CONFIDENCE = Confidences(
    min_confidence=0.5,
    wrong_mm=5.0,
    values={"shifted": (0.9, 0.6), "walls only": (0.2,), "sequence": ()},
    off_mm={"shifted": (1.0, 20.0), "walls only": (None,), "sequence": ()},
    highest_without_valve=0.2,
    highest_wrong=0.6,
    lowest_right=0.9,
    best_threshold=0.75,
    rows=(),
)
ACCURACY = Accuracy(
    std_mm=(0.5,) * 80,
    median_std_mm=0.5,
    mean_error_mm=0.3,
    sequences=18,
    left_out=2,
    correlation_length_mm=8.0,
    correlogram=Correlations((1.0, 8.0), (0.97, 0.48), (3, 4)),
    within_95=(
        Coverage(
            setting="shifted", frame="open", sequences=4, share=0.62, share_handed_on=0.7,
            rms_mm=1.0, stated_rms_mm=0.5, rms_handed_on_mm=0.8, stated_handed_on_mm=0.45,
        ),
    ),
)  # fmt: skip


def spent(**cpu: float | None) -> dict[str, Spent]:
    parts = ("valves", "volumes", "draft", "trees", "training")
    return {part: Spent(cpu.get(part, 10.0)) for part in parts}


def volume(*, state_right: bool | None) -> DetectedVolume:
    return DetectedVolume(
        setting="shifted", valve="a", frame=0, confidence=0.9, surface_mm=1.0, point_mm=1.0,
        tips_mm=1.0, annulus_area_error_percent=1.0, ap_error_mm=1.0, state_right=state_right,
        seconds=1.0,
    )  # fmt: skip


def findings(**more) -> Findings:
    return Findings(
        **{
            "seconds": 1.0, "memory_mb": 1.0, "detectors": "key", "layout": ValveLayout(16, 5),
            "valves": {"train": Population(8, {})}, "training_volumes": 24, "targets": {},
            "spent": spent(training=120.0), "tested": None, "measures": {},
            "model_file": ModelFile("0", 1),
        } | more
    )  # fmt: skip


def record(**more) -> Record[Findings]:
    return made_up(findings(**more), row="detectors", reason="trained", experiment="imaging")


def test_words_of_a_training_alone_are_its_cost(tmp_path):
    words = study_words(findings())
    assert words[0].startswith("Trained on 24 volumes of 8 simulated valves; CPU time 10 s for")
    assert words[0].endswith("2.0 minutes in all.")
    assert words[1:] == ["Not tested."]
    # What was not measured is not told.
    unknown = study_words(findings(spent=spent(valves=None, training=None)))[0]
    assert "for valves" not in unknown
    assert "in all" not in unknown
    assert "Not tested" in imaging_text(record())
    assert write_imaging(tmp_path, {"imaging": record()}, {}) == []
    assert list(tmp_path.iterdir()) == []


def test_words_say_what_is_wrong_and_yet_believed():
    # Below 1.5 mm, not called a valve, wrong and unlike, wrong and believed.
    sizes = ((1.0, 0.9), (None, 0.4), (2.0, 0.75), (2.0, 0.9))
    rows = tuple(
        replace(volume(state_right=None), surface_mm=surface, confidence=confidence)
        for surface, confidence in sizes
    )
    confidence = replace(
        CONFIDENCE,
        values={"sequence": (0.9, 0.2, 0.9)},
        off_mm={"sequence": (1.0, 1.0, 9.0)},
    )
    accuracy = replace(ACCURACY, widening=(1.1, 5.0), like_from=0.8, unlike={"shifted": (3, 7)})
    tested = Evaluation(
        rows=rows, training=(), confidence=confidence, sequences=(), accuracy=accuracy
    )
    words = " ".join(study_words(findings(tested=tested)))
    assert "Shifted, one frame: of 4 volumes 50 % lie below 1.5 mm or are called none" in words
    assert "2 are unlike those of training, and of the wrong ones 1 (25.0 %)" in words
    assert "1.10 exp(5.00 (1 - c))" in words
    assert "Over time, shifted: 3 of 7 volumes are unlike." in words
    assert "Lost over time, in distribution: 2 of 3." in words


def test_words_say_whether_the_stated_errors_are_true():
    tested = Evaluation(
        rows=tuple(volume(state_right=right) for right in (True, False, None)),
        training=(),
        confidence=CONFIDENCE,
        sequences=(),
        accuracy=ACCURACY,
    )
    words = " ".join(study_words(findings(tested=tested)))
    assert "right in 1 of 2 volumes" in words
    assert "from 18 volumes over time" in words
    assert "taken for it: 2." in words
    assert "Shifted, open frame: 62 % of coordinates" in words
    assert "root mean square 1.00 mm, 0.50 mm stated" in words
    assert "expected of such a shape: 70 %, 0.80 mm, 0.45 mm stated" in words
    assert "without a valve: at most 0.20" in words
    assert "0.75 would part these" in words


def test_the_figure_of_confidences_shows_wrong_valves_hollow():
    axes = confidence_figure(CONFIDENCE).axes[0]
    labels = [text.get_text() for text in axes.get_yticklabels()]
    assert labels == ["shifted (2)", "no valve: walls only (1)"]
    faces = {
        float(x): line.get_markerfacecolor()
        for line in axes.lines
        if line.get_linestyle() == "None"
        for x in line.get_xdata()
    }
    assert faces[0.6] == "white"
    assert faces[0.9] != "white"
    assert faces[0.2] not in ("white", faces[0.9])


def test_the_figure_of_correlations_shows_the_fitted_one():
    axes = correlation_figure(ACCURACY).axes[0]
    curve = next(line for line in axes.lines if "8.0 mm" in str(line.get_label()))
    x, y = (np.asarray(v, float) for v in curve.get_data())
    assert y[0] == pytest.approx(1.0)
    assert y[-1] == pytest.approx((1 + np.sqrt(3)) * np.exp(-np.sqrt(3)), rel=1e-6)
    assert x[-1] == 8.0
