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

import numpy as np

from mvest.errors import GeometryError, InputError
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.valve import Chordae, Motion, Valve, sampled_valve

ANTERIOR, POSTERIOR = 0, 1
REGIONS = ("anterior", "posterior")


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
        half = p.anteroposterior_half_axis
        half_y = np.where(np.sin(theta) > 0, half * (1 - p.anterior_flattening), half)
        return np.stack(
            [
                p.commissural_half_axis * np.cos(theta),
                half_y * np.sin(theta),
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

    def length(self, phi: FloatArray) -> FloatArray:
        """Leaflet length ``(k,)``."""
        p = self.parameters.leaflets
        sine, edge = np.sin(np.deg2rad(phi)), p.commissural_length
        a, b = p.anterior, p.posterior
        rise_a = (a.length - edge) * np.maximum(sine, 0) ** a.length_exponent
        rise_b = (b.length - edge) * np.maximum(-sine, 0) ** b.length_exponent
        return edge + rise_a + rise_b

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
        for low, high, depth in (
            (0.0, np.pi, p.anterior_depth),
            (np.pi, 2 * np.pi, p.posterior_depth),
        ):
            part = (angle >= low - 1e-12) & (angle <= high + 1e-12)
            a = angle[part]
            sine, q = np.abs(np.sin(a)), p.exponent
            speed = np.hypot(p.half_width * sine, depth * q * sine ** (q - 1) * np.cos(a))
            arc = np.concatenate([[0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(a))])
            phi[part] = np.rad2deg(low) + 180.0 * arc / arc[-1]
        return phi, angle

    def _edge_xy(self, phi: FloatArray) -> FloatArray:
        """Open free edge ``(k, 2)``: two arcs ``(a cos, b sin^q)`` that share their ends."""
        p = self.parameters.free_edge
        angle = np.interp(np.mod(phi, 360.0), *self._edge_table)
        sine = np.sin(angle)
        depth = np.where(sine > 0, p.anterior_depth, -p.posterior_depth)
        y = p.commissural_y + depth * np.abs(sine) ** p.exponent
        return np.stack([p.half_width * np.cos(angle), y], axis=-1)

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
        # The belly bulges into the lumen, perpendicular to the chord in its vertical plane.
        inward = across / reach[..., None]
        belly = np.concatenate(
            [inward * (drop / length)[..., None], (reach / length)[..., None]], axis=-1
        )
        depth = self.parameters.leaflets.belly_depth * length * 4 * s * (1 - s)
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
        """Angle ``(k,)`` in rad of the fibres to the direction around the valve."""
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

    def chord_places(self) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
        """``phi`` (degrees), ``s``, family (0 marginal, 1 basal) and tip ``(c,)`` of the chordae.

        Absent ones are left out; InputError if none is left.
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
        """The chordae of both halves without the absent ones; InputError if none is left."""
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
        opened, closed = self.parameters.free_edge, self.parameters.closed_edge
        u = np.clip(rest[:, 0] / opened.half_width, -1.0, 1.0)
        y = opened.commissural_y - closed.sag * (1 - u**2)
        z = closed.middle_z - closed.drop * u**2
        edge = np.stack([u * closed.half_width, y, z], axis=-1)
        return (1 - s)[:, None] * self.annulus(phi) + s[:, None] * edge

    def motion(self, phi: FloatArray) -> Motion:
        """Annulus at ``phi`` and papillary tips from open (phase 0) to closed (phase 1)."""
        p = self.parameters.annulus
        start = self.annulus(phi)
        end = start * [1 - p.commissural_contraction, 1 - p.anteroposterior_contraction, 1.0]
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
