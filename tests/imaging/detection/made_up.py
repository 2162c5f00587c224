"""Valves made up for tests of detectors, and detectors that know where the valve is.

An oracle stands in for trees. Features are replaced by the geometry they were taken at (see
`geometry`), from which an oracle computes what well trained trees would say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.imaging.detection import leaflets, pose_search
from mvest.imaging.detection.pose import Poses
from mvest.imaging.detection.pose_search import MODES
from mvest.imaging.detection.shape_model import LabelledFrame, TrueValve
from mvest.imaging.detection.trained_model import STAGES, DetectionModel
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve, landmark_vertices
from mvest.imaging.volume import VolumeSequence
from mvest.valve.anatomy.template import Template
from tests import made_up_sequence

LAYOUT = ValveLayout(16, 7)
TIPS = np.array([Template().parameters.papillary.tip, Template().parameters.papillary.tip]) * [
    [1, 1, 1],
    [-1, 1, 1],
]


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
    return MovingValve(
        f"made up {number}",
        layout,
        0.04 * np.arange(frames),
        vertices,
        tips,
        np.full(layout.size, 1.2),
        np.array([30.0, 210.0]),
        np.array([0.9, 0.9]),
        np.array([0, 1]),
    )


def poses(count, seed=0, far_mm=20.0):
    """Poses at random."""
    rng = np.random.default_rng(seed)
    return Poses(
        rng.standard_normal((count, 3)) * far_mm,
        Rotation.random(count, rng=rng).as_matrix(),
        rng.standard_normal(count) * 0.1,
    )


def placed(shape, pose, coefficients):
    """A true valve that a shape model can show exactly."""
    vertices = pose.world(shape.shape(coefficients[None]))[0]
    return TrueValve(vertices, pose.world(shape.tips)[0], pose)


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
    frames = np.clip(grey, 0, 255).reshape(1, *shape).astype(np.uint8)
    return VolumeSequence(
        frames, volume.spacing, volume.direction, volume.origin, volume.times, source="made up"
    )


# --- oracles ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NumberedFrame:
    """Stands in for a frame: says which one it is."""

    number: int = 0


def labelled(true, shape, seed=0, frame=NumberedFrame()):
    """A frame to draw samples from."""
    return LabelledFrame(frame, true, shape, np.random.default_rng(seed))


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


def rim_oracle(truths, layout, row):
    """Away from the leaflet and across it to the true rim; candidates come column by column."""

    def answer(x):
        points, rotation, _, frame = seen(x)
        columns = np.arange(len(x)) * layout.columns // len(x)
        target = truths[frame].vertices.reshape(layout.rows, layout.columns, 3)[row]
        return np.einsum("pij,pi->pj", rotation, target[columns] - points)[:, 1:]

    return Oracle(2, answer)


def boundary_oracle(truths, layout, width_mm=0.6, best=1.0):
    """How likely a place is on the true leaflet, at most `best`; they come vertex by vertex."""

    def answer(x):
        points, rotation, _, frame = seen(x)
        which = np.arange(len(x)) * layout.size // len(x)
        gap = ((truths[frame].vertices[which] - points) * rotation[:, :, 2]).sum(axis=1)
        return best * np.exp(-0.5 * (gap / width_mm) ** 2)[:, None]

    return Oracle(1, answer)


def landmark_oracle(truths, layout, number):
    at = list(landmark_vertices(layout).values())

    def answer(x):
        points, rotation, _, frame = seen(x)
        true = truths[frame]
        target = np.concatenate([true.vertices[at], true.tips])[number]
        return np.einsum("pij,pi->pj", rotation, target - points)

    return Oracle(3, answer)


def rating_oracle(truths, shape, best=1.0):
    """Best at the true pose, and the less the farther the mean valve's annulus is from it."""
    points = shape.mean[shape.layout.annulus]

    def answer(x):
        centre, rotation, log_scale, frame = seen(x)
        gap = Poses(centre, rotation, log_scale).world(points) - truths[frame].pose.world(points)
        return best * np.exp(-np.linalg.norm(gap, axis=2).mean(axis=1) / 6.0)[:, None]

    return Oracle(1, answer)


def refinement_oracle(truths, share=0.8):
    """Takes a share of the error back."""

    def answer(x):
        here = Poses(*seen(x)[:3])
        return share * here.towards(truths[seen(x)[3]].pose.repeated(len(x)))

    return Oracle(7, answer)


def start_oracle(truths, shape, modes):
    def answer(x):
        here, true = Poses(*seen(x)[:3]), truths[seen(x)[3]]
        local = here.local(np.broadcast_to(true.vertices, (len(x), *true.vertices.shape)))
        tips = here.local(np.broadcast_to(true.tips, (len(x), 2, 3)))
        told = shape.coefficients(local)[:, :modes] / shape.std[:modes]
        return np.concatenate([told, (tips - shape.tips).reshape(-1, 6)], axis=1)

    return Oracle(modes + 6, answer)


def position_oracle(truths):
    def answer(x):
        points, _, _, frame = seen(x)
        gap = np.linalg.norm(points - truths[frame].pose.centre, axis=1)
        return np.exp(-0.5 * (gap / 6.0) ** 2)[:, None]

    return Oracle(1, answer)


def oracle_model(shape, truths, best=1.0, accuracy=None, seen=1.0):
    """A detection model all of whose trees know where the valve is in every frame.

    Poses are rated `best` at most, and the boundary `seen`.
    """
    layout = shape.layout

    def of(name):
        if name == "position":
            return position_oracle(truths)
        if name in ("pose_coarse", "pose_fine"):
            return rating_oracle(truths, shape, best)
        if name.startswith("pose_refine"):
            return refinement_oracle(truths)
        if name == "shape":
            return start_oracle(truths, shape, MODES)
        if name.startswith("landmark_"):
            return landmark_oracle(truths, layout, int(name.removeprefix("landmark_")))
        if name in ("annulus", "free_edge"):
            return rim_oracle(truths, layout, 0 if name == "annulus" else -1)
        assert name == "boundary"
        return boundary_oracle(truths, layout, best=seen)

    return DetectionModel(shape, {name: of(name) for name in STAGES}, {}, accuracy)


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
