"""Position, orientation and size of a valve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.imaging.layout import ValveLayout
from mvest.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of P hypotheses (or frames).

    The valve's axes: x to the line between the leaflets at phi = 0, y to the anterior side, z to
    the atrium.
    """

    centre: FloatArray  #: (P, 3) mm, world position of the annulus' centre
    rotation: FloatArray  #: (P, 3, 3), its columns are the valve's axes in the world
    log_scale: FloatArray  #: (P,), logarithm of the size over that of the mean valve

    def __len__(self) -> int:
        return len(self.centre)

    def __getitem__(self, which: slice | IntArray | BoolArray | list[int]) -> Poses:
        return Poses(self.centre[which], self.rotation[which], self.log_scale[which])

    @property
    def axes(self) -> FloatArray:
        """Axes ``(P, 3, 3)`` with the scale."""
        return np.asarray(self.rotation * np.exp(self.log_scale)[:, None, None])

    def world(self, points: FloatArray) -> FloatArray:
        """World positions ``(P, m, 3)`` mm of points ``(m, 3)`` or ``(P, m, 3)`` in valve axes."""
        return np.asarray(self.centre[:, None] + points @ np.swapaxes(self.axes, 1, 2))

    def local(self, points: FloatArray) -> FloatArray:
        """Inverse of :meth:`world`: ``(P, m, 3)`` in valve axes, without scale."""
        scale = np.exp(-self.log_scale)[:, None, None]
        return np.asarray((points - self.centre[:, None]) @ self.rotation * scale)

    def moved(self, by: FloatArray) -> Poses:
        """Moved by ``(P, 7)``: shift (mm) and turn (rotation vector) in valve axes, log scale."""
        turn = Rotation.from_rotvec(by[:, 3:6]).as_matrix()
        return Poses(
            self.centre + np.einsum("pij,pj->pi", self.rotation, by[:, :3]),
            self.rotation @ turn,
            self.log_scale + by[:, 6],
        )

    def towards(self, other: Poses) -> FloatArray:
        """The ``(P, 7)`` that move these poses to ``other``."""
        shift = np.einsum("pij,pi->pj", self.rotation, other.centre - self.centre)
        turn = Rotation.from_matrix(np.swapaxes(self.rotation, 1, 2) @ other.rotation).as_rotvec()
        scale = other.log_scale - self.log_scale
        return np.concatenate([shift, turn, scale[:, None]], axis=1)

    def repeated(self, count: int) -> Poses:
        """Every pose ``count`` times, one after another."""
        return Poses(
            *(np.repeat(v, count, 0) for v in (self.centre, self.rotation, self.log_scale))
        )

    def apart(self, ratings: FloatArray, count: int) -> IntArray:
        """The best rated poses, none within 4 mm and 15 degrees of a better one."""
        kept: list[int] = []
        for k in np.argsort(-ratings, kind="stable"):
            turn = Rotation.from_matrix(np.swapaxes(self.rotation[kept], 1, 2) @ self.rotation[k])
            gap = np.linalg.norm(self.centre[kept] - self.centre[k], axis=1)
            if not kept or np.all((gap > 4.0) | (turn.magnitude() > np.deg2rad(15.0))):
                kept.append(int(k))
            if len(kept) == count:
                break
        return np.array(kept, dtype=np.int64)

    @staticmethod
    def joined(parts: list[Poses]) -> Poses:
        """The poses of all parts."""
        names = ("centre", "rotation", "log_scale")
        return Poses(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def pose_of(
    vertices: FloatArray, tips: FloatArray, layout: ValveLayout, size_mm: float = 1.0
) -> Poses:
    """The pose of one valve, from its vertices ``(n, 3)`` and tips ``(2, 3)`` mm.

    z is the annulus' normal away from the tips; x points to phi = 0, perpendicular to z.
    ``size_mm`` is the root mean square distance of the mean valve's annulus from its centre.
    """
    annulus = vertices[layout.annulus]
    centre = annulus.mean(axis=0)
    about = annulus - centre
    z = np.linalg.svd(about, full_matrices=False)[2][2]
    z = z if z @ (centre - tips.mean(axis=0)) > 0 else -z
    x = annulus[0] - annulus[layout.column(180.0)]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    size = np.sqrt((about**2).sum(axis=1).mean())
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return Poses(centre[None], rotation[None], np.array([np.log(size / size_mm)]))


def rotation_grid(count: int) -> FloatArray:
    """Rotations ``(count, 3, 3)``, each the random candidate farthest from those before."""
    candidates = Rotation.random(4 * count, rng=np.random.default_rng(0)).as_quat()
    nearness = np.abs(candidates @ candidates[0])
    chosen = [0]
    for _ in range(count - 1):
        k = int(np.argmin(nearness))
        chosen.append(k)
        nearness = np.maximum(nearness, np.abs(candidates @ candidates[k]))
    return np.asarray(Rotation.from_quat(candidates[chosen]).as_matrix())
