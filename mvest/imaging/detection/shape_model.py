"""How valves differ (a mean shape and its principal modes, pose taken off), and fitting a shape.

Papillary tips have a mean only; they are found by themselves, since a shape fitted to the leaflets
moves them for no reason of their own.

The fitted shape is the most probable one that agrees with what was seen, then takes up what the
model cannot show. Everything seen is a pull: a vertex is to move by so much along a direction, give
or take a standard deviation. Pose and coefficients follow from a linear least-squares problem with
the shape model's prior (maximum a posteriori), repeated with weights that make little of what
disagrees; a smooth displacement of the vertices then takes up the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from mvest.errors import InputError
from mvest.imaging.detection.frame import StandardFrame
from mvest.imaging.detection.pose import Poses, pose_of
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve
from mvest.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class ShapeModel:
    """Shapes in pose-free axes (see :class:`Poses`), mm at the size of the mean valve.

    Attributes
    ----------
    layout : ValveLayout
    size_mm : float
        Root mean square distance of the mean valve's annulus from its centre.
    mean : (n, 3)
    modes : (K, n, 3)
        Orthonormal.
    std : (K,)
        mm, standard deviation of each mode's coefficient, decreasing.
    tips : (2, 3)
        Mean papillary tips.
    """

    layout: ValveLayout
    size_mm: float
    mean: FloatArray
    modes: FloatArray
    std: FloatArray
    tips: FloatArray

    def shape(self, coefficients: FloatArray) -> FloatArray:
        """Shapes ``(P, n, 3)`` of coefficients ``(P, k)`` of the first k modes."""
        k = coefficients.shape[1]
        return np.asarray(self.mean + np.tensordot(coefficients, self.modes[:k], axes=(1, 0)))

    def pose_of(self, vertices: FloatArray, tips: FloatArray) -> Poses:
        """The pose of one valve ``(n, 3)`` with its tips ``(2, 3)``."""
        return pose_of(vertices, tips, self.layout, self.size_mm)

    def coefficients(self, local: FloatArray) -> FloatArray:
        """``(P, K)`` of shapes ``(P, n, 3)`` without pose."""
        return np.asarray(np.tensordot(local - self.mean, self.modes, axes=([1, 2], [1, 2])))


def fit_shape_model(valves: Sequence[MovingValve], modes: int) -> ShapeModel:
    """Mean and principal modes over all frames of all valves.

    Raises
    ------
    InputError
        If there are fewer shapes than modes, or layouts differ.
    """
    layout = valves[0].layout
    if any(valve.layout != layout for valve in valves):
        raise InputError("shape model: valves are not all in the same layout")
    shapes = [
        (vertices, tips)
        for valve in valves
        for vertices, tips in zip(valve.vertices, valve.tips, strict=True)
    ]
    if len(shapes) <= modes:
        raise InputError(f"shape model: {len(shapes)} shapes, expected more than {modes} modes")
    # Every valve counts alike, however many frames it has.
    weight = np.concatenate([np.full(len(v.vertices), 1 / len(v.vertices)) for v in valves])
    weight /= weight.sum()
    size = float(np.exp(weight @ [pose_of(v, t, layout).log_scale[0] for v, t in shapes]))
    local, tips = [], []
    for vertices, tip in shapes:
        pose = pose_of(vertices, tip, layout, size)
        local.append(pose.local(vertices[None])[0])
        tips.append(pose.local(tip[None])[0])
    stacked = np.stack(local).reshape(len(local), -1)
    mean = weight @ stacked
    root = np.sqrt(weight)[:, None]
    _, values, vectors = np.linalg.svd(root * (stacked - mean), full_matrices=False)
    return ShapeModel(
        layout,
        size,
        mean.reshape(-1, 3),
        vectors[:modes].reshape(modes, -1, 3),
        values[:modes],
        np.tensordot(weight, np.stack(tips), axes=1),
    )


ROUNDS = 3
TAIL = 2.5
"""Standard deviations beyond which a pull loses weight (Cauchy)."""

POSE_STD = np.array([4.0, 4.0, 4.0, 0.25, 0.25, 0.25, 0.12])
"""mm, radians and log scale: how far one fit may move the pose; wide."""


class Pulls(NamedTuple):
    """What was seen of some vertices.

    Attributes
    ----------
    vertex : (m,)
    direction : (m, 3)
        Unit vectors.
    offset : (m,) mm
        Along the direction, from where the vertex is now.
    std : (m,) mm
    """

    vertex: IntArray
    direction: FloatArray
    offset: FloatArray
    std: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Pulls]) -> Pulls:
        """All pulls of several."""
        return cls(*(np.concatenate(values) for values in zip(*parts, strict=True)))

    @classmethod
    def to_points(
        cls, vertex: IntArray, now: FloatArray, points: FloatArray, std: FloatArray
    ) -> Pulls:
        """To points ``(m, 3)`` mm, along all three axes of the world."""
        return cls(
            np.repeat(vertex, 3),
            np.tile(np.eye(3), (len(vertex), 1)),
            (points - now).ravel(),
            np.repeat(std, 3),
        )


def fit_shape(
    model: ShapeModel, pose: Poses, coefficients: FloatArray, pulls: Pulls
) -> tuple[Poses, FloatArray]:
    """Pose (one) and coefficients ``(K,)`` that agree best with pulls on the shape they give.

    Parameters
    ----------
    pose : Poses
        One; where pulls start from, together with ``coefficients (K,)``.
    """
    k = len(coefficients)
    local = model.shape(coefficients[None])[0][pulls.vertex] * np.exp(pose.log_scale[0])
    along = pulls.direction @ pose.rotation[0]
    modes = model.modes[:k][:, pulls.vertex] * np.exp(pose.log_scale[0])
    design = np.concatenate(
        [
            along,
            np.cross(local, along),
            (along * local).sum(axis=1, keepdims=True),
            np.einsum("mi,kmi->mk", along, modes),
        ],
        axis=1,
    )
    prior = np.concatenate([1 / POSE_STD**2, 1 / model.std[:k] ** 2])
    pull_back = np.concatenate([np.zeros(7), -coefficients / model.std[:k] ** 2])
    by = np.zeros(7 + k)
    for _ in range(ROUNDS):
        residual = (design @ by - pulls.offset) / pulls.std
        weight = 1 / (pulls.std**2 * (1 + (residual / TAIL) ** 2))
        normal = design.T @ (weight[:, None] * design) + np.diag(prior)
        by = np.linalg.solve(normal, design.T @ (weight * pulls.offset) + pull_back)
    return pose.moved(by[None, :7]), coefficients + by[7:]


def relax(
    vertices: FloatArray, layout: ValveLayout, pulls: Pulls, stiffness: float, hold: float
) -> FloatArray:
    """Vertices ``(n, 3)`` mm moved smoothly as pulls ask.

    Parameters
    ----------
    stiffness : float
        1/mm^2, on the square of the displacement's second differences between neighbours.
    hold : float
        1/mm^2, on the square of the displacement.
    """
    n = layout.size
    bend = stiffness * _bending(layout) + hold * sparse.identity(n)
    weight = 1 / pulls.std**2
    row = np.arange(len(pulls.vertex))
    design = sparse.csr_array(
        (
            pulls.direction.ravel(),
            (np.repeat(row, 3), (3 * pulls.vertex[:, None] + np.arange(3)).ravel()),
        ),
        shape=(len(row), 3 * n),
    )
    matrix = sparse.kron(bend, sparse.identity(3)) + design.T @ sparse.diags_array(weight) @ design
    right = np.asarray(design.T @ (weight * pulls.offset), dtype=np.float64)
    by = splu(sparse.csc_array(matrix)).solve(right)
    return vertices + by.reshape(n, 3)


@lru_cache(maxsize=4)
def _bending(layout: ValveLayout) -> sparse.csr_array:
    """Square of the graph Laplacian of the layout's grid ``(n, n)``."""
    number = np.arange(layout.size).reshape(layout.rows, layout.columns)
    first = np.concatenate([number.ravel(), number[:-1].ravel()])
    second = np.concatenate([np.roll(number, -1, 1).ravel(), number[1:].ravel()])
    neighbours = sparse.coo_array((np.ones(len(first)), (first, second)), (layout.size,) * 2)
    adjacency = neighbours + neighbours.T
    laplacian = sparse.diags_array(adjacency.sum(axis=1)) - adjacency
    return sparse.csr_array(laplacian.T @ laplacian)


# -- valves that detectors learn from, and guesses that miss them ---------------------------------
@dataclass(frozen=True, slots=True, eq=False)
class TrueValve:
    """One valve in world coordinates.

    Attributes
    ----------
    vertices : (n, 3) mm
    tips : (2, 3) mm
    pose : Poses
        One.
    """

    vertices: FloatArray
    tips: FloatArray
    pose: Poses

    @classmethod
    def of(cls, vertices: FloatArray, tips: FloatArray, model: ShapeModel) -> TrueValve:
        """With the pose that a shape model takes it to have."""
        return cls(vertices, tips, model.pose_of(vertices, tips))


class LabelledFrame(NamedTuple):
    """A frame to learn from.

    Attributes
    ----------
    frame : StandardFrame
    true : TrueValve
        The valve in it.
    model : ShapeModel
    rng : numpy Generator
        Draws the samples.
    """

    frame: StandardFrame
    true: TrueValve
    model: ShapeModel
    rng: np.random.Generator


Examples: TypeAlias = tuple[NDArray[np.float32], FloatArray]
"""Features ``(P, F)`` and what they mean ``(P, outputs)``."""


@dataclass(frozen=True, slots=True)
class Misses:
    """By how much guesses miss a pose or a shape: standard deviations.

    Attributes
    ----------
    shift_mm, turn_degrees, log_scale : float
        Of the pose.
    shape : float
        Of each coefficient, over its standard deviation among valves.
    """

    shift_mm: float
    turn_degrees: float
    log_scale: float
    shape: float = 0.0


def missed_poses(true: Poses, misses: Misses, count: int, rng: np.random.Generator) -> Poses:
    """``count`` guesses of one pose."""
    std = [misses.shift_mm] * 3 + [np.deg2rad(misses.turn_degrees)] * 3 + [misses.log_scale]
    return true.repeated(count).moved(rng.standard_normal((count, 7)) * std)


def missed_shapes(seen: LabelledFrame, misses: Misses, count: int) -> FloatArray:
    """``(count, n, 3)`` mm: guesses of one valve in world coordinates."""
    _, true, model, rng = seen
    poses = missed_poses(true.pose, misses, count, rng)
    exact = model.coefficients(true.pose.local(true.vertices[None]))
    by = rng.standard_normal((count, len(model.std))) * (misses.shape * model.std)
    return poses.world(model.shape(exact + by))
