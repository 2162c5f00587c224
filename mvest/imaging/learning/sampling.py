"""Features: ranks at places that turn and scale with a hypothesis, and their differences.

Sampling at places that follow a hypothesised position, orientation and scale instead of rotating
the volume is what Zheng et al. (IEEE Trans. Med. Imaging 27:1668, 2008) call steerable features;
means over cubes and their differences are those of Haar.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from mvest.imaging.detection.frame import StandardFrame
from mvest.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class SamplePattern:
    """Where and at which scale ranks are sampled about a hypothesis.

    Attributes
    ----------
    offsets : (F, 3)
        mm in the axes of the hypothesis.
    levels : (F,)
        Scale of each sample.
    pairs : (D, 2)
        Samples whose difference is a feature too.
    """

    offsets: FloatArray
    levels: IntArray
    pairs: IntArray

    @classmethod
    def paired(
        cls, offsets: FloatArray, levels: IntArray, differences: int, seed: int
    ) -> SamplePattern:
        """Samples with differences of pairs drawn at random, near ones more often."""
        rng = np.random.default_rng(seed)
        n = len(offsets)
        first = rng.integers(n, size=differences)
        gap = np.linalg.norm(offsets[first, None] - offsets[None], axis=-1)
        weight = np.exp(-gap / np.median(gap))
        weight[np.arange(differences), first] = 0.0
        cumulative = np.cumsum(weight, axis=1)
        draw = rng.random(differences) * cumulative[:, -1]
        second = np.array(
            [np.searchsorted(row, value) for row, value in zip(cumulative, draw, strict=True)]
        )
        return cls(offsets, levels, np.stack([first, second], axis=1))

    @property
    def size(self) -> int:
        """Number of features."""
        return len(self.offsets) + len(self.pairs)


def directions(count: int) -> FloatArray:
    """``(count, 3)`` unit vectors spread evenly (golden spiral)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def features(
    frame: StandardFrame,
    pattern: SamplePattern,
    points: FloatArray,
    axes: FloatArray,
) -> NDArray[np.float32]:
    """Features ``(P, size)`` of hypotheses, ranks from 0 to 255.

    Parameters
    ----------
    points : (P, 3) mm
        World positions.
    axes : (P, 3, 3)
        Columns are the axes of each hypothesis in world coordinates, scale included.
    """
    values = np.empty((len(points), len(pattern.offsets)), dtype=np.float32)
    _sample(
        frame.data,
        frame.starts,
        frame.shapes,
        frame.to_index,
        frame.origin,
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(axes, dtype=np.float64),
        np.ascontiguousarray(pattern.offsets, dtype=np.float64),
        pattern.levels,
        values,
    )
    if not len(pattern.pairs):
        return values
    difference = values[:, pattern.pairs[:, 0]] - values[:, pattern.pairs[:, 1]]
    return np.concatenate([values, difference], axis=1)


@nb.njit(cache=True)
def _sample(
    data: NDArray[np.uint8],
    starts: IntArray,
    shapes: IntArray,
    to_index: FloatArray,
    origin: FloatArray,
    points: FloatArray,
    axes: FloatArray,
    offsets: FloatArray,
    levels: IntArray,
    out: NDArray[np.float32],
) -> None:  # pragma: no cover (compiled)
    """Trilinear interpolation at every offset of every hypothesis; 0 outside the volume."""
    for p in range(len(points)):
        base = to_index @ (points[p] - origin)
        turn = to_index @ axes[p]
        for f in range(len(offsets)):
            level = levels[f]
            scale = 1.0 / (1 << level)
            o0, o1, o2 = offsets[f, 0], offsets[f, 1], offsets[f, 2]
            x = base[0] + turn[0, 0] * o0 + turn[0, 1] * o1 + turn[0, 2] * o2
            y = base[1] + turn[1, 0] * o0 + turn[1, 1] * o1 + turn[1, 2] * o2
            z = base[2] + turn[2, 0] * o0 + turn[2, 1] * o1 + turn[2, 2] * o2
            x = (x + 0.5) * scale - 0.5
            y = (y + 0.5) * scale - 0.5
            z = (z + 0.5) * scale - 0.5
            nx, ny, nz = shapes[level, 0], shapes[level, 1], shapes[level, 2]
            # Asked so that a place that is no number is outside.
            if not (-0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5 and -0.5 <= z <= nz - 0.5):
                out[p, f] = 0.0
                continue
            x = min(max(x, 0.0), nx - 1.0)
            y = min(max(y, 0.0), ny - 1.0)
            z = min(max(z, 0.0), nz - 1.0)
            i, j, k = int(x), int(y), int(z)
            u, v, w = x - i, y - j, z - k
            # From each last voxel there is no step to a neighbour.
            di = ny * nz if i + 1 < nx else 0
            dj = nz if j + 1 < ny else 0
            dk = 1 if k + 1 < nz else 0
            a = starts[level] + (i * ny + j) * nz + k
            b = a + di
            low = (data[a] * (1 - w) + data[a + dk] * w) * (1 - v) + (
                data[a + dj] * (1 - w) + data[a + dj + dk] * w
            ) * v
            high = (data[b] * (1 - w) + data[b + dk] * w) * (1 - v) + (
                data[b + dj] * (1 - w) + data[b + dj + dk] * w
            ) * v
            out[p, f] = low * (1 - u) + high * u
