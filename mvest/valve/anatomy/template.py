"""The parametric mitral valve: a smooth surface in material coordinates, and what hangs on it.

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

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.valve import Chordae, LeafletSurface, Motion, Valve

__all__ = ["ChordLayout", "Template", "TemplateParameters"]

ANTERIOR, POSTERIOR = 0, 1
REGIONS = ("anterior", "posterior")


@dataclass(frozen=True, slots=True)
class ChordLayout:
    """Where the chordae insert, in material coordinates of one half; the other half is mirrored.

    Attributes
    ----------
    marginal_phi : tuple of float
        Degrees from the commissure, positive on the anterior leaflet, at ``s = marginal_s``.
    basal : tuple of (float, float)
        (phi, s) of the basal chordae.
    marginal_s : float
    marginal_stiffness, basal_stiffness : float
        Axial stiffness EA, N.
    marginal_slack, basal_slack : float
        Rest length over the distance to the intended closed position.
    open_slack : float
        Rest length over the open length, at least.
    toe_strain : float
    elongated : tuple of (float, float, float)
        (from, to, factor): chordae that insert at these ``phi`` of the whole valve, in degrees, are
        longer by the factor; where ranges overlap, by all of theirs. Nothing is mirrored.
    absent : tuple of (float, float)
        (from, to): chordae that insert at these ``phi`` of the whole valve are missing.

    Raises
    ------
    InputError
        If there is no chord, a place is incomplete, a range is empty or a factor not positive.
    """

    marginal_phi: tuple[float, ...] = tuple(np.linspace(-87.0, 88.0, 14).round(3).tolist())
    basal: tuple[tuple[float, float], ...] = ((-60.0, 0.5), (50.0, 0.55), (75.0, 0.55))
    marginal_s: float = 0.97
    marginal_stiffness: float = 20.0
    basal_stiffness: float = 16.0
    marginal_slack: float = 0.985
    basal_slack: float = 1.03
    open_slack: float = 1.035
    toe_strain: float = 0.015
    elongated: tuple[tuple[float, float, float], ...] = ()
    absent: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if not self.marginal_phi and not self.basal:
            raise InputError("a chord layout needs at least one chord")
        for k, place in enumerate(self.basal):
            if len(place) != 2:
                raise InputError(f"basal chord {k} is {place}, expected (phi, s)")
        for elongation in self.elongated:
            if len(elongation) != 3 or not (elongation[0] < elongation[1] and elongation[2] > 0):
                raise InputError(
                    f"elongated chordae {elongation}, expected (from, to, factor) with from < to "
                    "and factor > 0"
                )
        for gap in self.absent:
            if len(gap) != 2 or not gap[0] < gap[1]:
                raise InputError(f"absent chordae {gap}, expected (from, to) with from < to")


@dataclass(frozen=True, slots=True)
class TemplateParameters:
    """Shape of the valve; lengths in mm, angles in degrees.

    Attributes
    ----------
    half_commissural, half_ap : float
        Half axes of the annulus.
    saddle : float
        Height of the annulus.
    flattening : float
        Share by which the anterior half axis is shorter.
    commissure_angle : float
        Parametric angle of the commissures above the x axis.
    length_anterior, length_posterior, length_commissure : float
        Leaflet lengths from annulus to free edge in the middle and at the commissures.
    exponent_anterior, exponent_posterior : float
        Power of the sine with which the length falls off towards the commissures.
    bulge : float
        Depth of the leaflets' belly over their length.
    edge_half_width : float
        Half width of the open free edge between the commissures.
    edge_exponent : float
        Shape of the open free edge: 1 gives half ellipses, 2 parabolas that meet at an angle.
    edge_y : float
        y of the free edge at the commissures.
    edge_anterior, edge_posterior : float
        y of the open free edge's middles relative to ``edge_y`` (anterior up, posterior down).
    tips : tuple
        (x, y, z) of the papillary tip at positive x; the other is its mirror image.
    tips_displacement : tuple
        (x, y, z) by which this tip has moved since the chordae got their lengths, outward for
        positive x; the other moves as its mirror image. The chordae do not follow, so they tether
        the leaflets; they are only never taut in the open valve.
    thickness_anterior, thickness_posterior : float
    taper : float
        Thickness at the free edge over that of the annular half.
    ap_contraction, commissural_contraction : float
        Shares by which the annulus shrinks until the valve is closed.
    closed_sag, closed_half_width, closed_z, closed_drop : float
        Intended coaptation line, from which the rest lengths of the chordae follow:
        ``y = edge_y - sag (1 - u^2)``, ``z = closed_z - drop u^2`` with ``u = x / half_width``.
    fibre_turn : float
        Share of the anterior leaflet's angle at each commissure over which its fibres turn from
        parallel to perpendicular to the annulus.
    """

    half_commissural: float = 18.0
    half_ap: float = 14.0
    saddle: float = 6.5
    flattening: float = 0.08
    commissure_angle: float = 19.6
    length_anterior: float = 24.0
    length_posterior: float = 18.8
    length_commissure: float = 11.0
    exponent_anterior: float = 1.2
    exponent_posterior: float = 1.2
    bulge: float = 0.04
    edge_half_width: float = 15.5
    edge_exponent: float = 2.0
    edge_y: float = 1.83
    edge_anterior: float = 6.5
    edge_posterior: float = 10.5
    tips: tuple[float, float, float] = (16.0, -0.24, -25.0)
    tips_displacement: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thickness_anterior: float = 1.32
    thickness_posterior: float = 1.26
    taper: float = 0.75
    ap_contraction: float = 0.064
    commissural_contraction: float = 0.008
    closed_sag: float = 7.19
    closed_half_width: float = 13.0
    closed_z: float = -10.9
    closed_drop: float = 3.4
    fibre_turn: float = 0.23
    chordae: ChordLayout = ChordLayout()

    def __post_init__(self) -> None:
        for name in ("tips", "tips_displacement"):
            if len(getattr(self, name)) != 3:
                raise InputError(f"template {name} = {getattr(self, name)}, expected (x, y, z)")
        if not 0 < self.fibre_turn <= 0.5:
            raise InputError(f"template fibre_turn = {self.fibre_turn}, expected in (0, 0.5]")
        for name in (
            "half_commissural", "half_ap", "length_anterior", "length_posterior",
            "length_commissure", "edge_half_width", "thickness_anterior", "thickness_posterior",
            "taper", "closed_half_width",
        ):  # fmt: skip
            if not getattr(self, name) > 0:
                raise InputError(f"template {name} = {getattr(self, name)}, expected > 0")


def _smoothstep(x: FloatArray) -> FloatArray:
    """C2 step from 0 to 1 on [0, 1] (quintic)."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x * x)


def _mirrored(point: tuple[float, float, float]) -> FloatArray:
    """A point of the half at positive x, and its mirror image ``(2, 3)``."""
    x, y, z = point
    return np.array([[x, y, z], [-x, y, z]])


def _between(phi: FloatArray, start: float, end: float) -> BoolArray:
    """Which angles ``(k,)`` in degrees lie in [start, end], whatever multiple of 360 they are."""
    return np.asarray(np.mod(phi - start, 360.0) <= end - start)


class Template:
    """A valve in material coordinates.

    Parameters
    ----------
    parameters : TemplateParameters

    Raises
    ------
    GeometryError
        If a leaflet is too short to reach its free edge.
    """

    def __init__(self, parameters: TemplateParameters | None = None) -> None:
        self.parameters = parameters or TemplateParameters()
        self.region_names: tuple[str, ...] = REGIONS

    # -- surface ----------------------------------------------------------------------------------
    def annulus(self, phi: FloatArray) -> FloatArray:
        """Annulus points ``(k, 3)`` in the reference frame."""
        p = self.parameters
        theta = self._annulus_angle(phi)
        half_ap = np.where(np.sin(theta) > 0, p.half_ap * (1 - p.flattening), p.half_ap)
        return np.stack(
            [
                p.half_commissural * np.cos(theta),
                half_ap * np.sin(theta),
                -0.5 * p.saddle * np.cos(2 * theta),
            ],
            axis=-1,
        )

    def _annulus_angle(self, phi: FloatArray) -> FloatArray:
        """Parametric angle of the annulus (radians) at material angle ``phi`` (degrees)."""
        phi = np.mod(phi, 360.0)
        c = np.deg2rad(self.parameters.commissure_angle)
        anterior = c + (np.pi - 2 * c) * phi / 180.0
        posterior = np.pi - c + (np.pi + 2 * c) * (phi - 180.0) / 180.0
        return np.where(phi <= 180.0, anterior, posterior)

    def length(self, phi: FloatArray) -> FloatArray:
        """Leaflet length ``(k,)``."""
        p = self.parameters
        sine = np.sin(np.deg2rad(phi))
        rise_a = (p.length_anterior - p.length_commissure) * np.maximum(
            sine, 0
        ) ** p.exponent_anterior
        rise_p = (p.length_posterior - p.length_commissure) * np.maximum(
            -sine, 0
        ) ** p.exponent_posterior
        return p.length_commissure + rise_a + rise_p

    def thickness(self, phi: FloatArray, s: FloatArray) -> FloatArray:
        """Thickness ``(k,)``; blends between the leaflets over 20 degrees at each commissure."""
        p = self.parameters
        blend = _smoothstep(0.5 + np.sin(np.deg2rad(phi)) / (2 * np.sin(np.deg2rad(20.0))))
        base = p.thickness_posterior + (p.thickness_anterior - p.thickness_posterior) * blend
        return base * (1 - (1 - p.taper) * _smoothstep((s - 0.5) / 0.5))

    @cached_property
    def _edge_table(self) -> tuple[FloatArray, FloatArray]:
        """Edge angle over phi such that points are spread evenly along each leaflet's free edge."""
        p = self.parameters
        angle = np.linspace(0, 2 * np.pi, 2881)
        phi = np.empty_like(angle)
        for low, high, depth in (
            (0.0, np.pi, p.edge_anterior),
            (np.pi, 2 * np.pi, p.edge_posterior),
        ):
            part = (angle >= low - 1e-12) & (angle <= high + 1e-12)
            a = angle[part]
            sine, q = np.abs(np.sin(a)), p.edge_exponent
            speed = np.hypot(p.edge_half_width * sine, depth * q * sine ** (q - 1) * np.cos(a))
            arc = np.concatenate([[0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(a))])
            phi[part] = np.rad2deg(low) + 180.0 * arc / arc[-1]
        return phi, angle

    def _edge_xy(self, phi: FloatArray) -> FloatArray:
        """Open free edge ``(k, 2)``: two arcs ``(a cos, b sin^q)`` that share their ends."""
        p = self.parameters
        angle = np.interp(np.mod(phi, 360.0), *self._edge_table)
        sine = np.sin(angle)
        depth = np.where(sine > 0, p.edge_anterior, -p.edge_posterior)
        y = p.edge_y + depth * np.abs(sine) ** p.edge_exponent
        return np.stack([p.edge_half_width * np.cos(angle), y], axis=-1)

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
        length = self.length(phi)
        if np.any(length <= reach):
            k = int(np.argmax(reach - length))
            raise GeometryError(
                f"the leaflet at phi = {np.ravel(phi)[k]:.0f} degrees is "
                f"{np.ravel(length)[k]:.1f} mm long and cannot reach its free edge, "
                f"{np.ravel(reach)[k]:.1f} mm away"
            )
        drop = np.sqrt(length**2 - reach**2)
        span = np.concatenate([across, -drop[..., None]], axis=-1)
        # The belly lies towards the lumen, perpendicular to the chord in its vertical plane.
        inward = across / reach[..., None]
        belly = np.concatenate(
            [inward * (drop / length)[..., None], (reach / length)[..., None]], axis=-1
        )
        depth = self.parameters.bulge * length * 4 * s * (1 - s)
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
        """Unit normals ``(k, 3)`` towards the ventricle.

        Averaged over neighbouring directions: at the commissures the leaflets bend with a radius of
        about the thickness, and raw normals would make thick elements overlap there.
        """
        total = np.zeros((*np.shape(phi), 3))
        for shift, weight in ((-8.0, 0.5), (-4.0, 0.8), (0.0, 1.0), (4.0, 0.8), (8.0, 0.5)):
            t, r = self.tangents(phi + shift, s)
            n = np.cross(r, t)
            total += weight * n / np.linalg.norm(n, axis=-1, keepdims=True)
        return total / np.linalg.norm(total, axis=-1, keepdims=True)

    def fibre(self, phi: FloatArray, s: FloatArray, region: IntArray) -> FloatArray:
        """Unit fibre directions ``(k, 3)`` seen from the leaflet ``region``."""
        t, r = self.tangents(phi, s)
        turn = self.parameters.fibre_turn * 180.0
        from_commissure = np.minimum(np.mod(phi, 360.0), np.abs(180.0 - np.mod(phi, 360.0)))
        angle = 0.5 * np.pi * (1 - _smoothstep(from_commissure / turn))
        angle = np.where(region == ANTERIOR, angle, 0.0)
        normal = np.cross(r, t)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        across = np.cross(normal, t)
        return np.cos(angle)[..., None] * t + np.sin(angle)[..., None] * across

    # -- what hangs on it -------------------------------------------------------------------------
    @property
    def papillary_tips(self) -> FloatArray:
        """Where the tips are ``(2, 3)`` mm, displacement included."""
        return self._intended_tips + _mirrored(self.parameters.tips_displacement)

    @property
    def _intended_tips(self) -> FloatArray:
        """``(2, 3)`` mm: the tips for which the chordae have their lengths."""
        return _mirrored(self.parameters.tips)

    def chord_places(self) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
        """Where the chordae of both halves insert, in their order and without the absent ones.

        Returns
        -------
        phi : (c,) degrees
        s : (c,)
        family : (c,)
            0 marginal, 1 basal.
        tip : (c,)

        Raises
        ------
        InputError
            If all of them are absent.
        """
        layout = self.parameters.chordae
        marginal = [(phi, layout.marginal_s, 0) for phi in layout.marginal_phi]
        basal = [(phi, s, 1) for phi, s in layout.basal]
        phi, s, family = (np.array(v, dtype=float) for v in zip(*marginal, *basal, strict=True))
        phi = np.concatenate([phi, 180.0 - phi])
        s, family = np.tile(s, 2), np.tile(family, 2).astype(np.int64)
        tip = np.repeat([0, 1], len(family) // 2)
        present = np.ones(len(phi), dtype=bool)
        for start, end in layout.absent:
            present &= ~_between(phi, start, end)
        if not np.any(present):
            raise InputError(f"chordae absent at {layout.absent}: none is left")
        phi, s, family, tip = phi[present], s[present], family[present], tip[present]
        return phi, s, family, tip

    def chordae(self) -> Chordae:
        """The chordae of both halves, without the absent ones.

        Raises
        ------
        InputError
            If all of them are absent.
        """
        layout = self.parameters.chordae
        phi, s, family, tip = self.chord_places()
        insertion = self.position(phi, s)
        tips = self.papillary_tips[tip]
        open_length = np.linalg.norm(insertion - tips, axis=1)
        target = self._closed_position(phi, s, insertion)
        slack = np.where(family == 0, layout.marginal_slack, layout.basal_slack)
        closed_length = np.linalg.norm(target - self._intended_tips[tip], axis=1)
        rest = np.maximum(slack * closed_length, layout.open_slack * open_length)
        for start, end, factor in layout.elongated:
            rest[_between(phi, start, end)] *= factor
        stiffness = np.where(family == 0, layout.marginal_stiffness, layout.basal_stiffness)
        return Chordae(
            tip, insertion, family, ("marginal", "basal"), rest, stiffness, layout.toe_strain
        )

    def _closed_position(self, phi: FloatArray, s: FloatArray, rest: FloatArray) -> FloatArray:
        """Intended closed positions: the coaptation line at the free edge, the annulus at s = 0."""
        p = self.parameters
        u = np.clip(rest[:, 0] / p.edge_half_width, -1.0, 1.0)
        y = p.edge_y - p.closed_sag * (1 - u**2)
        z = p.closed_z - p.closed_drop * u**2
        edge = np.stack([u * p.closed_half_width, y, z], axis=-1)
        return (1 - s)[:, None] * self.annulus(phi) + s[:, None] * edge

    def motion(self, phi: FloatArray) -> Motion:
        """Annulus at ``phi`` and papillary tips from open (phase 0) to closed (phase 1)."""
        p = self.parameters
        start = self.annulus(phi)
        end = start * np.array([1 - p.commissural_contraction, 1 - p.ap_contraction, 1.0])
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
        if columns < 8 or columns % 2 or rows < 3:
            raise InputError(
                f"template of {columns} x {rows} vertices, expected an even number >= 8 x >= 3"
            )
        i, j = np.meshgrid(np.arange(columns), np.arange(rows))
        phi, s = (360.0 * i / columns).ravel(), (j / (rows - 1)).ravel()
        cell_i, cell_j = (v.ravel() for v in np.meshgrid(np.arange(columns), np.arange(rows - 1)))
        a = cell_j * columns + cell_i
        b = cell_j * columns + (cell_i + 1) % columns
        c, d = b + columns, a + columns
        # (r x t) points to the ventricle: a, d, c turns that way.
        triangles = np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)])
        region = np.tile(np.where(2 * cell_i < columns, ANTERIOR, POSTERIOR), 2)
        vertex_region = np.where((phi > 0) & (phi < 180), ANTERIOR, POSTERIOR)
        surface = LeafletSurface(
            self.position(phi, s),
            triangles,
            region,
            REGIONS,
            self.fibre(phi, s, vertex_region),
            self.thickness(phi, s),
        )
        return Valve(
            surface,
            np.arange(columns),
            np.arange(columns) + (rows - 1) * columns,
            self.papillary_tips,
            self.chordae(),
            self.motion(phi[:columns]),
        )
