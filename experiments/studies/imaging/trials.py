"""Trials of detectors on simulated volumes: all that the study asks of detection is here."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mvest.cases.from_images.measures import OPEN_SHARE
from mvest.errors import GeometryError
from mvest.imaging.detection.detect import find_frame
from mvest.imaging.detection.frame import standard_frame
from mvest.imaging.detection.pose import pose_of
from mvest.imaging.detection.tracking import TrackingSettings, detect_valve
from mvest.imaging.detection.trained_model import DetectionModel, load_model
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.evaluation import frame_errors, surface_distances
from mvest.imaging.learning.training import Setting, render_frame
from mvest.imaging.learning.truth import TrueValve
from mvest.imaging.moving_valve import MovingValve
from mvest.imaging.simulator.acquisition import Acquisition
from mvest.imaging.simulator.acquisition_ranges import draw_acquisition
from mvest.imaging.simulator.probe import draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.imaging.volume import VolumeSequence
from mvest.typing import FloatArray
from mvest.valve.measure.annulus import annulus_plane, measure_annulus
from mvest.valve.measure.coaptation import orifice_area

__all__ = ["SEQUENCES", "VOLUMES", "WITHOUT_VALVE", "Trial", "try_sequence", "try_volume"]

ABSENT_DB = -80.0
"""Echo of what is not there: far below the noise."""

VALVE = ("leaflet_db", "annulus_db", "chord_db")
REST = ("wall_db", "vessel_db", "papillary_db")

WITHOUT_VALVE = {"walls only": VALVE, "no tissue": (*VALVE, *REST), "white noise": ()}
"""Kinds of volumes in which there is no valve -> what sends no echo in them; the last is not
simulated at all."""

PIXEL_MM = 0.3
"""mm, of the picture in which the orifice is counted."""


VOLUMES = ("in distribution", "shifted")
"""Kinds of volumes of one frame with a valve, as tables call them."""

SEQUENCES = ("calibration", "sequence", "shifted sequence", "wide calibration")
"""Kinds of volumes of all frames of a valve; those of calibration say how far detectors are off."""

KINDS = (*VOLUMES, *WITHOUT_VALVE, *SEQUENCES)


@dataclass(frozen=True, slots=True)
class Trial:
    """One volume to be simulated.

    Attributes
    ----------
    kind : str
        One of :data:`VOLUMES`, :data:`WITHOUT_VALVE` or :data:`SEQUENCES`.
    number : int
        Among those of its kind.
    seed : int
        Of the study.
    acquisition : Acquisition
        About which its own is drawn.
    """

    kind: str
    number: int
    seed: int
    acquisition: Acquisition

    @property
    def spread(self) -> Setting:
        """Whether its acquisition is drawn as in training, or in part or wholly outside."""
        if self.kind.startswith("wide"):
            return "wide"
        return "shifted" if self.kind.startswith("shifted") else "training"

    @property
    def random(self) -> np.random.SeedSequence:
        """Its own stream, of no other kind or number, nor of the training's volumes."""
        return np.random.SeedSequence([self.seed, 1 + KINDS.index(self.kind), self.number])


@lru_cache(maxsize=8)
def _model(path: str) -> DetectionModel:
    return load_model(path)


def try_volume(
    valve: MovingValve, asked: Trial, models: Mapping[str, Path], settings: TrackingSettings
) -> dict[str, dict[str, Any]]:
    """Simulate a volume and let several detectors find the valve in it.

    Parameters
    ----------
    valve : MovingValve
    asked : Trial
    models : mapping
        Any name -> file of detectors.
    settings : TrackingSettings

    Returns
    -------
    dict
        Name -> plain values: of every volume its kind, valve, frame, ``confidence`` and ``cpu_s``
        of one thread (what simulation takes is no part of it); where there is a valve, also errors
        in mm and degrees, measures, estimated and true, and the distances after each stage.
    """
    choose, render = asked.random.spawn(2)
    frame = int(np.random.default_rng(choose).integers(len(valve.times)))
    has_valve = asked.kind not in WITHOUT_VALVE
    base = asked.acquisition
    if not has_valve:
        nothing = dict.fromkeys(WITHOUT_VALVE[asked.kind], ABSENT_DB)
        base = replace(base, **nothing, shadow_db_per_cm=0.0)  # type: ignore[arg-type]
    seen = render_frame(valve, frame, base, asked.spread, render)
    volume = seen.volume
    if asked.kind == "white noise":
        volume = _white_noise(volume, render)
    detected = {}
    for name, path in models.items():
        model = _model(str(path))
        began = time.process_time()
        picture = standard_frame(volume, 0)
        fitted = find_frame(picture, model, settings.fit)
        row: dict[str, Any] = {
            "kind": asked.kind,
            "number": asked.number,
            "valve": valve.name,
            "frame": frame,
            "cpu_s": time.process_time() - began,
            "confidence": float(fitted.confidence),
        }
        if has_valve:
            true = TrueValve.of(seen.vertices, seen.tips, model.shape)
            layout = model.shape.layout
            row |= {
                "errors": asdict(frame_errors(fitted, fitted.vertices, fitted.tips, true, layout)),
                "true": measures(seen.vertices, seen.tips, layout),
                "estimated": measures(fitted.vertices, fitted.tips, layout),
            }
        detected[name] = row
    return detected


def _white_noise(volume: VolumeSequence, seed: np.random.SeedSequence) -> VolumeSequence:
    grey = np.random.default_rng(seed).integers(0, 256, volume.frames.shape, dtype=np.uint8)
    return replace(volume, frames=grey, source="white noise", sha256="")


def try_sequence(
    valve: MovingValve,
    asked: Trial,
    closed: int,
    model_file: Path,
    settings: TrackingSettings,
) -> dict[str, Any]:
    """Simulate all frames of a valve as one volume and let detectors find it.

    Parameters
    ----------
    valve : MovingValve
    asked : Trial
    closed : int
        Number of its closed frame; the first one is open.
    model_file : Path
    settings : TrackingSettings
        However little it is believed in, a valve is returned.

    Returns
    -------
    dict
        ``row`` (plain values, JSON text), and in mm, estimated minus true in the valve's own axes,
        ``errors`` (2, n, 3) and ``tip_errors`` (2, 2, 3) of the open and the closed frame;
        ``shapes`` and ``tip_shapes``, where the valve was found, in the axes of what was found; and
        ``rest`` (n, 3), where the true open valve's vertices are.
    """
    draw, scan = asked.random.spawn(2)
    rng = np.random.default_rng(draw)
    acquisition = draw_acquisition(rng, asked.acquisition, asked.spread)
    probe = draw_probe(rng, acquisition)
    volume = simulate_volume(valve, acquisition, probe, int(scan.generate_state(1)[0]))
    true = true_sequence(valve, probe)
    model, layout = _model(str(model_file)), valve.layout
    began = time.process_time()
    detected = detect_valve(volume, model, replace(settings, min_confidence=0.0))
    cpu_s = time.process_time() - began
    frames = []
    for k in range(len(true.times)):
        x, tips, right = detected.vertices[k], detected.tips[k], true.vertices[k]
        there, back = surface_distances(x, right, layout)
        frames.append(
            {
                "surface": float(0.5 * (there.mean() + back.mean())),
                "points": float(np.linalg.norm(x - right, axis=1).mean()),
                "tips": float(np.linalg.norm(tips - true.tips[k], axis=1).mean()),
                "confidence": float(detected.frame_confidence[k]),
                "true": measures(right, true.tips[k], layout),
                "estimated": measures(x, tips, layout),
            }
        )
    row = {
        "kind": asked.kind,
        "number": asked.number,
        "valve": valve.name,
        "cpu_s": cpu_s,
        "closed": closed,
        "frames": frames,
    }
    two = [0, closed]
    axes = [pose_of(true.vertices[k], true.tips[k], layout) for k in two]
    turn = np.concatenate([pose.rotation for pose in axes])
    found = [pose_of(detected.vertices[k], detected.tips[k], layout) for k in two]
    centre = np.stack([pose.centre for pose in found])
    own = np.concatenate([pose.rotation for pose in found])
    return {
        "row": json.dumps(row),
        "errors": (detected.vertices[two] - true.vertices[two]) @ turn,
        "tip_errors": (detected.tips[two] - true.tips[two]) @ turn,
        "shapes": (detected.vertices[two] - centre) @ own,
        "tip_shapes": (detected.tips[two] - centre) @ own,
        "rest": (true.vertices[0] - axes[0].centre[0]) @ turn[0],
    }


def measures(vertices: FloatArray, tips: FloatArray, layout: ValveLayout) -> dict[str, Any]:
    """What clinicians measure: area (mm²) and AP diameter (mm) of the annulus, and the orifice.

    None is what a shape defies.
    """
    annulus = vertices[layout.annulus]
    try:
        plane = annulus_plane(annulus, tips.mean(axis=0), annulus[layout.column(90.0)])
        size = measure_annulus(annulus, plane)
        orifice = orifice_area(vertices, layout.triangles, annulus, plane, PIXEL_MM)
    except GeometryError:
        return dict.fromkeys(("annulus_area_mm2", "ap_diameter_mm", "orifice_mm2", "is_open"))
    return {
        "annulus_area_mm2": size.projected_area,
        "ap_diameter_mm": size.anteroposterior_diameter,
        "orifice_mm2": orifice,
        "is_open": bool(orifice >= OPEN_SHARE * size.projected_area),
    }
