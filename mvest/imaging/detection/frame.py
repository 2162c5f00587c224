"""One frame of a volume as input of the detectors: ranks of grey values at several scales.

Features are ranks at points that turn and scale with a hypothesis, and their differences: the
steerable features of Zheng et al. (IEEE Trans. Med. Imaging 27:1668, 2008), with means over cubes
and their differences as those of Haar.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from mvest.errors import InputError
from mvest.imaging.volume import VolumeSequence
from mvest.typing import FloatArray, IntArray

VOXEL_MM = 0.8
"""mm, spacing to which a volume is resampled if its own differs by more than a fifth."""

LEVELS = 4
"""Scales: cubes of 1, 2, 4 and 8 voxels."""

SPARSE = 25
"""Of 255: a cell of 4 x 4 x 4 voxels has an echo if a larger share of its voxels has one."""

MIN_CELLS, MIN_GREY_VALUES = 20, 8
"""Smallest number of cells with an echo, and of different grey values, in an image."""

MAX_LEVELS = 65536
"""Largest range of integer grey values for which each value is counted."""

MAX_COMPARED = 200_000
"""Largest number of voxels used to rank floating-point grey values."""


class StandardFrame(NamedTuple):
    """Means over cubes of 1, 2, 4, ... voxels of the ranks of one frame's grey values.

    A rank is the share of darker voxels within the field of view. It does not change with gain,
    dynamic range or any other monotone map of grey values.
    """

    data: NDArray[np.uint8]  #: (N,) ranks of all levels, 255 the brightest; 0 outside the view
    starts: IntArray  #: (L,) beginning of each level
    shapes: IntArray  #: (L, 3) voxels of each level
    to_index: FloatArray  #: (3, 3) from mm in world axes to voxels of the first level
    origin: FloatArray  #: (3,) mm, world position of the first level's voxel (0, 0, 0)

    def level(self, number: int) -> NDArray[np.uint8]:
        """Ranks of one level ``(I, J, K)``."""
        shape = self.shapes[number]
        start = self.starts[number]
        return self.data[start : start + int(np.prod(shape))].reshape(shape)

    def centres(self, number: int) -> FloatArray:
        """World positions ``(I * J * K, 3)`` mm of one level's voxels."""
        side = 2**number
        grids = np.meshgrid(
            *((np.arange(k) + 0.5) * side - 0.5 for k in self.shapes[number]), indexing="ij"
        )
        index = np.stack(grids, axis=-1).reshape(-1, 3)
        return np.asarray(self.origin + index @ np.linalg.inv(self.to_index).T)


def standard_frame(volume: VolumeSequence, frame: int) -> StandardFrame:
    """Prepare one frame of a volume; InputError if it is not an image."""
    ranks = _ranks(np.asarray(volume.frames[frame]), volume.source, frame)
    spacing = np.asarray(volume.spacing, dtype=np.float64)
    origin = np.asarray(volume.origin, dtype=np.float64)
    if np.any(np.abs(spacing / VOXEL_MM - 1) > 0.2):
        ranks, zoom = _resampled(ranks, spacing)
        origin = volume.world(0.5 * (1 / zoom - 1))  # the first voxel's centre in the old grid
        spacing = spacing / zoom
    levels = [ranks]
    for _ in range(LEVELS - 1):
        levels.append(_halved(levels[-1]))
    shapes = np.array([level.shape for level in levels])
    sizes = np.prod(shapes, axis=1)
    return StandardFrame(
        np.concatenate([level.ravel() for level in levels]),
        np.concatenate([[0], np.cumsum(sizes)[:-1]]),
        shapes,
        np.diag(1 / spacing) @ np.asarray(volume.direction).T,
        origin,
    )


def _resampled(
    ranks: NDArray[np.uint8], spacing: FloatArray
) -> tuple[NDArray[np.uint8], FloatArray]:
    """Ranks at about ``VOXEL_MM``, and the number of new voxels for each old one ``(3,)``."""
    shape = np.maximum(1, np.rint(np.array(ranks.shape) * spacing / VOXEL_MM)).astype(int)
    zoom = shape / np.array(ranks.shape)
    smooth = ndimage.gaussian_filter(ranks.astype(np.float32), np.where(zoom < 1, 0.5 / zoom, 0.0))
    finer = ndimage.zoom(smooth, zoom, order=1, grid_mode=True, mode="nearest")
    return np.rint(finer).astype(np.uint8), zoom


def _ranks(grey: NDArray[Any], source: str, frame: int) -> NDArray[np.uint8]:
    low, high = grey.min(), grey.max()
    if not high > low:
        raise InputError(f"{source}, frame {frame}: all voxels are {low:g}, expected an image")
    inside = _field_of_view(np.asarray(grey > low))
    if inside is None:
        raise InputError(
            f"{source}, frame {frame}: hardly any voxel is brighter than {low:g}, expected an image"
        )
    seen = grey[inside]
    if np.issubdtype(grey.dtype, np.integer) and int(high) - int(low) < MAX_LEVELS:
        count = np.bincount(seen.astype(np.int64) - int(low), minlength=int(high) - int(low) + 1)
        different = int(np.count_nonzero(count))
        middle = ((np.cumsum(count) - 0.5 * count) / count.sum())[grey.astype(np.int64) - int(low)]
    else:
        ordered = np.sort(seen[:: -(-len(seen) // MAX_COMPARED)])
        different = len(np.unique(ordered))
        left, right = (np.searchsorted(ordered, grey, side) for side in ("left", "right"))
        middle = 0.5 * (left + right) / len(ordered)
    if different < MIN_GREY_VALUES:
        raise InputError(
            f"{source}, frame {frame}: {different} different grey values, expected an image"
        )
    return np.where(inside, np.maximum(1, np.rint(255 * middle)), 0).astype(np.uint8)


def _field_of_view(echo: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """The convex hull of all voxels with an echo, black blood included; None without an echo."""
    coarse = _halved(_halved(np.where(echo, np.uint8(255), np.uint8(0)))) > SPARSE
    points = np.argwhere(coarse).astype(np.float64)
    if len(points) < MIN_CELLS:
        return None
    try:
        planes = ConvexHull(points).equations
    except QhullError:  # all in one plane
        return None
    cells = np.indices(coarse.shape).reshape(3, -1)
    within = np.ones(cells.shape[1], dtype=np.bool_)
    for plane in planes:
        within &= plane[:3] @ cells + plane[3] < 1.0
    whole: NDArray[np.bool_] = within.reshape(coarse.shape)
    for axis in range(3):
        whole = np.repeat(whole, 4, axis)
    return whole[tuple(slice(0, size) for size in echo.shape)]


def _halved(level: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Means over 2 x 2 x 2 voxels; the last layer of an odd side is repeated."""
    padded = np.pad(level, [(0, k % 2) for k in level.shape], mode="edge").astype(np.uint16)
    total = padded[0::2] + padded[1::2]
    total = total[:, 0::2] + total[:, 1::2]
    total = total[:, :, 0::2] + total[:, :, 1::2]
    return ((total + 4) // 8).astype(np.uint8)


class SamplePattern(NamedTuple):
    """Points and scales at which ranks are sampled about a hypothesis."""

    offsets: FloatArray  #: (F, 3) mm in the axes of the hypothesis
    levels: IntArray  #: (F,) scale of each sample
    pairs: IntArray  #: (D, 2) samples whose difference is a feature

    @classmethod
    def paired(
        cls, offsets: FloatArray, levels: IntArray, differences: int, seed: int
    ) -> SamplePattern:
        """Samples with differences of random pairs, mostly of near ones."""
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


def directions(count: int) -> FloatArray:
    """``(count, 3)`` unit vectors spread evenly (golden spiral)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def features(
    frame: StandardFrame, pattern: SamplePattern, points: FloatArray, axes: FloatArray
) -> NDArray[np.float32]:
    """Features ``(P, size)`` of hypotheses, ranks from 0 to 255.

    Hypotheses are at ``points (P, 3)`` mm in the world. The columns of ``axes (P, 3, 3)`` are their
    axes, with scale.
    """
    values = np.empty((len(points), len(pattern.offsets)), dtype=np.float32)
    points, axes = (np.ascontiguousarray(x, dtype=np.float64) for x in (points, axes))
    _sample(frame, pattern, points, axes, values)
    if not len(pattern.pairs):
        return values
    difference = values[:, pattern.pairs[:, 0]] - values[:, pattern.pairs[:, 1]]
    return np.concatenate([values, difference], axis=1)


@nb.njit(cache=True)
def _sample(
    frame: StandardFrame,
    pattern: SamplePattern,
    points: FloatArray,
    axes: FloatArray,
    out: NDArray[np.float32],
) -> None:  # pragma: no cover (compiled)
    """Trilinear interpolation at every offset of every hypothesis; 0 outside the volume."""
    data, starts, shapes, to_index, origin = frame
    offsets, levels, _ = pattern
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
            # With NaN, this form is True.
            if not (-0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5 and -0.5 <= z <= nz - 0.5):
                out[p, f] = 0.0
                continue
            x = min(max(x, 0.0), nx - 1.0)
            y = min(max(y, 0.0), ny - 1.0)
            z = min(max(z, 0.0), nz - 1.0)
            i, j, k = int(x), int(y), int(z)
            u, v, w = x - i, y - j, z - k
            # The last voxel along an axis has no neighbour.
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
