"""The parts of the heart that send echoes, with what each does to sound."""

from __future__ import annotations

import numpy as np

from mvest.imaging.moving_valve import MovingValve
from mvest.imaging.simulator.acquisition import Acquisition
from mvest.imaging.simulator.chambers import Heart, waves
from mvest.imaging.simulator.scatterers import Cord, Material, TissuePart, TissueSheet, normals
from mvest.typing import FloatArray

SURROUNDINGS_MM, FADE = 20.0, 2.0
"""Thickness of what is shown outside the heart, and over how much of it it fades (a choice)."""


def make_parts(
    valve: MovingValve, heart: Heart, acquisition: Acquisition, rng: np.random.Generator
) -> list[TissuePart]:
    """Leaflets, annulus, chordae, muscles, walls of the chambers and what surrounds them."""
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
    muscle = Material("papillary", a.papillary_db, specular=False)
    parts: list[TissuePart] = []
    for material, points, thickness, span in (
        (wall, heart.ventricle, heart.ventricle_thickness, (0.0, 1.0)),
        (vessel, heart.atrium, heart.atrium_thickness, (-1.0, 0.0)),
        (vessel, heart.aorta, heart.aorta_thickness, (-0.5, 0.5)),
    ):
        parts.append(
            TissueSheet(material, points, thickness, span, _mottled(thickness.shape, 2.0, rng))
        )
    radius = heart.muscle_radius
    parts += [Cord(muscle, m, radius, False, np.zeros(len(radius))) for m in heart.muscles]
    return parts


def _outer_parts(heart: Heart, a: Acquisition, rng: np.random.Generator) -> list[TissuePart]:
    """Pericardium, and tissue around ventricle and atrium, not towards aorta and right heart."""
    free = 1 - heart.outflow
    pericardium = Material("pericardium", a.vessel_db + 2.0)
    around = Material("surroundings", a.wall_db - 2.0, specular=False, fineness=0.5)
    outside = heart.ventricle + heart.ventricle_thickness[..., None] * normals(heart.ventricle)
    shape = heart.ventricle_thickness.shape
    parts: list[TissuePart] = [
        TissueSheet(
            pericardium, outside, np.full(shape, 1.2), (0.0, 1.0), np.tile(free, (shape[0], 1))
        )
    ]
    atrium = heart.atrium - heart.atrium_thickness[..., None] * normals(heart.atrium)
    # Close to the annulus the atrium's wall turns outward, and its normal into the ventricle.
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
    """From a papillary tip ``(T, 3)`` to the insertion: ``(T, 2, 3)``."""
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
    """Amplitude factor ``grid`` of the leaflets, low in smooth patches of the share wanted."""
    field = waves(rng, *grid, 2, 0.7)
    if a.dropout == 0:
        return np.ones(grid)
    edge = np.quantile(field, 1 - a.dropout)
    return np.asarray(10 ** (a.dropout_db / 20 / (1 + np.exp(-(field - edge) / 0.08))))
