"""How valves differ: a mean shape and its principal modes, pose taken off.

Papillary tips have a mean only; they are found by themselves, since a shape fitted to the leaflets
moves them for no reason of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.imaging.detection.pose import Poses, pose_of
from mvest.imaging.layout import ValveLayout
from mvest.imaging.moving_valve import MovingValve
from mvest.typing import FloatArray


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
