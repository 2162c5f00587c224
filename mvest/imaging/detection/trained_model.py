"""A trained model: all detectors with their shape model, as one file."""

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
from mvest.imaging.detection.pose_search import MODES, REFINEMENTS
from mvest.imaging.detection.shape_model import ShapeModel
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.boosting import Boosters, Trees
from mvest.imaging.models import MODEL_FILE
from mvest.imaging.valve_sequence import LANDMARKS
from mvest.reading.documents import parse_json
from mvest.reading.npz import check_array, read_npz
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
"""Number of outputs of each set of trees."""

STAGES: Final = tuple(OUTPUTS)
"""Names of all sets of trees."""

MAX_FILE_SIZE = 2**28
"""Largest number of bytes; the model of the package has some 10 million."""

MAX_REASON = 120
"""Largest number of characters that an error quotes from another library."""

UNLIKE_SHARE = 0.02
"""Share of volumes like those of training that are expected to count as unlike them."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectionAccuracy:
    """Errors of the detectors on held-out simulated volumes: S sequences in F frames.

    F is 2: the open and the closed frame. Errors are measured in the valve's axes.
    """

    std_mm: FloatArray  #: (n,), of each coordinate of each vertex
    correlation_length_mm: float
    samples: FloatArray  #: (S, F, n, 3) mm
    tip_samples: FloatArray  #: (S, F, 2, 3) mm
    widening: tuple[float, float] = (1.0, 0.0)  #: start and slope of `factor`
    like_from: float = 0.0  #: confidence below which a volume is unlike those of training
    shapes: FloatArray | None = None  #: (S, F, n, 3) mm, detected valves, each in its own axes
    tip_shapes: FloatArray | None = None  #: (S, F, 2, 3) mm

    def at(self, confidence: float) -> DetectionAccuracy:
        """Errors in a volume of some confidence: the lower, the wider about their mean."""
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
        """Factor on the errors in a volume of some confidence (`ValveSequence.confidence`)."""
        start, slope = self.widening
        return float(start * np.exp(slope * (1.0 - confidence)))


ARRAYS: Final[Mapping[str, tuple[int | str, ...]]] = {
    "shape.size_mm": (),
    "shape.mean": ("n", 3),
    "shape.modes": ("K", "n", 3),
    "shape.std": ("K",),
    "shape.tips": (2, 3),
    "accuracy.std_mm": ("n",),
    "accuracy.correlation_length_mm": (),
    "accuracy.samples": ("S", "F", "n", 3),
    "accuracy.tip_samples": ("S", "F", 2, 3),
    "accuracy.widening": (2,),
    "accuracy.like_from": (),
    "accuracy.shapes": ("S", "F", "n", 3),
    "accuracy.tip_shapes": ("S", "F", 2, 3),
}
"""Attributes of shape model and accuracy in a file, and their shapes."""

HALVED: Final = ("n", "S")
"""Arrays with such a length and more axes are stored in single precision."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectionModel:
    """Trained detectors and their shape model."""

    shape: ShapeModel
    boosters: Trees  #: one for each of `STAGES`
    trained_on: Mapping[str, Any]  #: configuration, seeds, numbers of valves, versions
    accuracy: DetectionAccuracy | None = None  #: None if it was never measured
    sha256: str = ""  #: of the file it was read from

    @property
    def digest(self) -> str:
        """SHA-256 of all that affects a detection or its errors, so not of its provenance."""
        digest = hashlib.sha256()
        for name, array in sorted(_arrays(self).items()):
            digest.update(f"{name} {array.shape} ".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()


def save_model(path: Path | str, model: DetectionModel) -> None:
    """Write a model as one ``.npz``: arrays, trees as LightGBM's text, provenance as JSON."""
    layout = model.shape.layout
    about = {
        "format": FORMAT,
        "version": VERSION,
        "columns": layout.columns,
        "rows": layout.rows,
        "trained_on": model.trained_on,
    }
    arrays: dict[str, Any] = {"about": _bytes(json.dumps(about, sort_keys=True)), **_arrays(model)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(path, buffer.getvalue())


def _arrays(model: DetectionModel) -> dict[str, NDArray[Any]]:
    """Trees, shape model and accuracy as they are stored."""
    arrays: dict[str, Any] = {}
    for name in STAGES:
        for k, text in enumerate(model.boosters[name].texts):
            arrays[f"trees.{name}.{k}"] = _bytes(text)
    for name, lengths in ARRAYS.items():
        part, _, attribute = name.partition(".")
        value = getattr(getattr(model, part), attribute, None)
        if value is not None:
            single = len(lengths) > 1 and set(lengths) & set(HALVED)
            arrays[name] = np.asarray(value, dtype=np.float32 if single else np.float64)
    return arrays


def load_model(path: Path | str) -> DetectionModel:
    """Read a model; nothing in the file is executed or unpickled.

    InputError if the file is missing, incomplete, or not a model of this version.
    """
    source = Path(path)
    raw = read_bytes(source, MAX_FILE_SIZE)
    stored = read_npz(io.BytesIO(raw), where=str(source))
    try:
        return _model(stored, source, hashlib.sha256(raw).hexdigest())
    except (ValueError, LookupError, TypeError, ArithmeticError, AttributeError) as fault:
        if isinstance(fault, InputError) and str(fault).startswith(str(source)):
            raise
        lacks = "lacks " if isinstance(fault, KeyError) else ""
        why = lacks + one_line(fault, MAX_REASON)
        raise InputError(f"{source}: {why}; expected a {FORMAT} of version {VERSION}") from fault


def default_model() -> DetectionModel:
    """The model of the package, trained on simulated transoesophageal echo."""
    if not MODEL_FILE.is_file():
        raise InputError(
            f"{MODEL_FILE}: no trained detectors come with this installation; expected the tee.npz "
            "that python -m experiments.run experiment=imaging imaging.model=null makes"
        )
    return load_model(MODEL_FILE)


def _model(stored: Mapping[str, NDArray[Any]], source: Path, sha256: str) -> DetectionModel:
    about = parse_json(_text(stored["about"]), "about")
    if not isinstance(about, dict):
        raise ValueError("about is not a mapping")
    if about.get("format") != FORMAT or about.get("version") != VERSION:
        raise InputError(
            f"{source}: format {about.get('format')!r}, version {about.get('version')!r}; expected "
            f"{FORMAT!r}, version {VERSION}"
        )
    for key, kind in (("columns", int), ("rows", int), ("trained_on", dict)):
        if not isinstance(about[key], kind):
            raise ValueError(f"{key} is not of type {kind.__name__}")
    layout = ValveLayout(about["columns"], about["rows"])
    sizes = {"n": layout.size, "K": len(stored["shape.std"])}
    parts: dict[str, dict[str, Any]] = {"shape": {}, "accuracy": {}}
    if "accuracy.std_mm" in stored:
        sizes |= dict(zip("SF", stored["accuracy.samples"].shape, strict=False))
    for name, lengths in ARRAYS.items():
        part, _, attribute = name.partition(".")
        if name in stored or part == "shape":
            wanted = [sizes[x] if isinstance(x, str) else x for x in lengths]
            value = check_array(stored[name], name, "f", wanted)
            parts[part][attribute] = value if len(lengths) else float(value)
    boosters = {}
    for name, outputs in OUTPUTS.items():
        texts = tuple(_text(stored[f"trees.{name}.{k}"]) for k in range(outputs))
        boosters[name] = Boosters(texts, f"{source}, {name}")
    accuracy = None
    if parts["accuracy"]:
        start, slope = parts["accuracy"].pop("widening").tolist()
        accuracy = DetectionAccuracy(**parts["accuracy"], widening=(start, slope))
    shape = ShapeModel(layout, **parts["shape"])
    return DetectionModel(shape, boosters, about["trained_on"], accuracy, sha256)


def _bytes(text: str) -> NDArray[np.uint8]:
    return np.frombuffer(text.encode(), dtype=np.uint8)


def _text(array: Any) -> str:
    if not isinstance(array, np.ndarray) or array.dtype != np.uint8:
        raise ValueError("an array is not text")
    return array.tobytes().decode()
