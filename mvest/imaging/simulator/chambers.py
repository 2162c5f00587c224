"""The heart around a valve, made up: ventricle, atrium, aortic root, papillary muscles.

Everything begins at the annulus and moves with it; shapes and sizes are drawn, and are a choice
within what is usual in adults (ventricle 40 to 55 mm wide with walls of 8 to 11 mm, aortic root 22
to 28 mm). Positions are mm in the valve's own axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.imaging.moving_valve import MovingValve
from mvest.typing import FloatArray

ROWS = 33


@dataclass(frozen=True, slots=True, eq=False)
class Heart:
    """Moving grids ``(T, R, C, 3)`` mm of inner surfaces, and lines of muscles.

    Attributes
    ----------
    ventricle, atrium, aorta : (T, R, C, 3)
        Rows lead away from the valve, columns run around.
    ventricle_thickness, atrium_thickness, aorta_thickness : (R, C)
    muscles : tuple of (T, m, 3)
        From each papillary tip to the ventricle's wall.
    muscle_radius : (m,)
    outflow : (C,)
        Share of the outflow tract in the ventricle's base, 0 (at the back) to 1.
    """

    ventricle: FloatArray
    atrium: FloatArray
    aorta: FloatArray
    ventricle_thickness: FloatArray
    atrium_thickness: FloatArray
    aorta_thickness: FloatArray
    muscles: tuple[FloatArray, ...]
    muscle_radius: FloatArray
    outflow: FloatArray


def _step(x: FloatArray) -> FloatArray:
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3 - 2 * x))


def waves(
    rng: np.random.Generator, rows: int, columns: int, fineness: int = 1, fall: float = 1.0
) -> FloatArray:
    """A smooth random field ``(rows, columns)`` of mean 0 and standard deviation 1, closed around.

    Parameters
    ----------
    rng : numpy Generator
    rows, columns : int
    fineness : int
        Waves around are up to 4 times, and along up to 3 times this.
    fall : float
        Power with which amplitudes fall off with the number of waves.
    """
    phi = 2 * np.pi * np.arange(columns) / columns
    u = np.linspace(0, np.pi, rows)[:, None]
    total = np.zeros((rows, columns))
    for m in range(4 * fineness + 1):
        for n in range(0 if m else 1, 3 * fineness + 1):
            a, b = rng.standard_normal(2) / (1 + m + n) ** fall
            total += np.cos(n * u) * (a * np.cos(m * phi) + b * np.sin(m * phi))
    total -= total.mean()
    return np.asarray(total / max(float(total.std()), 1e-9))


def make_heart(valve: MovingValve, apex: FloatArray, rng: np.random.Generator) -> Heart:
    """A heart around a valve.

    Parameters
    ----------
    valve : MovingValve
    apex : (3,) mm
        Of the probe, which lies behind the wall of the atrium.
    rng : numpy Generator
    """
    annulus = valve.vertices[:, valve.layout.annulus]
    phi = valve.layout.phi[valve.layout.annulus]
    u = np.linspace(0, 1, ROWS)[:, None]
    ring = annulus[0]
    middle = ring.mean(axis=0)
    angle = np.arctan2(ring[:, 1] - middle[1], ring[:, 0] - middle[0])
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    anterior = ring[np.argmin(np.abs(phi - 90.0))]

    # Aortic root: its back wall stands on the middle of the anterior annulus.
    lean = np.deg2rad(rng.uniform(30, 50))
    radius = 0.5 * rng.uniform(22, 28)
    up = np.array([0.0, np.sin(lean), np.cos(lean)])
    forward = np.array([0.0, np.cos(lean), -np.sin(lean)])
    along = np.linspace(-2, 42, 23)[:, None]
    around = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    wide = radius + 1.8 * np.exp(-(((along - 9) / 7) ** 2)) * (1 + 0.4 * np.cos(3 * around))
    centre = anterior + (radius + 1.0) * forward
    tube = (
        centre
        + along[..., None] * up
        + (wide * np.cos(around))[..., None] * np.array([1.0, 0.0, 0.0])
        + (wide * np.sin(around))[..., None] * forward
    )
    anterior_shift = _shift(annulus)[:, phi.searchsorted(90.0)]
    aorta = tube + anterior_shift[:, None, None]

    # Ventricle: from the annulus, in front from the far side of the outflow tract, to its apex.
    tips = valve.tips.reshape(-1, 3)
    back, front = ring[:, 1].min() - rng.uniform(3, 9), (centre + radius * forward)[1]
    half = np.array([rng.uniform(21, 27), 0.5 * (front - back)])
    half[0] = max(half[0], np.abs(tips[:, 0] - middle[0]).max() + 5.0)
    axis = np.array([middle[0], 0.5 * (front + back), middle[2] + rng.uniform(-6, -2)])
    length = max(rng.uniform(62, 80), float(-tips[:, 2].min()) + 30.0)
    psi = 0.49 * np.pi * u
    radial = np.cos(psi) ** rng.uniform(0.5, 0.75)
    body = np.empty((ROWS, len(angle), 3))
    body[..., 0] = axis[0] + half[0] * radial * np.cos(angle)
    body[..., 1] = axis[1] + half[1] * radial * np.sin(angle)
    body[..., 2] = axis[2] - length * np.sin(psi)
    body += (_step(u / 0.2) * _rough(rng, len(angle)))[..., None] * outward
    outflow = np.exp(-((np.abs(phi - 90.0) / rng.uniform(50, 60)) ** 4))[:, None]
    base = ring + 1.0 * outward + outflow * (2 * radius + 1.0) * forward
    fade = (1 - _step(u / 0.22))[..., None]
    inner = body + fade * (base - body[:1])
    tip_shift = (valve.tips - valve.tips[:1]).mean(axis=1)
    share = _step(u / 0.5)[..., None]
    reach = (1 - 0.7 * _step((u - 0.5) / 0.5))[..., None]
    ventricle = (
        inner + (1 - share) * _shift(annulus)[:, None] + share * reach * tip_shift[:, None, None]
    )
    wall = rng.uniform(8, 11) * (1 + 0.06 * waves(rng, ROWS, len(angle)))
    wall *= 0.45 + 0.55 * _step(u / 0.12)
    wall *= 1 - 0.35 * _step((u - 0.75) / 0.25)

    muscles, fat = _muscles(valve, ventricle, rng)
    return Heart(
        ventricle,
        _atrium(annulus, angle, apex, rng),
        aorta,
        np.maximum(wall, 2.0),
        np.full((ROWS, len(angle)), rng.uniform(2.0, 3.2)),
        np.full((len(along), len(around)), rng.uniform(1.6, 2.2)),
        muscles,
        fat,
        outflow[:, 0],
    )


def _rough(rng: np.random.Generator, columns: int) -> FloatArray:
    """Offset ``(ROWS, columns)`` mm of the ventricle's inner surface: form, and trabeculae."""
    fine = waves(rng, ROWS, columns, 4, 0.3)
    return np.asarray(1.2 * waves(rng, ROWS, columns) + rng.uniform(0.2, 0.6) * fine)


def _shift(annulus: FloatArray) -> FloatArray:
    """``(T, C, 3)``, how far the annulus is from where it was in the first frame."""
    return np.asarray(annulus - annulus[:1])


def _muscles(
    valve: MovingValve, wall: FloatArray, rng: np.random.Generator
) -> tuple[tuple[FloatArray, ...], FloatArray]:
    """Lines from the tips to the wall, and their common radius from head to foot."""
    share = np.linspace(0, 1, 13)[:, None]
    lines = []
    for k in range(2):
        tip = valve.tips[:, k]
        target = tip[0] - [0.0, 0.0, rng.uniform(22, 30)]
        distance = np.linalg.norm(wall[0] - target, axis=-1)
        row, column = np.unravel_index(np.argmin(distance), distance.shape)
        foot = wall[:, row, column]
        bow = 4 * share * (1 - share) * rng.uniform(-1.5, 1.5, 3)
        lines.append(tip[:, None] + share * (foot - tip)[:, None] + bow)
    size = rng.uniform(3.6, 5.2)
    head = np.clip(share[:, 0] / 0.35, 0, 1)
    radius = size * np.sqrt(1 - (1 - head) ** 2) + 0.6
    return tuple(lines), np.asarray(radius * (1 + 0.35 * share[:, 0]))


def _atrium(
    annulus: FloatArray, angle: FloatArray, apex: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Inner surface ``(T, R, C, 3)`` of a dome from the annulus towards the probe."""
    u = np.linspace(0, 1, ROWS)[:, None]
    ring = annulus[0]
    centre = ring.mean(axis=0) + np.array([0.0, rng.uniform(-6, -1), rng.uniform(16, 22)])
    axes = np.array([rng.uniform(20, 27), rng.uniform(17, 22), rng.uniform(20, 26)])
    start = ring - centre
    low = np.arcsin(start[:, 2] / np.linalg.norm(start, axis=1))
    psi = low + (0.485 * np.pi - low) * u
    direction = np.stack(
        [np.cos(psi) * np.cos(angle), np.cos(psi) * np.sin(angle), np.sin(psi)], axis=-1
    )
    reach = 1 / np.linalg.norm(direction / axes, axis=-1)
    reach += 1.3 * waves(rng, ROWS, len(angle))
    body = reach[..., None] * direction
    # The side towards the probe reaches to the probe, nearly.
    sight = apex - centre
    distance = float(np.linalg.norm(sight))
    sight = sight / distance
    height = np.maximum(body @ sight, 0.0)
    gap = rng.uniform(5, 9)
    factor = np.clip(max(distance - gap, 3.0) / max(float(height.max()), 1.0), 0.1, 1.9)
    body += ((factor - 1) * height)[..., None] * sight
    blend = _step(u / 0.3)[..., None]
    inner = centre + (1 - blend) * start + blend * body
    return np.asarray(inner + (1 - _step(u / 0.9))[..., None] * _shift(annulus)[:, None])
