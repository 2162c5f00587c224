"""A mean valve and its principal modes without pose, and the fit of a shape.

Papillary tips have a mean only. They are detected separately, because a shape fitted to the
leaflets does not determine them.

Every detection is a pull: a vertex should move by a distance along a direction, with a standard
deviation. Pose and coefficients follow from a linear least-squares problem with the shape model's
prior (maximum a posteriori), repeated with small weights for outliers. A smooth displacement of the
vertices then represents what the modes cannot.
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
    """Shapes in valve axes (see :class:`Poses`), mm at the size of the mean valve."""

    layout: ValveLayout
    size_mm: float  #: root mean square distance of the mean valve's annulus from its centre
    mean: FloatArray  #: (n, 3)
    modes: FloatArray  #: (K, n, 3), orthonormal
    std: FloatArray  #: (K,) mm, of each mode's coefficient, decreasing
    tips: FloatArray  #: (2, 3), mean papillary tips

    def shape(self, coefficients: FloatArray) -> FloatArray:
        """Shapes ``(P, n, 3)`` of coefficients ``(P, k)`` of the first k modes."""
        k = coefficients.shape[1]
        return np.asarray(self.mean + np.tensordot(coefficients, self.modes[:k], axes=(1, 0)))

    def coefficients(self, local: FloatArray) -> FloatArray:
        """Coefficients ``(P, K)`` of shapes ``(P, n, 3)`` in valve axes."""
        return np.asarray(np.tensordot(local - self.mean, self.modes, axes=([1, 2], [1, 2])))


def fit_shape_model(valves: Sequence[MovingValve], modes: int) -> ShapeModel:
    """Mean and principal modes over all frames of all valves.

    InputError if there are too few shapes, or layouts differ.
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
    # Every valve has the same weight.
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
"""mm, radians and log scale: wide prior of the motion of the pose in one fit."""


class Pulls(NamedTuple):
    """Displacements detected at some vertices."""

    vertex: IntArray  #: (m,)
    direction: FloatArray  #: (m, 3) unit vectors
    offset: FloatArray  #: (m,) mm along the direction
    std: FloatArray  #: (m,) mm

    @classmethod
    def joined(cls, parts: Sequence[Pulls]) -> Pulls:
        """The pulls of all parts."""
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
    """Pose (one) and coefficients ``(K,)`` that fit the pulls on their shape best."""
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
    """Vertices ``(n, 3)`` mm, displaced smoothly by pulls.

    ``stiffness`` and ``hold`` (1/mm^2) weigh the squares of the displacement's second differences
    between neighbours, and of the displacement itself.
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


# -- training examples ----------------------------------------------------------------------------
class LabelledFrame(NamedTuple):
    """A training frame, with the true valve in it."""

    frame: StandardFrame
    vertices: FloatArray  #: (n, 3) mm, in the world
    tips: FloatArray  #: (2, 3) mm
    pose: Poses  #: one
    model: ShapeModel
    rng: np.random.Generator  #: draws the examples

    def missed_poses(self, misses: Misses, count: int) -> Poses:
        """``count`` poses about the true one."""
        shift, turn, scale, _ = misses
        std = [shift] * 3 + [np.deg2rad(turn)] * 3 + [scale]
        return self.pose.repeated(count).moved(self.rng.standard_normal((count, 7)) * std)

    def missed_shapes(self, misses: Misses, count: int) -> FloatArray:
        """``count`` shapes ``(count, n, 3)`` mm about the true one."""
        poses, std = self.missed_poses(misses, count), self.model.std
        exact = self.model.coefficients(self.pose.local(self.vertices[None]))
        by = self.rng.standard_normal((count, len(std))) * (misses.shape * std)
        return poses.world(self.model.shape(exact + by))


Examples: TypeAlias = tuple[NDArray[np.float32], FloatArray]
"""Features ``(P, F)`` and the outputs to learn ``(P, outputs)``."""


class Misses(NamedTuple):
    """Standard deviations of guesses about a true pose and shape."""

    shift_mm: float
    turn_degrees: float
    log_scale: float
    shape: float = 0.0  #: of each coefficient, over its standard deviation among valves
