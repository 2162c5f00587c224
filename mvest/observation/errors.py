"""Errors of a synthetic observation.

Each error is a frozen value that changes observed positions. Errors are applied one after another,
with one random generator; vertices that are not seen become NaN. A filter's assumptions about them
are configured separately.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from scipy.linalg import LinAlgError, cholesky
from scipy.spatial.distance import cdist

from mvest.errors import GeometryError, InputError, require_numbers
from mvest.estimation.noise import ObservationNoise, kronecker_noise
from mvest.estimation.spectrum import matern
from mvest.typing import BoolArray, FloatArray
from mvest.valve.anatomy.valve import LeafletSurface
from mvest.valve.geometry.proximity import closest_points

NUGGET = 1e-10
"""Uncorrelated share of the variance, so that the correlation of vertices that nearly coincide can
be factorised."""


ObservationError: TypeAlias = Callable[[FloatArray, FloatArray, np.random.Generator], FloatArray]
"""A function of positions ``(f, n, 3)`` mm with the errors so far, of the true positions, and of a
random generator; it returns new positions. If several frames are observed, the model's geometry is
that of the first."""


def observe(
    true: FloatArray, errors: Sequence[ObservationError], rng: np.random.Generator
) -> FloatArray:
    """Positions ``(f, n, 3)`` mm with all errors; NaN for vertices that are not seen."""
    seen = np.array(true, dtype=np.float64)
    for error in errors:
        seen = error(seen, true, rng)
    return seen


@dataclass(frozen=True, slots=True)
class WhiteNoise:
    """Independent normal noise of each coordinate of each vertex in each frame."""

    std: float  #: mm

    def __post_init__(self) -> None:
        require_numbers(self, "noise", "std", least=0)

    def __call__(self, seen: FloatArray, true: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Add the noise."""
        return seen + self.std * rng.standard_normal(seen.shape)


@dataclass(frozen=True, slots=True, eq=False)
class SpatialCorrelation:
    """Matérn correlation, of smoothness 3/2, between points of the leaflets at rest.

    `matern` of the straight distance; the fields are once differentiable. C(l) = 0.48.
    """

    points: FloatArray  #: (n, 3) mm, vertices at rest
    length: float  #: correlation length l, mm
    #: (n, n), lower triangular L with L Lᵀ = C and rows of length one; 3248 vertices take a second
    #: and 84 MB
    factor: FloatArray = field(init=False, repr=False)
    _parts: dict[bytes, SpatialCorrelation] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        points = np.asarray(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InputError(f"correlated points: shape {points.shape}, expected finite (n, 3)")
        require_numbers(self, "correlation", "length")
        object.__setattr__(self, "points", points)
        try:
            factor = cholesky(self.matrix(), lower=True, overwrite_a=True, check_finite=False)
        except LinAlgError as error:
            raise InputError(
                f"a correlation length of {self.length} mm is too long for {len(points)} vertices "
                f"so close together: the correlation cannot be factorised"
            ) from error
        factor.setflags(write=False)
        object.__setattr__(self, "factor", factor)

    def matrix(self) -> FloatArray:
        """C ``(n, n)``, with ones on the diagonal."""
        C = matern(cdist(self.points, self.points), self.length)
        C *= 1.0 - NUGGET
        np.fill_diagonal(C, 1.0)
        return C

    def of(self, members: BoolArray) -> SpatialCorrelation:
        """The correlation among some of the points; ``members (n,)``. Factorised once for each."""
        if members.all():
            return self
        key = members.tobytes()
        if key not in self._parts:
            self._parts[key] = SpatialCorrelation(self.points[members], self.length)
        return self._parts[key]

    def noise(self, variance: float, coordinates: int) -> ObservationNoise:
        """Noise of this correlation in ``coordinates`` of each point, stacked point by point."""
        return kronecker_noise(variance, self.factor, coordinates)


@dataclass(frozen=True, slots=True, eq=False)
class CorrelatedNoise:
    """Normal noise that is correlated between neighbouring vertices, as errors of tracking are.

    Coordinates and frames are independent.
    """

    std: float  #: mm, of each coordinate at every vertex
    correlation: SpatialCorrelation

    def __post_init__(self) -> None:
        require_numbers(self, "noise", "std", least=0)

    def __call__(self, seen: FloatArray, true: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Add the noise."""
        frames, n, _ = seen.shape
        if n != len(self.correlation.points):
            raise InputError(
                f"{n} vertices are seen, but the noise is of {len(self.correlation.points)}"
            )
        white = rng.standard_normal((n, frames, 3))
        noise = (self.correlation.factor @ white.reshape(n, -1)).reshape(white.shape)
        return seen + self.std * noise.transpose(1, 0, 2)


@dataclass(frozen=True, slots=True, eq=False)
class CoaptationDropout:
    """Vertices at which leaflets touch are not seen: an image does not separate them.

    A vertex is hidden in a frame in which it is nearer than ``distance`` to another leaflet, if it
    was not so near at rest. So the commissures, where leaflets are joined, stay visible.
    """

    distance: float  #: mm, between midsurfaces
    surface: LeafletSurface  #: at rest

    def __post_init__(self) -> None:
        require_numbers(self, "drop-out", "distance", least=0)

    def __call__(self, seen: FloatArray, true: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Hide the vertices."""
        joined = self._near(self.surface.vertices)
        hidden = np.array([self._near(frame) & ~joined for frame in true])
        if hidden.all(axis=1).any():
            raise GeometryError(
                f"drop-out within {self.distance} mm hides every vertex of a frame; "
                f"expected a smaller distance"
            )
        return np.where(hidden[:, :, None], np.nan, seen)

    def _near(self, vertices: FloatArray) -> BoolArray:
        """Which vertices ``(n,)`` are nearer than the distance to another leaflet."""
        surface = self.surface
        near = np.zeros(len(vertices), dtype=np.bool_)
        own = surface.vertex_region
        for region in range(len(surface.region_names)):
            others = np.flatnonzero(own != region)
            triangles = surface.triangles[surface.region == region]
            if others.size and len(triangles):
                closest = closest_points(vertices[others], vertices, triangles)
                near[others[closest.distance < self.distance]] = True
        return near


@dataclass(frozen=True, slots=True)
class AnnulusOffset:
    """The observed annulus is displaced against the leaflets in the closed frame.

    The model is bounded by the observed annulus, so that in its coordinates the leaflets (and the
    papillary tips, which are not observed) are displaced by ``offset``. The model's geometry comes
    from the open frame, which agrees with it.
    """

    #: (float, float, float), mm, of the leaflets against the annulus; in the template x runs
    #: between the commissures, y from posterior to anterior, z along the axis
    offset: tuple[float, float, float]

    def __post_init__(self) -> None:
        if len(self.offset) != 3 or not np.isfinite(self.offset).all():
            raise InputError(f"annulus offset {self.offset}, expected three finite numbers in mm")

    def __call__(self, seen: FloatArray, true: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Displace the closed frame, which is observed last."""
        moved = seen.copy()
        moved[-1] += self.offset
        return moved
