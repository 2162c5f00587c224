"""A valve that opens and closes by a formula, and volumes of blurred sheets that show it."""

import numpy as np
from scipy.spatial import cKDTree

from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve, ValveSequence
from mvest.imaging.volume import VolumeSequence
from mvest.valve.anatomy.dimensions import AnnulusDimensions, TemplateParameters
from mvest.valve.anatomy.template import Template

HALF_GAP = 0.5
"""mm from the coaptation line to either closed midsurface."""
COAPTATION = 5.0
"""mm that the closed leaflets lie against each other."""


def leaflets(layout, closure):
    """Vertices (n, 3) mm in the valve's own axes: the template (0) to a closed valve (1)."""
    template = Template()
    phi, s = layout.phi, layout.s
    start = template.position(phi, np.zeros_like(phi))
    edge = template.position(phi, np.ones_like(phi))
    side = np.where((phi > 0) & (phi < 180), HALF_GAP, -HALF_GAP) * (np.sin(np.deg2rad(phi)) != 0)
    meet = np.stack([0.9 * edge[:, 0], 2.0 + side, np.full(len(s), -6.0)], axis=1)
    at = 0.7
    u = np.clip(s / at, 0, 1)[:, None]
    closed = start + u * (meet - start)
    closed[:, 2] -= 1.5 * (4 * u * (1 - u))[:, 0]
    closed[:, 2] -= COAPTATION * np.clip((s - at) / (1 - at), 0, 1)
    return (1 - closure) * template.position(phi, s) + closure * closed


def descending_valve(layout):
    """An anatomy of its own in two open frames, of which the second lies 1 mm lower."""
    template = Template(TemplateParameters(AnnulusDimensions(34.4, 26.8)))
    valve = template.valve(layout.columns, layout.rows)
    places = template.chord_places()
    vertices = valve.surface.vertices
    return MovingValve(
        "not in any training",
        layout,
        np.array([0.0, 0.04]),
        np.stack([vertices, vertices + np.array([0.0, 0.0, -1.0])]),
        np.stack([valve.papillary_tips] * 2),
        valve.surface.thickness,
        places.phi,
        places.s,
        places.tip[: len(places.phi)],
    )


def pose():
    """A proper rotation and a place (mm)."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return turn * np.sign(np.linalg.det(turn)), np.array([12.0, -7.0, 95.0])


def sequence(closures=(1.0, 1.0, 0.4, 0.0), layout=None, confidence=0.9):
    """One frame for every degree of closure, 40 ms apart, in LPS."""
    layout = layout or ValveLayout(64, 15)
    turn, place = pose()
    tips = Template().valve(layout.columns, layout.rows).papillary_tips[:2]
    count = len(closures)
    x = np.stack([leaflets(layout, c) for c in closures]) @ turn.T + place
    edge = 0.3 + 0.5 * layout.s**2
    return ValveSequence(
        layout,
        0.04 * np.arange(count),
        x,
        np.stack([tips + np.array([0, 0, 0.8 * c]) for c in closures]) @ turn.T + place,
        np.full(count, confidence),
        np.tile(1 - 0.4 * layout.s, (count, 1)),
        edge,
        6.0,
    )


def volume(valve, spacing=0.9, margin=8.0, seed=0):
    """An 8-bit volume with a bright sheet at the leaflets and bright tips, in its own axes."""
    everything = np.concatenate([valve.vertices, valve.tips], axis=1).reshape(-1, 3)
    direction = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
    inside = everything @ direction
    low, high = inside.min(0) - margin, inside.max(0) + margin
    shape = np.ceil((high - low) / spacing).astype(int)
    grid = np.stack(np.meshgrid(*(np.arange(k) for k in shape), indexing="ij"), -1)
    origin = direction @ low
    world = origin + (grid.reshape(-1, 3) * spacing) @ direction.T
    rng = np.random.default_rng(seed)
    frames = []
    for x, tips in zip(valve.vertices, valve.tips, strict=True):
        middle = x[valve.layout.triangles].mean(axis=1)
        sheet = cKDTree(np.concatenate([x, middle])).query(world)[0]
        spot = cKDTree(tips).query(world)[0]
        bright = 190 * np.exp(-((sheet / 1.1) ** 2)) + 170 * np.exp(-((spot / 3.5) ** 4))
        echo = np.maximum(bright, 25) * rng.gamma(6.0, 1 / 6.0, len(world))
        frames.append(np.clip(echo, 0, 255).reshape(shape).astype(np.uint8))
    return VolumeSequence(
        np.stack(frames), np.full(3, spacing), direction, origin, valve.times, source="made up"
    )
