"""The parametric mitral valve: a smooth surface in material coordinates, chordae and motion.

Material coordinates
--------------------
* ``phi`` in degrees runs once around the valve: 0 and 180 are the two commissures, (0, 180) is the
  anterior leaflet with its middle at 90, (180, 360) the posterior leaflet with its middle at 270.
* ``s`` in [0, 1] runs from the annulus to the free edge.
* ``zeta`` in [-1, 1] runs through the thickness from the atrial to the ventricular face.

Axes: x commissural, y towards the anterior side, z towards the atrium; the ventricle and the
papillary tips lie at negative z. All lengths are mm.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.dimensions import FAMILIES, ChordLayout, TemplateParameters
from mvest.valve.anatomy.valve import Chordae, Motion, Valve, sampled_valve

ANTERIOR, POSTERIOR = 0, 1
REGIONS = ("anterior", "posterior")

FLATTENING = 0.10
"""Relative shortening of the anterior half of the annulus."""
LENGTH_EXPONENT = (1.2, 0.8)
"""Exponents of the sine by which leaflets shorten towards the commissures [choice]."""
EDGE_EXPONENT = (2.0, 1.2)
"""Exponents of the sine of the open edges from above: 1 is half an ellipse, 2 a parabola. The
orifice has the shape of a D."""
INDENTATION_ANGLE, INDENTATION_WIDTH = 32.0, 14.0
"""Degrees from the middle of the posterior leaflet to the indentations between its scallops, and
half their width [choice]."""
MARGINAL_S = 0.97
"""Coordinate s at which marginal chordae insert."""
BRANCHING = 0.65
"""Share of the way from the papillary tip at which marginal chordae branch [choice]."""


class ChordPlaces(NamedTuple):
    """Places of chordae in material coordinates, with the segments of `Chordae`."""

    phi: FloatArray  #: ``(c,)`` degrees, of the leaflet ends
    s: FloatArray  #: (c,)
    family: IntArray  #: ``(k,)`` index into `FAMILIES`
    tip: IntArray  #: ``(k,)``
    parent: IntArray  #: ``(k,)``

    @property
    def beyond(self) -> FloatArray:
        """Weights ``(k, c)`` of the mean of the leaflet ends beyond the end of each segment."""
        c = len(self.phi)
        trunks = self.parent[:c] == np.arange(len(self.parent) - c)[:, None]
        return np.concatenate([np.eye(c), trunks / trunks.sum(axis=1, keepdims=True)])


def smoothstep(x: FloatArray) -> FloatArray:
    """C2 step from 0 to 1 on [0, 1] (quintic)."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x * x)


def _mirrored(point: tuple[float, float, float]) -> FloatArray:
    """A point of the half at positive x, and its mirror image ``(2, 3)``."""
    x, y, z = point
    return np.array([[x, y, z], [-x, y, z]])


def _between(phi: FloatArray, start: float, end: float) -> BoolArray:
    """Which angles ``(k,)`` in degrees lie in [start, end] modulo 360."""
    return np.asarray(np.mod(phi - start, 360.0) <= end - start)


def vertex_region(phi: FloatArray) -> IntArray:
    """Leaflet of vertices ``(k,)`` at angles in degrees; commissures belong to the posterior."""
    return np.where((phi > 0) & (phi < 180), ANTERIOR, POSTERIOR)


class Template:
    """A valve in material coordinates.

    Raises
    ------
    GeometryError
        If a leaflet is too short to reach its free edge.
    """

    def __init__(self, parameters: TemplateParameters | None = None) -> None:
        self.parameters = parameters or TemplateParameters()
        self.region_names: tuple[str, ...] = REGIONS
        self.sections: tuple[int, ...] = (ANTERIOR, POSTERIOR)

    # -- surface ----------------------------------------------------------------------------------
    def annulus(self, phi: FloatArray) -> FloatArray:
        """Annulus points ``(k, 3)`` in the reference frame."""
        p = self.parameters.annulus
        theta = self._annulus_angle(phi)
        posterior = p.anteroposterior_diameter / (2 - FLATTENING)
        half = np.where(np.sin(theta) > 0, (1 - FLATTENING) * posterior, posterior)
        return np.stack(
            [
                0.5 * p.commissural_diameter * np.cos(theta),
                half * np.sin(theta),
                -0.5 * p.saddle_height * np.cos(2 * theta),
            ],
            axis=-1,
        )

    def _annulus_angle(self, phi: FloatArray) -> FloatArray:
        """Parametric angle of the annulus (radians) at material angle ``phi`` (degrees)."""
        phi = np.mod(phi, 360.0)
        c = np.deg2rad(self.parameters.annulus.commissure_angle)
        anterior = c + (np.pi - 2 * c) * phi / 180.0
        posterior = np.pi - c + (np.pi + 2 * c) * (phi - 180.0) / 180.0
        return np.where(phi <= 180.0, anterior, posterior)

    def _length(self, phi: FloatArray) -> FloatArray:
        """Leaflet length ``(k,)`` without indentations."""
        p = self.parameters.leaflets
        sine, edge = np.sin(np.deg2rad(phi)), p.commissural_length
        rise_a = (p.anterior.length - edge) * np.maximum(sine, 0) ** LENGTH_EXPONENT[0]
        rise_b = (p.posterior.length - edge) * np.maximum(-sine, 0) ** LENGTH_EXPONENT[1]
        return edge + rise_a + rise_b

    def _indented(self, phi: FloatArray) -> FloatArray:
        """Share ``(k,)`` of its length that a leaflet has left, 1 between the indentations."""
        away = (np.abs(np.mod(phi, 360.0) - 270.0) - INDENTATION_ANGLE) / INDENTATION_WIDTH
        return 1 - self.parameters.leaflets.indentation * np.maximum(1 - away**2, 0.0) ** 3

    def length(self, phi: FloatArray) -> FloatArray:
        """Leaflet length ``(k,)``."""
        return self._length(phi) * self._indented(phi)

    def _belly(self, phi: FloatArray) -> FloatArray:
        """Depth ``(k,)`` of the leaflets' bulge into the lumen, over their length."""
        p = self.parameters.leaflets
        share = smoothstep(0.5 + np.sin(np.deg2rad(phi)) / (2 * np.sin(np.deg2rad(25.0))))
        return (
            p.posterior.belly
            + (p.anterior.belly - p.posterior.belly) * share
            - (p.scallop_bulge * self._scallops(phi))
        )

    @staticmethod
    def _scallops(phi: FloatArray) -> FloatArray:
        """Wave ``(k,)`` from -1 at the indentations to 1 in the middle of each scallop."""
        away = np.abs(np.mod(phi, 360.0) - 270.0)
        outer = (away - INDENTATION_ANGLE) / (90.0 - INDENTATION_ANGLE)
        turn = np.where(away < INDENTATION_ANGLE, 0.5 + 0.5 * away / INDENTATION_ANGLE, outer)
        wave = -np.cos(2 * np.pi * turn) * smoothstep((90.0 - away) / 20.0)
        return np.where(away < 90.0, wave, 0.0)

    def thickness(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Thickness ``(k,)``, blended over 20 degrees to each side of a commissure."""
        p = self.parameters.leaflets
        thick, other = p.anterior.thickness, p.posterior.thickness
        blend = smoothstep(0.5 + np.sin(np.deg2rad(phi)) / (2 * np.sin(np.deg2rad(20.0))))
        base = other + (thick - other) * blend
        return base * (1 - (1 - p.edge_thinning) * smoothstep((s - 0.5) / 0.5))

    @cached_property
    def _edge_table(self) -> tuple[FloatArray, FloatArray]:
        """Edge angle over phi for points at equal distances along each leaflet's free edge."""
        p = self.parameters.free_edge
        angle = np.linspace(0, 2 * np.pi, 2881)
        phi = np.empty_like(angle)
        for leaflet, depth in enumerate((p.anterior_opening, p.posterior_opening)):
            low, q = leaflet * np.pi, EDGE_EXPONENT[leaflet]
            part = (angle >= low - 1e-12) & (angle <= low + np.pi + 1e-12)
            a = angle[part]
            sine = np.maximum(np.abs(np.sin(a)), 1e-9)
            speed = np.hypot(0.5 * p.width * sine, depth * q * sine ** (q - 1) * np.cos(a))
            arc = np.concatenate([[0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(a))])
            phi[part] = np.rad2deg(low) + 180.0 * arc / arc[-1]
        return phi, angle

    def _edge_xy(self, phi: FloatArray) -> FloatArray:
        """Open free edge ``(k, 2)``: two arcs ``(a cos, b sin^q)`` that share their ends."""
        p = self.parameters.free_edge
        angle = np.interp(np.mod(phi, 360.0), *self._edge_table)
        sine = np.sin(angle)
        rise = p.anterior_opening * np.maximum(sine, 0.0) ** EDGE_EXPONENT[0]
        fall = p.posterior_opening * np.maximum(-sine, 0.0) ** EDGE_EXPONENT[1]
        y = p.commissural_y + rise - fall
        return np.stack([0.5 * p.width * np.cos(angle), y], axis=-1)

    def position(
        self, phi: FloatArray, s: FloatArray, zeta: FloatArray | float = 0.0
    ) -> FloatArray:
        """Reference positions ``(k, 3)`` mm of material points."""
        phi, s = np.broadcast_arrays(np.asarray(phi, float), np.asarray(s, float))
        middle = self._midsurface(phi, s)
        zeta = np.broadcast_to(np.asarray(zeta, float), phi.shape)
        if not np.any(zeta):
            return middle
        offset = 0.5 * zeta * self.thickness(phi, s)
        return middle + offset[..., None] * self.normal(phi, s)

    def _midsurface(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        a = self.annulus(phi)
        edge = self._edge_xy(phi)
        across = edge - a[..., :2]
        reach = np.linalg.norm(across, axis=-1)
        length, s = self._length(phi), s * self._indented(phi)
        if np.any(length <= reach):
            k = int(np.argmax(reach - length))
            raise GeometryError(
                f"the leaflet at phi = {np.ravel(phi)[k]:.0f} degrees is "
                f"{np.ravel(length)[k]:.1f} mm long and cannot reach its free edge, "
                f"{np.ravel(reach)[k]:.1f} mm away"
            )
        drop = np.sqrt(length**2 - reach**2)
        span = np.concatenate([across, -drop[..., None]], axis=-1)
        # The belly bulges into the lumen, perpendicular to the chord in its vertical plane.
        inward = across / reach[..., None]
        belly = np.concatenate(
            [inward * (drop / length)[..., None], (reach / length)[..., None]], axis=-1
        )
        depth = self._belly(phi) * length * 4 * s * (1 - s)
        return a + s[..., None] * span + depth[..., None] * belly

    def tangents(self, phi: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Unit tangents ``(k, 3)`` along the annulus direction and along the leaflet."""
        h = 0.25
        d_phi = self._midsurface(phi + h, s) - self._midsurface(phi - h, s)
        lower, upper = np.clip(s - 0.005, 0, 1), np.clip(s + 0.005, 0, 1)
        d_s = self._midsurface(phi, upper) - self._midsurface(phi, lower)
        return (
            d_phi / np.linalg.norm(d_phi, axis=-1, keepdims=True),
            d_s / np.linalg.norm(d_s, axis=-1, keepdims=True),
        )

    def normal(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Unit normals ``(k, 3)`` towards the ventricle, averaged over neighbouring directions.

        At the commissures the leaflets bend with a radius of about the thickness; raw normals would
        make thick elements overlap there.
        """
        total = np.zeros((*np.shape(phi), 3))
        for shift, weight in ((-8.0, 0.5), (-4.0, 0.8), (0.0, 1.0), (4.0, 0.8), (8.0, 0.5)):
            t, r = self.tangents(phi + shift, s)
            n = np.cross(r, t)
            total += weight * n / np.linalg.norm(n, axis=-1, keepdims=True)
        return total / np.linalg.norm(total, axis=-1, keepdims=True)

    def fibre(self, phi: FloatArray, s: FloatArray, region: IntArray) -> FloatArray:
        """Unit fibre directions ``(k, 3)`` as seen from the leaflet ``region``."""
        t, r = self.tangents(phi, s)
        angle = self.fibre_angle(phi, region)
        normal = np.cross(r, t)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        across = np.cross(normal, t)
        return np.cos(angle)[..., None] * t + np.sin(angle)[..., None] * across

    def fibre_angle(self, phi: FloatArray, region: IntArray) -> FloatArray:
        """Angle ``(k,)`` in rad of the fibres to the direction around the valve.

        It turns the same way round at both commissures (`docs/decisions.md`).
        """
        turn = self.parameters.leaflets.fibre_turn * 180.0
        from_commissure = np.minimum(np.mod(phi, 360.0), np.abs(180.0 - np.mod(phi, 360.0)))
        angle = 0.5 * np.pi * (1 - smoothstep(from_commissure / turn))
        return np.where(region == ANTERIOR, angle, 0.0)

    # -- chordae and motion -----------------------------------------------------------------------
    @property
    def papillary_tips(self) -> FloatArray:
        """Papillary tips ``(2, 3)`` mm, with their displacement."""
        return self._intended_tips + _mirrored(self.parameters.papillary.displacement)

    @property
    def _intended_tips(self) -> FloatArray:
        """The tips ``(2, 3)`` mm that define the lengths of the chordae."""
        return _mirrored(self.parameters.papillary.tip)

    def chord_places(self) -> ChordPlaces:
        """Places of the chordae of both halves; InputError if none is left by `absent`."""
        layout = self.parameters.chordae
        turns = np.linspace(-0.5, 0.5, layout.branches) * layout.fan_width
        if layout.branches == 1:
            turns = np.zeros(1)
        groups = [
            (0, [(middle + turn, MARGINAL_S) for turn in turns]) for middle in layout.marginal
        ]
        for family, places in ((1, layout.basal), (2, layout.strut)):
            groups += [(family, [place]) for place in places]
        ends: list[tuple[float, float, int, int, int]] = []
        trunks: list[tuple[int, int]] = []
        for tip in (0, 1):
            for family, own in groups:
                at = np.array([180.0 - angle if tip else angle for angle, _ in own])
                here = np.ones(len(own), dtype=np.bool_)
                for start, end in layout.absent:
                    here &= ~_between(at, start, end)
                parent = len(trunks) if here.sum() > 1 else -1
                if parent >= 0:
                    trunks.append((family, tip))
                left = zip(at[here], np.array(own)[here, 1], strict=True)
                ends += [(angle, place, family, tip, parent) for angle, place in left]
        if not ends:
            raise InputError(f"chordae absent at {layout.absent}: none is left")
        phi, s, *rest = map(np.array, zip(*ends, strict=True))
        families, tips, parents = rest
        above = np.array(trunks, dtype=np.int64).reshape(-1, 2)
        return ChordPlaces(
            phi,
            s,
            np.concatenate([families, above[:, 0]]),
            np.concatenate([tips, above[:, 1]]),
            np.concatenate([parents, np.full(len(above), -1)]),
        )

    def chordae(self) -> Chordae:
        """The chordae of both halves without the absent ones; InputError if none is left."""
        places = self.chord_places()
        insertion = self.position(places.phi, places.s)
        goal = self._closed_position(places.phi, places.s, insertion)
        tips = self.papillary_tips, self._intended_tips
        return laid_out(places, self.parameters.chordae, (insertion, goal), tips)

    def _closed_position(self, phi: FloatArray, s: FloatArray, rest: FloatArray) -> FloatArray:
        """Intended closed positions: the coaptation line at the free edge, the annulus at s = 0."""
        p = self.parameters.free_edge
        u = np.clip(2 * rest[:, 0] / p.width, -1.0, 1.0)
        y = p.commissural_y - p.sag * (1 - u**2)
        edge = np.stack([0.5 * p.width * u, y, -p.depth - p.drop * u**2], axis=-1)
        return (1 - s)[:, None] * self.annulus(phi) + s[:, None] * edge

    def motion(self, phi: FloatArray) -> Motion:
        """Annulus at ``phi`` and papillary tips from open (phase 0) to closed (phase 1)."""
        p = self.parameters.annulus
        start = self.annulus(phi)
        end = start * [
            1 - p.commissural_contraction,
            1 - p.anteroposterior_contraction,
            1 + p.saddle_deepening,
        ]
        tips = self.papillary_tips
        return Motion(np.array([0.0, 1.0]), np.stack([start, end]), np.stack([tips, tips]))

    def valve(self, columns: int = 112, rows: int = 29) -> Valve:
        """The valve sampled on ``columns x rows`` vertices (default 3248).

        Parameters
        ----------
        columns : int
            Vertices around the valve, even, at least 8.
        rows : int
            Vertices from annulus to free edge, at least 3.
        """
        return sampled_valve(
            self, columns, rows, lambda phi: (self.papillary_tips, self.chordae(), self.motion(phi))
        )


def laid_out(
    places: ChordPlaces,
    layout: ChordLayout,
    ends: tuple[FloatArray, FloatArray],
    tips: tuple[FloatArray, FloatArray],
) -> Chordae:
    """Chordae at their places, long enough for an open and a closed valve.

    The rest length of a segment is ``slack`` times its length in the closed valve. A tree is longer
    where one of its ways from tip to leaflet would otherwise be shorter than ``open_slack`` times
    that in the open valve. Junctions lie on the lines from the tips to the middles of their fans.

    Parameters
    ----------
    places : ChordPlaces
    layout : ChordLayout
    ends : two arrays
        Leaflet ends ``(c, 3)`` mm in the open and the closed valve.
    tips : two arrays
        Papillary tips ``(t, 3)`` mm in both.
    """
    c, parent, beyond = len(places.phi), places.parent, places.beyond
    branch = parent >= 0
    lengths, points = [], []
    for leaflet, tip in zip(ends, tips, strict=True):
        root, end = tip[places.tip], beyond @ leaflet
        end[c:] = root[c:] + BRANCHING * (end[c:] - root[c:])
        start = np.where(branch[:, None], end[c + parent], root)
        lengths.append(np.linalg.norm(end - start, axis=1))
        points.append(end)
    closed = lengths[1]
    trunk = np.where(branch[:c], c + parent[:c], 0)
    ways = [own[:c] + np.where(branch[:c], own[trunk], 0.0) for own in lengths]
    slack = np.array([layout.marginal_slack, layout.basal_slack, layout.basal_slack])[places.family]
    least = layout.open_slack * ways[0] / ways[1]
    tightest = np.concatenate(
        [least, [least[parent[:c] == j].max() for j in range(len(parent) - c)]]
    )
    tightest[:c] = np.where(branch[:c], tightest[trunk], tightest[:c])
    rest = closed * np.maximum(slack, tightest)
    at = np.mod(places.phi, 360.0)
    for begin, stop, factor in layout.elongated:
        rest[beyond @ _between(at, begin, stop) >= 0.5] *= factor
    count = np.where(branch, np.bincount(parent[branch], minlength=1)[parent], 1)
    return Chordae(
        tip=places.tip,
        insertion=ends[0],
        family=places.family,
        family_names=FAMILIES,
        rest_length=rest,
        axial_stiffness=np.array(layout.stiffness)[places.family] / count,
        toe_strain=layout.toe_strain,
        junction=points[0][c:],
        parent=parent,
    )
