"""Motion smoothed in time, with a penalty on acceleration, as far as each vertex was unsure."""

from __future__ import annotations

import numpy as np

from mvest.typing import FloatArray


def smooth_in_time(
    times: FloatArray,
    vertices: FloatArray,
    tips: FloatArray,
    vertex_weight: FloatArray,
    frame_weight: FloatArray,
    s: FloatArray,
    smoothing_s: tuple[float, float, float],
) -> tuple[FloatArray, FloatArray]:
    """Positions with little acceleration where they were not sure.

    Parameters
    ----------
    times : (T,) s
    vertices, tips : (T, n, 3), (T, 2, 3) mm
    vertex_weight, frame_weight : (T, n), (T,)
        How much each counts, relative to the others.
    s : (n,)
        0 at the annulus, 1 at the free edge.
    smoothing_s : (float, float, float)
        Times for annulus, free edge (in between: linear in s) and tips.

    Returns
    -------
    vertices, tips
    """
    annulus, edge, tip = (max(float(t), 0.0) for t in smoothing_s)
    length = (1 - s) * annulus + s * edge
    smooth = _whittaker(times, vertices, vertex_weight, length)
    weight = np.repeat(frame_weight[:, None], tips.shape[1], 1)
    return smooth, _whittaker(times, tips, weight, np.full(tips.shape[1], tip))


def _whittaker(
    times: FloatArray, values: FloatArray, weight: FloatArray, length: FloatArray
) -> FloatArray:
    """Penalised least squares on second divided differences, for each column ``(T, m, 3)``.

    Minimises sum w (z - y)^2 dt + length^4 int z''^2 dt (Whittaker, Proc. Edinburgh Math. Soc.
    41:63, 1923), so that what varies over much less than ``length`` (s) goes.
    """
    count = len(times)
    if count < 3 or not np.any(length > 0):
        return values
    step = np.diff(times)
    second = np.zeros((count - 2, count))
    for k in range(count - 2):
        a, b = step[k], step[k + 1]
        second[k, k : k + 3] = np.array([1 / a, -1 / a - 1 / b, 1 / b]) * 2 / (a + b)
    share = 0.5 * (np.concatenate([step, step[-1:]]) + np.concatenate([step[:1], step]))
    bend = second.T @ (0.5 * (step[1:] + step[:-1])[:, None] * second)
    weight = np.maximum(weight, 1e-3) / np.maximum(weight.mean(axis=0), 1e-3) * share[:, None]
    matrix = length[:, None, None] ** 4 * bend + np.einsum("tm,tu->mtu", weight, np.eye(count))
    right = np.swapaxes(weight[..., None] * values, 0, 1)
    return np.asarray(np.swapaxes(np.linalg.solve(matrix, right), 0, 1))
