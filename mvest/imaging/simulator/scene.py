"""The parts of the heart, and the scatterers in them.

The heart around a valve is synthetic: ventricle, atrium, aortic root, papillary muscles. All start
at the annulus and move with it. Shapes and sizes are drawn within the usual range of adults
(ventricle 40 to 55 mm wide with walls of 8 to 11 mm, aortic root 22 to 28 mm); the details are a
choice. Positions are mm in the valve's own axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mvest.imaging.simulator.acquisition import Acquisition, Probe
from mvest.imaging.simulator.scatterers import Cord, Material, TissuePart, TissueSheet, normals
from mvest.imaging.valve_sequence import MovingValve
from mvest.typing import FloatArray

ROWS = 33


class Heart(NamedTuple):
    """Moving walls of the chambers and papillary muscles around a valve.

    A wall is its inner surface ``(T, R, C, 3)`` mm, whose rows lead away from the valve and whose
    columns run around, and its thickness ``(R, C)`` mm.
    """

    ventricle: tuple[FloatArray, FloatArray]
    atrium: tuple[FloatArray, FloatArray]
    aorta: tuple[FloatArray, FloatArray]
    muscles: tuple[FloatArray, ...]  #: (T, m, 3) each, from a papillary tip to the wall
    muscle_radius: FloatArray  #: (m,)
    outflow: FloatArray  #: (C,) share of the outflow tract in the ventricle's base, 0 (back) to 1


def _step(x: FloatArray) -> FloatArray:
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3 - 2 * x))


def waves(
    rng: np.random.Generator, rows: int, columns: int, fineness: int = 1, fall: float = 1.0
) -> FloatArray:
    """A smooth random field ``(rows, columns)`` of mean 0 and standard deviation 1, closed around.

    It has up to 4 ``fineness`` waves around and 3 ``fineness`` along. Their amplitudes decrease as
    their number to the power ``-fall``.
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
    """A heart around a valve; the probe's ``apex (3,)`` mm is behind the wall of the atrium."""
    annulus = valve.vertices[:, valve.layout.annulus]
    phi = valve.layout.phi[valve.layout.annulus]
    u = np.linspace(0, 1, ROWS)[:, None]
    ring = annulus[0]
    middle = ring.mean(axis=0)
    angle = np.arctan2(ring[:, 1] - middle[1], ring[:, 0] - middle[0])
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    anterior = ring[np.argmin(np.abs(phi - 90.0))]

    # Aortic root: its back wall is at the middle of the anterior annulus.
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
    # Form and trabeculae.
    fine = waves(rng, ROWS, len(angle), 4, 0.3)
    rough = 1.2 * waves(rng, ROWS, len(angle)) + rng.uniform(0.2, 0.6) * fine
    body += (_step(u / 0.2) * rough)[..., None] * outward
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
    atrium = _atrium(annulus, angle, apex, rng)
    return Heart(
        (ventricle, np.maximum(wall, 2.0)),
        (atrium, np.full((ROWS, len(angle)), rng.uniform(2.0, 3.2))),
        (aorta, np.full((len(along), len(around)), rng.uniform(1.6, 2.2))),
        muscles,
        fat,
        outflow[:, 0],
    )


def _shift(annulus: FloatArray) -> FloatArray:
    """``(T, C, 3)``, displacement of the annulus from the first frame."""
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
    # The side towards the probe nearly reaches it.
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


SURROUNDINGS_MM, FADE = 20.0, 2.0
"""Thickness of the tissue outside the heart, and how fast it fades (a choice)."""


def make_parts(
    valve: MovingValve, heart: Heart, acquisition: Acquisition, rng: np.random.Generator
) -> list[TissuePart]:
    """Leaflets, annulus, chordae, muscles, walls of the chambers and their surroundings."""
    return [
        *_valve_parts(valve, acquisition, rng),
        *_wall_parts(heart, acquisition, rng),
        *_outer_parts(heart, acquisition, rng),
    ]


def _valve_parts(valve: MovingValve, a: Acquisition, rng: np.random.Generator) -> list[TissuePart]:
    columns, grid = valve.layout.columns, (valve.layout.rows, valve.layout.columns)
    leaflets = valve.vertices.reshape(len(valve.times), *grid, 3)
    chord = Material("chord", a.chord_db, fineness=6.0)
    parts: list[TissuePart] = [
        TissueSheet(
            Material("leaflet", a.leaflet_db, fineness=4.0),
            leaflets,
            valve.thickness.reshape(grid),
            (-0.5, 0.5),
            _mottled(grid, 1.5, rng) * _dropouts(grid, a, rng),
        ),
        Cord(
            Material("annulus", a.annulus_db, specular=False, fineness=2.0),
            leaflets[:, 0],
            np.full(columns, rng.uniform(1.0, 1.8)),
            True,
            _dense(columns, rng),
        ),
    ]
    for phi, s, tip in zip(valve.chord_phi, valve.chord_s, valve.chord_tip, strict=True):
        line = _chord(leaflets, valve.tips[:, tip], float(phi), float(s))
        parts.append(Cord(chord, line, np.full(2, rng.uniform(0.3, 0.55)), False, np.zeros(2)))
    return parts


def _wall_parts(heart: Heart, a: Acquisition, rng: np.random.Generator) -> list[TissuePart]:
    wall, vessel = Material("wall", a.wall_db), Material("vessel", a.vessel_db)
    muscle, radius = Material("papillary", a.papillary_db, specular=False), heart.muscle_radius
    sheets = [
        TissueSheet(material, points, thickness, span, _mottled(thickness.shape, 2.0, rng))
        for material, (points, thickness), span in (
            (wall, heart.ventricle, (0.0, 1.0)),
            (vessel, heart.atrium, (-1.0, 0.0)),
            (vessel, heart.aorta, (-0.5, 0.5)),
        )
    ]
    cords = [Cord(muscle, m, radius, False, np.zeros(len(radius))) for m in heart.muscles]
    return [*sheets, *cords]


def _outer_parts(heart: Heart, a: Acquisition, rng: np.random.Generator) -> list[TissuePart]:
    """Pericardium, and tissue around ventricle and atrium away from aorta and right heart."""
    free = 1 - heart.outflow
    pericardium = Material("pericardium", a.vessel_db + 2.0)
    around = Material("surroundings", a.wall_db - 2.0, specular=False, fineness=0.5)
    points, thickness = heart.ventricle
    outside, shape = points + thickness[..., None] * normals(points), thickness.shape
    parts: list[TissuePart] = [
        TissueSheet(
            pericardium, outside, np.full(shape, 1.2), (0.0, 1.0), np.tile(free, (shape[0], 1))
        )
    ]
    points, thickness = heart.atrium
    atrium = points - thickness[..., None] * normals(points)
    # Near the annulus the normal of the atrium's wall points into the ventricle.
    for points, side in ((outside, 1.0), (atrium[:, 4:], -1.0)):
        thickness = np.tile(0.02 + SURROUNDINGS_MM * free, (points.shape[1], 1))
        span = (0.0, 1.0) if side > 0 else (-1.0, 0.0)
        parts.append(
            TissueSheet(around, points, thickness, span, _mottled(thickness.shape, 4.0, rng), FADE)
        )
    return parts


def _mottled(grid: tuple[int, ...], level_db: float, rng: np.random.Generator) -> FloatArray:
    """Smoothly varying relative amplitude of standard deviation ``level_db``."""
    return np.asarray(10 ** (level_db / 20 * waves(rng, grid[0], grid[1], 2, 0.5)))


def _chord(leaflets: FloatArray, tip: FloatArray, phi: float, s: float) -> FloatArray:
    """A straight line ``(T, 2, 3)`` from a papillary tip ``(T, 3)`` to a leaflet end of a tree."""
    rows, columns = leaflets.shape[1:3]
    c, r = phi / 360.0 * columns, s * (rows - 1)
    i, j = int(np.floor(c)), min(int(r), rows - 2)
    x, y = c - i, r - j
    k, l = i % columns, (i + 1) % columns
    end = (1 - y) * ((1 - x) * leaflets[:, j, k] + x * leaflets[:, j, l])
    end += y * ((1 - x) * leaflets[:, j + 1, k] + x * leaflets[:, j + 1, l])
    return np.stack([tip, end], axis=1)


def _dense(columns: int, rng: np.random.Generator) -> FloatArray:
    """Share of dense tissue along the annulus ``(columns,)``: a few smooth patches."""
    phi = 2 * np.pi * np.arange(columns) / columns
    total = np.zeros(columns)
    for _ in range(rng.integers(1, 4)):
        total += np.exp(4 * (np.cos(phi - rng.uniform(0, 2 * np.pi)) - 1)) * rng.uniform(0.3, 1.0)
    return np.minimum(total, 1.0)


def _dropouts(grid: tuple[int, int], a: Acquisition, rng: np.random.Generator) -> FloatArray:
    """Amplitude factor ``grid`` of the leaflets, low in smooth patches of the set share."""
    field = waves(rng, *grid, 2, 0.7)
    if a.dropout == 0:
        return np.ones(grid)
    edge = np.quantile(field, 1 - a.dropout)
    return np.asarray(10 ** (a.dropout_db / 20 / (1 + np.exp(-(field - edge) / 0.08))))


@dataclass(frozen=True, slots=True, eq=False)
class Echoes:
    """The scatterers of one frame."""

    points: FloatArray  #: (n, 3) mm along azimuth, elevation and beam from the apex
    amplitude: FloatArray  #: (n,); tissue of 0 dB has mean power 1, up to the cell's size
    loss: FloatArray  #: (n,) dB mm^3 / cm, one way beyond blood, times the volume per scatterer


class Sown(NamedTuple):
    """A part with its scatterers."""

    part: TissuePart
    seeds: FloatArray  #: (n, 3) material coordinates
    strength: FloatArray  #: (n,) amplitude without the factor of the angle
    loss: FloatArray  #: (n,)


def cell_volume(acquisition: Acquisition, distance_mm: float) -> float:
    """Resolution cell in mm^3 at a depth: product of the three full widths at half maximum."""
    a, e = np.deg2rad([acquisition.lateral_deg, acquisition.elevation_deg])
    return float(acquisition.axial_mm * a * e * distance_mm**2)


def make_scene(
    valve: MovingValve, acquisition: Acquisition, probe: Probe, rng: np.random.Generator
) -> list[Sown]:
    """The heart around a valve with scatterers, at least 8 per part.

    Walls have ``acquisition.scatterers_per_cell`` in a resolution cell at the valve; thin tissue
    has more.
    """
    a = acquisition
    heart = make_heart(valve, probe.apex_in_valve, rng)
    distance = float(np.linalg.norm(probe.apex_in_valve))
    density = a.scatterers_per_cell / cell_volume(a, distance)
    more = max(a.attenuation_db_per_cm_mhz - a.blood_attenuation_db_per_cm_mhz, 0.0)
    scene = []
    for part in make_parts(valve, heart, a, rng):
        count = max(8, round(density * part.material.fineness * part.volume))
        seeds, strength, dense = part.sow(rng, count)
        share = part.volume / count
        loss = a.frequency_mhz * more + a.shadow_db_per_cm * dense
        level = 10 ** (part.material.echo_db / 20) * np.sqrt(share)
        scene.append(Sown(part, seeds, level * strength, share * loss))
    return scene


def scene_echoes(
    scene: Sequence[Sown], frame: int, acquisition: Acquisition, probe: Probe
) -> Echoes:
    """The scatterers in one frame."""
    apex, floor = probe.apex_in_valve, 10 ** (acquisition.angle_floor_db / 20)
    points, amplitudes = [], []
    for part, seeds, strength, _ in scene:
        place, facing = part.place(frame, seeds, apex)
        points.append(probe.to_world(place))
        if part.material.specular:
            strength = strength * (floor + (1 - floor) * facing**acquisition.angle_exponent)
        amplitudes.append(strength)
    losses = np.concatenate([sown.loss for sown in scene])
    return Echoes(np.concatenate(points), np.concatenate(amplitudes), losses)
