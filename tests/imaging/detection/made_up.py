"""Valves made up for tests of detectors, and detectors that know where the valve is.

An oracle stands in for trees. Features are replaced by the geometry they were taken at (see
`geometry`), from which an oracle computes what well trained trees would say.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.imaging.detection import leaflets, pose_search
from mvest.imaging.detection.leaflets import landmark_points
from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.pose_search import MODES, REFINEMENTS
from mvest.imaging.detection.shape_model import LabelledFrame
from mvest.imaging.detection.trained_model import DetectionModel
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import LANDMARKS, MovingValve
from mvest.imaging.volume import VolumeSequence
from mvest.valve.anatomy.template import Template
from tests import made_up_sequence

LAYOUT = ValveLayout(16, 7)
TIPS = np.array([[1, 1, 1], [-1, 1, 1]]) * Template().parameters.papillary.tip


def moving_valve(number, frames=4, layout=LAYOUT):
    """A valve of its own proportions from open to closed."""
    rng = np.random.default_rng(number)
    stretch = 1 + 0.1 * rng.standard_normal(3)
    bump = rng.standard_normal((4, 3)) * 0.8
    phi, s = np.deg2rad(layout.phi), layout.s
    waves = np.stack([np.sin(phi) * s, np.cos(phi) * s, np.sin(2 * phi) * s, np.cos(2 * phi)], 1)
    closures = np.linspace(0, 1, frames) if frames > 1 else [0.5]
    vertices = np.stack(
        [made_up_sequence.leaflets(layout, c) * stretch + waves @ bump for c in closures]
    )
    tips = TIPS * stretch + rng.standard_normal((frames, 2, 3))
    chordae = np.array([30.0, 210.0]), np.array([0.9, 0.9]), np.array([0, 1])
    times, thickness = 0.04 * np.arange(frames), np.full(layout.size, 1.2)
    return MovingValve(f"made up {number}", layout, times, vertices, tips, thickness, *chordae)


def poses(count, seed=0, far_mm=20.0):
    """Poses at random."""
    rng = np.random.default_rng(seed)
    return Poses(
        rng.standard_normal((count, 3)) * far_mm,
        Rotation.random(count, rng=rng).as_matrix(),
        rng.standard_normal(count) * 0.1,
    )


class Placed(NamedTuple):
    """A valve in the world."""

    vertices: np.ndarray
    tips: np.ndarray
    pose: Poses


def placed(shape, pose, coefficients):
    """A true valve that a shape model can show exactly."""
    vertices = pose.world(shape.shape(coefficients[None]))[0]
    return Placed(vertices, pose.world(shape.tips)[0], pose)


def ball_volume(spacing, direction, origin, shape, points, width_mm=2.0, background=40):
    """A noisy volume with a bright ball at each world point."""
    rng = np.random.default_rng(11)
    volume = VolumeSequence(
        np.zeros((1, *shape), np.uint8),
        np.asarray(spacing, float),
        np.asarray(direction),
        np.asarray(origin, float),
        np.zeros(1),
        source="made up",
    )
    index = np.stack(np.meshgrid(*(np.arange(k) for k in shape), indexing="ij"), -1)
    world = volume.world(index.reshape(-1, 3).astype(float))
    grey = rng.uniform(background / 2, background, len(world))
    for point in points:
        grey += 200 * np.exp(-0.5 * ((world - point) ** 2).sum(axis=1) / width_mm**2)
    return replace(volume, frames=np.clip(grey, 0, 255).reshape(1, *shape).astype(np.uint8))


# --- oracles ------------------------------------------------------------------------------------
class NumberedFrame(NamedTuple):
    """Stands in for a frame: only its number."""

    number: int = 0


FIRST = NumberedFrame()


def labelled(true, shape, seed=0, frame=FIRST):
    """A frame to draw samples from."""
    return LabelledFrame(frame, *true, shape, np.random.default_rng(seed))


def geometry(frame, pattern, points, axes):
    """Stands in for features: where they were taken, along which axes, in which frame."""
    number = np.full((len(points), 1), float(frame.number))
    return np.concatenate([points, np.reshape(axes, (len(points), 9)), number], axis=1)


def seen(x):
    """Points, rotations, log scales and the frame's number out of `geometry`."""
    axes = x[:, 3:12].reshape(-1, 3, 3)
    scale = np.linalg.norm(axes[:, :, 0], axis=1)
    return x[:, :3], axes / scale[:, None, None], np.log(scale), int(x[0, 12]) if len(x) else 0


class Oracle:
    """Looks like `Boosters`; `answer` takes what `geometry` gave and returns the outputs."""

    def __init__(self, outputs, answer):
        self.outputs, self.answer = outputs, answer

    def __call__(self, x):
        return self.answer(x) if len(x) else np.zeros((0, self.outputs))


def knowing(truths, outputs, answer):
    """An oracle; `answer` takes the true valve of the frame and the poses of all hypotheses."""

    def of(x):
        *hypotheses, frame = seen(x)
        return answer(truths[frame], Poses(*hypotheses))

    return Oracle(outputs, of)


def gaps(here, to):
    """Where points lie from hypotheses, in their axes."""
    return np.einsum("pij,pi->pj", here.rotation, to - here.centre)


def rim_oracle(truths, layout, row):
    """Away from the leaflet and across it to the true rim; candidates come column by column."""

    def answer(true, here):
        columns = np.arange(len(here)) * layout.columns // len(here)
        return gaps(here, true.vertices.reshape(layout.rows, -1, 3)[row][columns])[:, 1:]

    return knowing(truths, 2, answer)


def boundary_oracle(truths, layout, best=1.0):
    """How likely a place is on the true leaflet, at most `best`; they come vertex by vertex."""

    def answer(true, here):
        gap = gaps(here, true.vertices[np.arange(len(here)) * layout.size // len(here)])[:, 2:]
        return best * np.exp(-0.5 * (gap / 0.6) ** 2)

    return knowing(truths, 1, answer)


def landmark_oracle(truths, layout, k):
    def answer(true, here):
        return gaps(here, landmark_points(true.vertices, true.tips, layout)[k])

    return knowing(truths, 3, answer)


def rating_oracle(truths, shape, best=1.0):
    """Best at the true pose, and the less the farther the mean valve's annulus is from it."""
    points = shape.mean[shape.layout.annulus]

    def answer(true, here):
        gap = np.linalg.norm(here.world(points) - true.pose.world(points), axis=2)
        return best * np.exp(-gap.mean(axis=1) / 6.0)[:, None]

    return knowing(truths, 1, answer)


def refinement_oracle(truths, share=0.8):
    """Corrects a share of the error."""

    def answer(true, here):
        return share * here.towards(true.pose.repeated(len(here)))

    return knowing(truths, 7, answer)


def start_oracle(truths, shape):
    def answer(true, here):
        local = here.local(np.broadcast_to(true.vertices, (len(here), *true.vertices.shape)))
        tips = here.local(np.broadcast_to(true.tips, (len(here), 2, 3)))
        b = shape.coefficients(local)[:, :MODES] / shape.std[:MODES]
        return np.concatenate([b, (tips - shape.tips).reshape(-1, 6)], axis=1)

    return knowing(truths, MODES + 6, answer)


def position_oracle(truths):
    def answer(true, here):
        gap = np.linalg.norm(here.centre - true.pose.centre, axis=1)
        return np.exp(-0.5 * (gap / 6.0) ** 2)[:, None]

    return knowing(truths, 1, answer)


def oracle_model(shape, truths, best=1.0, accuracy=None, seen=1.0):
    """A detection model whose trees know the valve of every frame.

    Poses are rated `best` at most, and the boundary `seen`.
    """
    layout, rating = shape.layout, rating_oracle(truths, shape, best)
    known = {
        "position": position_oracle(truths),
        "pose_coarse": rating,
        "pose_fine": rating,
        **{f"pose_refine_{k}": refinement_oracle(truths) for k in range(len(REFINEMENTS))},
        "shape": start_oracle(truths, shape),
        **{f"landmark_{k}": landmark_oracle(truths, layout, k) for k in range(len(LANDMARKS))},
        "annulus": rim_oracle(truths, layout, 0),
        "free_edge": rim_oracle(truths, layout, -1),
        "boundary": boundary_oracle(truths, layout, seen),
    }
    return DetectionModel(shape, known, {}, accuracy)


def use_geometry(monkeypatch, truths):
    """Let every stage see geometry instead of ranks; places lie on a grid about the valve."""
    for module in (leaflets, pose_search):
        monkeypatch.setattr(module, "features", geometry)
    ticks = np.arange(-30.0, 31.0, 6.0)
    grid = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)

    def shells(frame, points):
        return geometry(frame, None, points, np.broadcast_to(np.eye(3), (len(points), 3, 3)))

    monkeypatch.setattr(pose_search, "_shell_features", shells)
    monkeypatch.setattr(
        pose_search, "_places", lambda frame: truths[0].pose.centre[0] + [1.3, -0.7, 2.1] + grid
    )
