"""Misspecifications: how a simulated valve, and its observation, differ from what its case states.

An estimator believes its case, and models the rest. A misspecification breaks one of these beliefs,
so that estimates are judged where the estimator's assumptions do not hold. Its draws come from a
random stream separate from the patient's. So a seed gives the same valve with the same errors under
all of them, apart from what the misspecification adds.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.distance import cdist

from mvest.errors import InputError
from mvest.mechanics.settings import MechanicsSettings, TissueSettings
from mvest.observation.errors import CorrelatedNoise, ObservationError, SpatialCorrelation
from mvest.quantities import Factor, Length, Share
from mvest.typing import FloatArray, IntArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import smoothstep
from mvest.valve.anatomy.valve import LeafletSurface, Valve
from mvest.valve.geometry.triangles import surface_edges

KERNELS: Mapping[str, Callable[[FloatArray], FloatArray]] = {
    "exponential": lambda ratio: np.exp(-ratio),
    "gaussian": lambda ratio: np.exp(-0.5 * ratio**2),
}
"""Correlation as a function of distance over length, in addition to `SpatialCorrelation`."""

ANNULUS_LENGTH_MM = 20.0
"""Correlation length of errors of the annulus."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Misspecification:
    """Differences from what a case states and an estimator assumes; by default none."""

    #: Of the smooth errors: ``matern`` (of smoothness 3/2, as assumed), ``exponential`` (rougher)
    #: or ``gaussian`` (smoother).
    kernel: str = "matern"
    length_factor: Factor = 1.0  #: on the stated correlation length of the smooth errors
    annulus_mm: Length = 0.0  #: SD of each coordinate of a smooth error of the closed annulus
    tips_mm: Length = 0.0  #: the same of the tips, equal in the open and the closed frame
    pressure_off: Share = 0.0  #: relative error, up or down at random
    thickness_off: Share = 0.0  #: the same of the thickness
    missing: Share = 0.0  #: share of the closed leaflets not seen: a patch, filled in smoothly
    outliers: Share = 0.0  #: share of the vertices of the closed leaflets that are outliers
    outlier_mm: Length = 4.0  #: SD of each coordinate of their errors
    #: Region -> tissue that replaces the stated one: of another law, or prestretched. Empty: none.
    tissue: dict[str, TissueSettings] = field(default_factory=dict)
    #: Relative error of one leaflet's length from the annulus in the open frame, too long. The
    #: leaflet is drawn at random.
    leaflet_scale: Share = 0.0
    frame_scale: Share = 0.0  #: relative error of the size of the open frame, too large

    def __post_init__(self) -> None:
        if self.kernel not in ("matern", *KERNELS):
            raise InputError(
                f"kernel = {self.kernel!r}, expected one of matern, {', '.join(KERNELS)}"
            )
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
        names = "anterior", "posterior"
        thickness = {name: factor * getattr(leaflets, name).thickness for name in names}
        return parameters.changed(
            {f"leaflets.{name}.thickness": mm for name, mm in thickness.items()}
        )

    def mechanics(self, mechanics: MechanicsSettings) -> MechanicsSettings:
        """True mechanics; InputError if a leaflet has no other tissue while others have."""
        if self.tissue and set(self.tissue) != set(mechanics.tissue):
            raise InputError(
                f"other tissue of {', '.join(self.tissue)}, expected of "
                f"{', '.join(mechanics.tissue)}"
            )
        return replace(mechanics, tissue=self.tissue) if self.tissue else mechanics

    def noise(self, std: float, points: FloatArray, length: float) -> ObservationError:
        """Smooth errors of standard deviation ``std`` mm, of the stated correlation length (mm).

        ``points (n, 3)`` mm are the vertices at rest.
        """
        length *= self.length_factor
        if self.kernel == "matern":
            return CorrelatedNoise(std, SpatialCorrelation(points, length))
        # Such a correlation may be nearly singular, so its symmetric factor is used.
        w, V = np.linalg.eigh(KERNELS[self.kernel](cdist(points, points) / length))
        factor = (V * np.sqrt(np.maximum(w, 0.0))) @ V.T

        def smooth(seen: FloatArray, _: FloatArray, rng: np.random.Generator) -> FloatArray:
            white = rng.standard_normal(seen.shape)
            return np.asarray(seen + std * np.einsum("ij,fjk->fik", factor, white))

        return smooth

    def open_moves(self, valve: Valve, rng: np.random.Generator) -> FloatArray:
        """Errors ``(n, 3)`` mm of the open leaflets in size.

        A leaflet grows away from its annulus, which does not move. Within 20 degrees of a
        commissure its error fades into the other leaflet. The whole frame grows from the centre of
        its annulus. The valve must be sampled from a template (see `band_grid`).
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
        """Errors ``(k, 3)`` of the closed annulus and ``(t, 3)`` mm of the tips."""
        smooth = SpatialCorrelation(annulus, ANNULUS_LENGTH_MM).factor
        return (
            self.annulus_mm * (smooth @ rng.standard_normal(annulus.shape)),
            self.tips_mm * rng.standard_normal(tips.shape),
        )

    def seen(
        self, vertices: FloatArray, surface: LeafletSurface, rng: np.random.Generator
    ) -> FloatArray:
        """Vertices ``(n, 3)`` mm of the closed leaflets with outliers and a filled-in patch."""
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


def _off(share: float, rng: np.random.Generator) -> float:
    """A factor 1 + share, or its inverse."""
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
