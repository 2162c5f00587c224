"""Worlds: in what a simulated valve and how it is seen differ from what its case says.

An estimator believes its case, and models the rest. A world breaks one of these beliefs, so that
estimates can be judged where they are not made of the estimator's own words. What a world draws
comes from a random stream beside that of the patient: in all worlds a seed stands for the same
valve with the same errors, but for what the world adds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.distance import cdist

from mvest.errors import InputError, require_numbers
from mvest.mechanics.law.exponential import as_stiff
from mvest.mechanics.settings import ExponentialTissue, MechanicsSettings
from mvest.observation.errors import CorrelatedNoise, ObservationError, SpatialCorrelation
from mvest.quantities import Factor, Length, Share, Stretch
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import smoothstep
from mvest.valve.anatomy.valve import LeafletSurface, Valve
from mvest.valve.geometry.triangles import surface_edges

KERNELS: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "exponential": lambda ratio: np.exp(-ratio),
    "gaussian": lambda ratio: np.exp(-0.5 * ratio**2),
}
"""Correlation by distance over length, beside that of `SpatialCorrelation`."""

ANNULUS_LENGTH_MM = 20.0
"""Over which errors of the annulus are alike."""


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """What is otherwise than a case says and an estimator assumes; by default nothing.

    Attributes
    ----------
    kernel : str
        Of the smooth errors: ``matern`` (of smoothness 3/2, as assumed), ``exponential`` (which is
        rougher) or ``gaussian`` (which is smoother).
    length_factor : float
        Of the length over which they are alike, against what is stated.
    annulus_mm, tips_mm : float
        Standard deviation of each coordinate by which the closed annulus is seen off, smoothly, and
        the papillary tips in all frames alike.
    pressure_off, thickness_off : float
        Share by which they are off, up or down at random.
    missing : float
        Share of the closed leaflets that was not seen, a patch about a random vertex, and is filled
        in as smoothly as can be.
    outliers : float
        Share of the vertices of the closed leaflets that are seen somewhere else.
    outlier_mm : float
        Standard deviation of each coordinate by which.
    exponential : mapping
        Region -> tissue of the exponential law that takes the place of the linear one, its stresses
        scaled to that one's (see `MechanicsSettings`); empty: the linear law.
    prestretch : float
        How many times as long in their plane open leaflets are as they would be free of stress.
    leaflet_scale : float
        Share by which one leaflet, drawn at random, is seen too long in the open frame, from its
        annulus on.
    frame_scale : float
        Share by which the annulus and both leaflets are seen too large in the open frame.
    """

    kernel: str = "matern"
    length_factor: Factor = 1.0
    annulus_mm: Length = 0.0
    tips_mm: Length = 0.0
    pressure_off: Share = 0.0
    thickness_off: Share = 0.0
    missing: Share = 0.0
    outliers: Share = 0.0
    outlier_mm: Length = 4.0
    exponential: Mapping[str, ExponentialTissue] = field(default_factory=dict)
    prestretch: Stretch = 1.0
    leaflet_scale: Share = 0.0
    frame_scale: Share = 0.0

    def __post_init__(self) -> None:
        if self.kernel not in ("matern", *KERNELS):
            raise InputError(
                f"kernel = {self.kernel!r}, expected one of matern, {', '.join(KERNELS)}"
            )
        require_numbers(self, "world", "length_factor", "prestretch")
        sizes = "annulus_mm", "tips_mm", "pressure_off", "thickness_off", "outlier_mm"
        scales = "leaflet_scale", "frame_scale"
        require_numbers(self, "world", *sizes, *scales, least=0)
        for name in ("missing", "outliers"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise InputError(f"{name} = {getattr(self, name)}, expected a share below 1")

    def values(self, values: Mapping[str, float], rng: np.random.Generator) -> dict[str, float]:
        """True values of the parameters, from those that were drawn."""
        if not self.pressure_off:
            return dict(values)
        return {**values, "pressure_scale": _off(self.pressure_off, rng)}

    def anatomy(
        self, parameters: TemplateParameters, rng: np.random.Generator
    ) -> TemplateParameters:
        """True anatomy, from the one that a case describes."""
        if not self.thickness_off:
            return parameters
        factor, leaflets = _off(self.thickness_off, rng), parameters.leaflets
        anterior, posterior = (
            replace(leaflet, thickness=factor * leaflet.thickness)
            for leaflet in (leaflets.anterior, leaflets.posterior)
        )
        return replace(
            parameters, leaflets=replace(leaflets, anterior=anterior, posterior=posterior)
        )

    def mechanics(
        self, mechanics: MechanicsSettings, values: Mapping[str, float]
    ) -> MechanicsSettings:
        """True mechanics of a valve of moduli ``E_f.REGION``, MPa.

        All stresses of an exponential tissue are scaled so that where leaflets are stretched as
        closed ones are, those along and across its fibres have the mean of the linear tissue's.

        Raises
        ------
        InputError
            If a region has no exponential tissue.
        """
        if self.prestretch != 1.0:
            longer = {
                r: replace(t, prestretch=self.prestretch) for r, t in mechanics.tissue.items()
            }
            mechanics = replace(mechanics, tissue=longer)
        if not self.exponential:
            return mechanics
        if set(self.exponential) != set(mechanics.tissue):
            raise InputError(
                f"exponential tissue of {', '.join(self.exponential)}, expected of "
                f"{', '.join(mechanics.tissue)}"
            )
        tissue = {
            region: replace(
                linear,
                law="exponential",
                exponential=as_stiff(self.exponential[region], linear, values[f"E_f.{region}"]),
            )
            for region, linear in mechanics.tissue.items()
        }
        return replace(mechanics, tissue=tissue)

    def noise(self, std: float, points: FloatArray, length: float) -> ObservationError:
        """Smooth errors of standard deviation ``std`` mm, stated to be alike over ``length`` mm.

        Parameters
        ----------
        std : float
        points : (n, 3) mm
            Vertices at rest.
        length : float
        """
        if self.kernel == "matern":
            correlation = SpatialCorrelation(points, self.length_factor * length)
            return CorrelatedNoise(std, correlation)
        return _SmoothNoise(std, _factor(self.kernel, points, self.length_factor * length))

    def open_moves(self, valve: Valve, rng: np.random.Generator) -> FloatArray:
        """Displacements ``(n, 3)`` mm of the open leaflets as seen, by the errors of their size.

        A leaflet grows away from its annulus, which stays. Within 20 degrees of a commissure its
        error fades into the other leaflet. The whole frame grows from the centre of its annulus.

        Parameters
        ----------
        valve : Valve
            Sampled from a template (see `band_grid`).
        rng : numpy.random.Generator
        """
        x = valve.surface.vertices
        annulus = x[valve.annulus]
        moves = self.frame_scale * (x - annulus.mean(axis=0))
        if not self.leaflet_scale:
            return moves
        column = np.arange(len(x)) % len(annulus)
        # The anterior leaflet lies where the sine is positive.
        side = rng.choice([1.0, -1.0]) * np.sin(2.0 * np.pi * column / len(annulus))
        weight = smoothstep(0.5 + side / (2.0 * np.sin(np.deg2rad(20.0))))
        return moves + self.leaflet_scale * weight[:, None] * (x - annulus[column])

    def boundary(
        self, annulus: FloatArray, tips: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Displacements ``(k, 3)`` of the closed annulus and ``(t, 3)`` mm of the tips as seen."""
        smooth = SpatialCorrelation(annulus, ANNULUS_LENGTH_MM).factor
        return (
            self.annulus_mm * (smooth @ rng.standard_normal(annulus.shape)),
            self.tips_mm * rng.standard_normal(tips.shape),
        )

    def seen(
        self, vertices: FloatArray, surface: LeafletSurface, rng: np.random.Generator
    ) -> FloatArray:
        """Vertices ``(n, 3)`` mm of the closed leaflets as they are stated, from those seen."""
        vertices = np.array(vertices)
        if self.outliers:
            count = round(self.outliers * len(vertices))
            which = rng.choice(len(vertices), count, replace=False)
            vertices[which] += self.outlier_mm * rng.standard_normal((count, 3))
        if self.missing:
            centre = rng.integers(len(vertices))
            distance = np.linalg.norm(surface.vertices - surface.vertices[centre], axis=1)
            hidden = np.argsort(distance)[: round(self.missing * len(vertices))]
            moves = _filled(vertices - surface.vertices, hidden, surface.triangles)
            vertices[hidden] = surface.vertices[hidden] + moves[hidden]
        return vertices


@dataclass(frozen=True, slots=True, eq=False)
class _SmoothNoise:
    """Normal noise with a factor ``(n, n)`` of its correlation; see `CorrelatedNoise`."""

    std: float
    factor: FloatArray

    def __call__(
        self, seen: FloatArray, true: FloatArray, rng: np.random.Generator, /
    ) -> FloatArray:
        white = rng.standard_normal(seen.shape)
        return np.asarray(seen + self.std * np.einsum("ij,fjk->fik", self.factor, white))


def _factor(kernel: str, points: FloatArray, length: float) -> FloatArray:
    """Symmetric factor ``(n, n)`` of a correlation, which may be all but singular."""
    w, V = np.linalg.eigh(KERNELS[kernel](cdist(points, points) / length))
    return np.asarray((V * np.sqrt(np.maximum(w, 0.0))) @ V.T)


def _off(share: float, rng: np.random.Generator) -> float:
    """A factor, or its inverse."""
    return float((1.0 + share) ** rng.choice([-1.0, 1.0]))


def _filled(field: FloatArray, hidden: IntArray, triangles: IntArray) -> FloatArray:
    """A field ``(n, d)`` of a surface with harmonic values where it is hidden."""
    n = len(field)
    a, b = surface_edges(triangles).T
    ones = np.ones(2 * len(a))
    near = csr_array((ones, (np.r_[a, b], np.r_[b, a])), shape=(n, n))
    laplacian = csr_array(diags_array(near.sum(axis=1)) - near)
    own = np.zeros(n, dtype=np.bool_)
    own[hidden] = True
    filled = np.array(field)
    rows = laplacian[own]
    filled[own] = spsolve(rows[:, own].tocsc(), -(rows[:, ~own] @ field[~own])).reshape(-1, 3)
    return filled
