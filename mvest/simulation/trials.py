"""Trials of detectors on simulated volumes of valves that are not in the training."""

import json
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mvest.cases.from_images.measures import OPEN_SHARE
from mvest.errors import GeometryError
from mvest.imaging.detection.detect import find_frame
from mvest.imaging.detection.frame import standard_frame
from mvest.imaging.detection.pose import Poses, pose_of
from mvest.imaging.detection.tracking import detect_valve
from mvest.imaging.detection.trained_model import load_model
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.training import render_frame
from mvest.imaging.simulator.acquisition import Acquisition, Setting, draw_acquisition, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.imaging.valve_sequence import MovingValve
from mvest.observation.surfaces import surface_distance
from mvest.typing import FloatArray
from mvest.valve.measure.annulus import annulus_plane, measure_annulus
from mvest.valve.measure.coaptation import orifice_area

Shape = tuple[FloatArray, FloatArray]
"""Vertices ``(n, 3)`` and papillary tips ``(2, 3)`` of a valve, mm."""

ABSENT_DB = -80.0
"""Echo of absent tissue, far below the noise."""

VALVE = ("leaflet_db", "annulus_db", "chord_db")
REST = ("wall_db", "vessel_db", "papillary_db")

WITHOUT_VALVE = {"walls only": VALVE, "no tissue": (*VALVE, *REST), "white noise": ()}
"""Kinds of volumes without a valve -> tissue without echo. White noise is not simulated."""

VOLUMES = ("in distribution", "shifted")
"""Kinds of volumes of one frame of a valve: within and outside the ranges of the training."""

SEQUENCES = ("calibration", "sequence", "shifted sequence", "wide calibration")
"""Kinds of volumes of all frames of a valve. The calibration measures the detectors' errors."""

KINDS = (*VOLUMES, *WITHOUT_VALVE, *SEQUENCES)

PIXEL_MM = 0.3
"""mm, of the picture in which the orifice is measured."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One volume to be simulated."""

    kind: str  #: one of :data:`KINDS`
    number: int  #: among those of its kind
    seed: int  #: of the study
    acquisition: Acquisition  #: acquisitions are drawn about it
    closed: int  #: number of the closed frame of its valve; the first one is open

    @property
    def spread(self) -> Setting:
        """Whether its acquisition is drawn as in training, or partly or completely outside."""
        if self.kind.startswith("wide"):
            return "wide"
        return "shifted" if self.kind.startswith("shifted") else "training"

    @property
    def random(self) -> np.random.SeedSequence:
        """Its own stream, shared with no other trial and with no training volume."""
        return np.random.SeedSequence([self.seed, 1 + KINDS.index(self.kind), self.number])


_model = lru_cache(maxsize=8)(load_model)


def try_volume(valve: MovingValve, trial: Trial, model_file: Path) -> dict[str, Any]:
    """Simulate one frame and search it.

    Returns ``row``, JSON text with kind, number, valve, frame and confidence. For a volume of a
    valve it has also the errors of `_errors`, with sign.
    """
    choose, render = trial.random.spawn(2)
    frame = int(np.random.default_rng(choose).integers(len(valve.times)))
    base, has_valve = trial.acquisition, trial.kind not in WITHOUT_VALVE
    if not has_valve:
        nothing = dict.fromkeys(WITHOUT_VALVE[trial.kind], ABSENT_DB)
        base = replace(base, **nothing, shadow_db_per_cm=0.0)  # type: ignore[arg-type]
    volume, seen = render_frame(valve, frame, base, trial.spread, render)
    if trial.kind == "white noise":
        grey = np.random.default_rng(render).integers(0, 256, volume.frames.shape, dtype=np.uint8)
        volume = replace(volume, frames=grey, source="white noise", sha256="")
    model = _model(str(model_file))
    found = find_frame(standard_frame(volume, 0), model)
    row: dict[str, Any] = {
        "kind": trial.kind,
        "number": trial.number,
        "valve": valve.name,
        "frame": frame,
        "confidence": float(found.confidence),
    }
    if has_valve:
        row |= _errors((found.vertices, found.tips), (seen.vertices[0], seen.tips[0]), seen.layout)
    return {"row": json.dumps(row)}


def try_sequence(valve: MovingValve, trial: Trial, model_file: Path) -> dict[str, Any]:
    """Simulate all frames of a valve as one volume and search it.

    The detected valve counts however low its confidence is.

    Returns a dict: ``row``: JSON text like that of `try_volume`, with means of the absolute errors
    over the frames; ``confidence`` is that of the best frame. ``errors`` (2, n, 3) and
    ``tip_errors`` (2, 2, 3), detected minus true in the valve's own axes, mm, in the open and the
    closed frame. ``shapes`` and ``tip_shapes``: the detected valve in its detected axes. ``rest``
    (n, 3): the true open vertices.
    """
    draw, scan = trial.random.spawn(2)
    rng = np.random.default_rng(draw)
    acquisition = draw_acquisition(rng, trial.acquisition, trial.spread)
    probe = draw_probe(rng, acquisition)
    volume = simulate_volume(valve, acquisition, probe, int(scan.generate_state(1)[0]))
    true = true_sequence(valve, probe)
    model, layout = _model(str(model_file)), valve.layout
    found = detect_valve(volume, model, min_confidence=0.0)
    shapes = (list(zip(one.vertices, one.tips, strict=True)) for one in (found, true))
    frames = [_errors(a, b, layout) for a, b in zip(*shapes, strict=True)]
    two = [0, trial.closed]
    sizes: dict[str, float | None] = {}
    for name in frames[0]:
        known = [abs(value) for one in frames if (value := one[name]) is not None]
        sizes[name] = float(np.mean(known)) if known else None
    row = {
        "kind": trial.kind,
        "number": trial.number,
        "valve": valve.name,
        "frames": len(frames),
        "confidence": float(found.frame_confidence.max()),
        "median_confidence": float(np.median(found.frame_confidence)),
        **sizes,
        "surface_open": frames[0]["surface"],
        "surface_closed": frames[trial.closed]["surface"],
    }
    own, right = (
        Poses.joined([pose_of(one.vertices[k], one.tips[k], layout) for k in two])
        for one in (found, true)
    )
    return {
        "row": json.dumps(row),
        "errors": (found.vertices[two] - true.vertices[two]) @ right.rotation,
        "tip_errors": (found.tips[two] - true.tips[two]) @ right.rotation,
        "shapes": (found.vertices[two] - own.centre[:, None]) @ own.rotation,
        "tip_shapes": (found.tips[two] - own.centre[:, None]) @ own.rotation,
        "rest": (true.vertices[0] - right.centre[0]) @ right.rotation[0],
    }


def _errors(found: Shape, true: Shape, layout: ValveLayout) -> dict[str, float | None]:
    """Errors of a detected valve, and of its clinical measures.

    Mean distances in mm: ``surface`` (of the vertices of each surface from the other one),
    ``points`` (of corresponding vertices) and ``tips``. Detected minus true: ``annulus_area`` (% of
    the true one) and ``ap_diameter`` (mm). ``state_right``: 100 if an open valve is detected as
    open and a closed one as closed, otherwise 0. None if a shape cannot be measured.
    """
    (x, tips), (true_x, true_tips) = found, true
    there, back = (
        surface_distance(points, surface, layout.triangles).mean()
        for points, surface in ((x, true_x), (true_x, x))
    )
    errors: dict[str, float | None] = {
        "surface": float(0.5 * (there + back)),
        "points": float(np.linalg.norm(x - true_x, axis=1).mean()),
        "tips": float(np.linalg.norm(tips - true_tips, axis=1).mean()),
        **dict.fromkeys(("annulus_area", "ap_diameter", "state_right")),
    }
    with suppress(GeometryError):
        measured = []
        for vertices, at in (found, true):
            annulus = vertices[layout.annulus]
            plane = annulus_plane(annulus, at.mean(axis=0), annulus[layout.column(90.0)])
            size = measure_annulus(annulus, plane)
            orifice = orifice_area(vertices, layout.triangles, annulus, plane, PIXEL_MM)
            open_ = bool(orifice >= OPEN_SHARE * size.projected_area)
            measured.append((size.projected_area, size.anteroposterior_diameter, open_))
        (area, diameter, is_open), (true_area, true_diameter, truly_open) = measured
        errors["annulus_area"] = 100.0 * (area - true_area) / true_area
        errors["ap_diameter"] = diameter - true_diameter
        errors["state_right"] = 100.0 * (is_open == truly_open)
    return errors
