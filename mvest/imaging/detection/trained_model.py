"""All detectors together with the shapes they know, as one file."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.files import write_atomically
from mvest.imaging.detection.boundary import BoundaryDetector
from mvest.imaging.detection.landmark_detector import LandmarkDetector
from mvest.imaging.detection.pose_search import REFINEMENTS, PoseSearch, PositionDetector
from mvest.imaging.detection.rim_detector import RimDetector
from mvest.imaging.detection.shape_model import ShapeModel
from mvest.imaging.detection.shape_start import MODES, ShapeStart
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.boosting import Boosters
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.valve_sequence import LANDMARKS
from mvest.reading.documents import parse_json
from mvest.reading.npz import read_npz
from mvest.reading.text import one_line, read_bytes
from mvest.typing import FloatArray

FORMAT = "mvest detection model"
VERSION = 1
OUTPUTS: Final = {
    "position": 1,
    "pose_coarse": 1,
    "pose_fine": 1,
    **{f"pose_refine_{k}": 7 for k in range(len(REFINEMENTS))},
    "shape": MODES + 6,
    **{f"landmark_{k}": 3 for k in range(len(LANDMARKS))},
    "annulus": 2,
    "free_edge": 2,
    "boundary": 1,
}
"""How many outputs each set of trees has."""

STAGES: Final = tuple(OUTPUTS)
"""Names of all sets of trees."""

UNFIT = (ValueError, LookupError, TypeError, ArithmeticError, AttributeError, RecursionError)
"""What arrays that are no model raise when one is made of them."""

MAX_FILE_SIZE = 2**28
"""Bytes; the model that comes with the package has a few millions."""

MAX_REASON = 120
"""Characters of another library's message that are passed on; some quote the file."""


UNLIKE_SHARE = 0.02
"""Of volumes drawn as those of training: so many are expected to count as unlike them."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectionAccuracy:
    """How the detectors err on simulated volumes that they have not seen.

    Attributes
    ----------
    std_mm : (n,)
        Of each coordinate of each vertex.
    correlation_length_mm : float
    samples : (S, F, n, 3)
        Errors in the valve's axes, mm: of S sequences, in the open and in the closed frame.
    tip_samples : (S, F, 2, 3)
    widening : (float, float)
        Factor on the errors of a volume of confidence 1, and the exponent by which it grows for
        each unit of confidence that is lacking.
    like_from : float
        Confidence below which a volume is unlike those of training: of these, `UNLIKE_SHARE` are
        expected there.
    shapes : (S, F, n, 3) mm or None
        Where the valves of these sequences were found, each frame in its own axes (`pose_of`).
        None: a model of before this was kept.
    tip_shapes : (S, F, 2, 3) mm or None
    """

    std_mm: FloatArray
    correlation_length_mm: float
    samples: FloatArray
    tip_samples: FloatArray
    widening: tuple[float, float] = (1.0, 0.0)
    like_from: float = 0.0
    shapes: FloatArray | None = None
    tip_shapes: FloatArray | None = None

    def at(self, confidence: float) -> DetectionAccuracy:
        """Errors in a volume of some confidence: wider about their mean the less it is."""
        factor = self.factor(confidence)
        mean, tip_mean = self.samples.mean(axis=0), self.tip_samples.mean(axis=0)
        return replace(
            self,
            std_mm=factor * self.std_mm,
            samples=mean + factor * (self.samples - mean),
            tip_samples=tip_mean + factor * (self.tip_samples - tip_mean),
            widening=(1.0, 0.0),
        )

    def factor(self, confidence: float) -> float:
        """On the errors of a volume of some confidence (`ValveSequence.confidence`)."""
        start, slope = self.widening
        return float(start * np.exp(slope * (1.0 - confidence)))


class DetectionModel:
    """Everything that was learned.

    Parameters
    ----------
    shape : ShapeModel
    boosters : mapping
        One for each of :data:`STAGES`.
    trained_on : mapping
        Plain values: what made it (configuration, seeds, numbers of valves and volumes, versions).
    accuracy : DetectionAccuracy, optional
        Measured on held-out data; None for a model that was never tested.
    sha256 : str
        Of the file it was read from.
    """

    def __init__(
        self,
        shape: ShapeModel,
        boosters: Mapping[str, Boosters],
        trained_on: Mapping[str, Any],
        accuracy: DetectionAccuracy | None = None,
        sha256: str = "",
    ) -> None:
        missing = [name for name in STAGES if name not in boosters]
        if missing:
            raise InputError(f"detection model: no trees for {', '.join(missing)}")
        for name, count in OUTPUTS.items():
            if boosters[name].outputs != count:
                raise InputError(
                    f"detection model: {boosters[name].outputs} outputs of {name}, expected {count}"
                )
        self.shape, self.boosters = shape, dict(boosters)
        self.trained_on, self.accuracy, self.sha256 = dict(trained_on), accuracy, sha256
        self.position = PositionDetector(boosters["position"])
        self.poses = PoseSearch(
            boosters["pose_coarse"],
            boosters["pose_fine"],
            tuple(boosters[f"pose_refine_{k}"] for k in range(len(REFINEMENTS))),
        )
        self.start = ShapeStart(boosters["shape"])
        self.landmarks = LandmarkDetector(
            tuple(boosters[f"landmark_{k}"] for k in range(len(LANDMARKS)))
        )
        self.annulus = RimDetector(0, boosters["annulus"])
        self.free_edge = RimDetector(-1, boosters["free_edge"])
        self.boundary = BoundaryDetector(boosters["boundary"])


def save_model(path: Path | str, model: DetectionModel) -> None:
    """Write a model as one ``.npz``: arrays, trees as LightGBM's text, provenance as JSON.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    shape = model.shape
    about = {
        "format": FORMAT,
        "version": VERSION,
        "columns": shape.layout.columns,
        "rows": shape.layout.rows,
        "region_names": list(shape.layout.region_names),
        "trained_on": model.trained_on,
        "trees": {name: model.boosters[name].outputs for name in STAGES},
    }
    arrays: dict[str, Any] = {
        "about": _bytes(json.dumps(about, sort_keys=True)),
        "shape.size_mm": np.array(shape.size_mm),
        "shape.mean": shape.mean.astype(np.float32),
        "shape.modes": shape.modes.astype(np.float32),
        "shape.std": shape.std,
        "shape.tips": shape.tips,
    }
    for name in STAGES:
        for k, text in enumerate(model.boosters[name].texts):
            arrays[f"trees.{name}.{k}"] = _bytes(text)
    if model.accuracy is not None:
        accuracy = model.accuracy
        arrays["accuracy.std_mm"] = accuracy.std_mm
        arrays["accuracy.correlation_length_mm"] = np.array(accuracy.correlation_length_mm)
        arrays["accuracy.samples"] = accuracy.samples.astype(np.float32)
        arrays["accuracy.tip_samples"] = accuracy.tip_samples.astype(np.float32)
        arrays["accuracy.widening"] = np.array(accuracy.widening)
        arrays["accuracy.like_from"] = np.array(accuracy.like_from)
        if accuracy.shapes is not None and accuracy.tip_shapes is not None:
            arrays["accuracy.shapes"] = accuracy.shapes.astype(np.float32)
            arrays["accuracy.tip_shapes"] = accuracy.tip_shapes.astype(np.float32)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(path, buffer.getvalue())


def load_model(path: Path | str) -> DetectionModel:
    """Read a model; nothing in the file is executed or unpickled.

    Raises
    ------
    InputError
        If the file is missing, is no such model, is of another version, or is incomplete.
    """
    source = Path(path)
    raw = read_bytes(source, MAX_FILE_SIZE)
    stored = read_npz(io.BytesIO(raw), where=str(source))
    try:
        return _model(stored, source, hashlib.sha256(raw).hexdigest())
    except UNFIT as fault:
        if isinstance(fault, InputError) and str(fault).startswith(str(source)):
            raise
        lacks = "lacks " if isinstance(fault, KeyError) else ""
        why = lacks + one_line(fault, MAX_REASON)
        raise InputError(f"{source}: {why}; expected a {FORMAT} of version {VERSION}") from fault


def default_model() -> DetectionModel:
    """The model that comes with the package, trained on simulated transoesophageal echo.

    Raises
    ------
    InputError
        If the package holds none, or it cannot be read.
    """
    if not MODEL_FILE.is_file():
        raise InputError(
            f"{MODEL_FILE}: no trained detectors come with this installation; expected what "
            "python -m experiments.run experiment=imaging imaging.model=null "
            "imaging.publish_model=true makes"
        )
    return load_model(MODEL_FILE)


def _model(stored: Mapping[str, NDArray[Any]], source: Path, sha256: str) -> DetectionModel:
    about = parse_json(_text(stored["about"]), "about")
    if not isinstance(about, dict):
        raise ValueError("says nothing about itself")
    if about.get("format") != FORMAT or about.get("version") != VERSION:
        raise InputError(
            f"{source}: format {about.get('format')!r}, version {about.get('version')!r}; expected "
            f"{FORMAT!r}, version {VERSION}"
        )
    kinds = {"columns": int, "rows": int, "region_names": list, "trees": dict, "trained_on": dict}
    for key, kind in kinds.items():
        if not isinstance(about[key], kind):
            raise ValueError(f"{key} is no {kind.__name__}")
    names = about["region_names"]
    if len(names) != 2 or not all(isinstance(name, str) for name in names):
        raise ValueError(f"region_names are {len(names)} values, not two names")
    layout = ValveLayout(about["columns"], about["rows"], (names[0], names[1]))
    n, k = layout.size, len(np.atleast_1d(stored["shape.std"]))
    shape = ShapeModel(
        layout,
        float(_numbers(stored, "shape.size_mm", ())),
        _numbers(stored, "shape.mean", (n, 3)),
        _numbers(stored, "shape.modes", (k, n, 3)),
        _numbers(stored, "shape.std", (k,)),
        _numbers(stored, "shape.tips", (2, 3)),
    )
    boosters = {}
    for name, outputs in about["trees"].items():
        if not isinstance(outputs, int):
            raise ValueError(f"trees of {name}: {outputs!r} outputs")
        texts = tuple(_text(stored[f"trees.{name}.{i}"]) for i in range(outputs))
        boosters[name] = Boosters(texts, f"{source}, {name}")
    accuracy = None
    if "accuracy.std_mm" in stored:
        count = np.shape(stored["accuracy.samples"])[:2]
        # A file of before these were measured: errors are of one size, and no volume is unlike.
        known = {"widening": np.array([1.0, 0.0]), "like_from": np.array(0.0)}
        known |= {key: stored[name] for key in known if (name := f"accuracy.{key}") in stored}
        start, slope = _numbers(known, "widening", (2,))
        shapes = tip_shapes = None
        if "accuracy.shapes" in stored:
            shapes = _numbers(stored, "accuracy.shapes", (*count, n, 3))
            tip_shapes = _numbers(stored, "accuracy.tip_shapes", (*count, 2, 3))
        accuracy = DetectionAccuracy(
            _numbers(stored, "accuracy.std_mm", (n,)),
            float(_numbers(stored, "accuracy.correlation_length_mm", ())),
            _numbers(stored, "accuracy.samples", (*count, n, 3)),
            _numbers(stored, "accuracy.tip_samples", (*count, 2, 3)),
            (float(start), float(slope)),
            float(_numbers(known, "like_from", ())),
            shapes,
            tip_shapes,
        )
    return DetectionModel(shape, boosters, about["trained_on"], accuracy, sha256)


def _numbers(stored: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...]) -> FloatArray:
    values = np.asarray(stored[name])
    if values.shape != shape or values.dtype.kind != "f" or not np.isfinite(values).all():
        raise ValueError(f"{name} has shape {values.shape}, or is not finite; expected {shape}")
    return np.asarray(values, dtype=np.float64)


def _bytes(text: str) -> NDArray[np.uint8]:
    return np.frombuffer(text.encode(), dtype=np.uint8)


def _text(array: Any) -> str:
    if not isinstance(array, np.ndarray) or array.dtype != np.uint8:
        raise ValueError("no text where there should be one")
    return array.tobytes().decode()
