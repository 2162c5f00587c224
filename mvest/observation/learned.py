"""Prior of the errors of an observation, which are learned with the parameters.

The standard deviation and the correlation length that a case states are medians of this prior. How
smooth and how rough the errors are, over which distance, and how much larger in one frame than in
another follows from the observation itself (see `mvest.estimation.noise` and
`mvest.estimation.evidence`).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mvest.errors import InputError, require_numbers
from mvest.estimation.noise import NoiseBlock, NoiseFamily
from mvest.estimation.spectrum import LogNormal, Spectrum, smooth_basis
from mvest.observation.surfaces import SurfaceObservation
from mvest.observation.vertices import Observation
from mvest.quantities import Factor, Length, Share
from mvest.typing import FloatArray

ROUGH, CURVES = "rough part", "curves"
"""Names of the standard deviations of the rough part and of the points of curves."""

NEIGHBOURS = 12
"""Neighbouring points over which positions are averaged."""

FAR = 100.0
"""Correlation lengths by which leaflets are moved apart, so that their errors are independent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorBeliefs:
    """Uncertainty of the stated errors; factors are one standard deviation.

    The defaults are weak: twice or half the stated size or length is not unusual.
    """

    #: of the stated standard deviation and correlation length
    std_factor: Factor = 2.0
    length_factor: Factor = 2.0
    #: median correlation length of errors that are stated to be independent
    length_mm: Length = 10.0
    deviation: Factor = 1.65  #: of a single band from the spectrum of the two
    #: median of the part that is not stated, as a share of the stated standard deviation: the rough
    #: part of correlated errors, the smooth part of independent ones
    other_share: Share = 0.2
    other_factor: Factor = 3.0  #: of that part
    frame_factor: Factor = 1.5  #: of each frame before the last, relative to its stated errors
    #: smallest standard deviation of a single point: neither meshes nor images are finer, and
    #: errors without any roughness would teach from infinite detail
    resolution_mm: Length = 0.02

    def __post_init__(self) -> None:
        factors = "std_factor", "length_factor", "deviation", "other_factor", "frame_factor"
        require_numbers(self, "errors", *factors, least=1)
        require_numbers(self, "errors", "length_mm", "other_share")
        require_numbers(self, "errors", "resolution_mm", least=0)

    def parts(self, std: float, length: float) -> tuple[LogNormal, LogNormal, LogNormal]:
        """Smooth part, its length, and rough part of stated errors; all in mm."""
        stated = LogNormal(std, self.std_factor)
        other = LogNormal(self.other_share * std, self.other_factor)
        smooth, rough = (stated, other) if length > 0.0 else (other, stated)
        return smooth, LogNormal(length or self.length_mm, self.length_factor), rough


def error_family(
    observation: Observation | SurfaceObservation,
    beliefs: ErrorBeliefs,
    length: float,
    points: FloatArray | None = None,
) -> NoiseFamily:
    """The noise of an observation, to be learned.

    Parameters
    ----------
    observation : Observation or SurfaceObservation
        States the standard deviations, per vertex and frame; its correlation is not used.
    beliefs : ErrorBeliefs
    length : float
        mm, stated correlation length; 0: independent.
    points : (n, 3) mm, optional
        Vertices at rest, for corresponding vertices.
    """
    if isinstance(observation, Observation):
        if points is None or points.shape != observation.positions.shape[1:]:
            raise InputError("errors of corresponding vertices need all vertices at rest")
        stds = np.sqrt(observation.variance)
        stated = float(stds[-1])
        scale = np.ones(len(points)) if observation.scale is None else observation.scale
        parts = [
            (frame, ROUGH, points[seen], scale[seen] * own / stds[-1], 3)
            for frame, seen, own in zip(observation.frames, observation.seen, stds, strict=True)
        ]
    else:
        stated, parts = observation.std_mm, []
        for seen in observation.seen:
            at, edge = map(_averaged, seen.apart(FAR * (length or beliefs.length_mm)))
            scale = np.ones(len(at)) if seen.scale is None else seen.scale
            parts += [(seen.frame, ROUGH, at, scale, 1)] * (len(at) > 0)
            parts += [(seen.frame, CURVES, edge, np.ones(len(edge)), 2)] * (len(edge) > 0)
    smooth, far, rough = beliefs.parts(stated, length)
    spectrum = Spectrum(smooth, far, beliefs.deviation)
    quantities: dict[str, LogNormal] = {}
    blocks, bands = [], None
    for frame, kind, at, scale, coordinates in parts:
        block = NoiseBlock(kind, scale, coordinates, smooth_basis(at, spectrum.reference_length))
        quantities[kind] = rough
        bands = bands or spectrum.prior(at)
        if frame != parts[-1][0]:
            block = replace(block, frame=f"frame {frame}")
            quantities[f"frame {frame}"] = LogNormal(1.0, beliefs.frame_factor)
        blocks.append(block)
    return NoiseFamily(tuple(blocks), quantities, bands, beliefs.resolution_mm)


def _averaged(points: FloatArray) -> FloatArray:
    """Means over neighbours: a point's own error is part of its position, and hardly of these."""
    if not len(points):
        return points
    near = cKDTree(points).query(points, min(NEIGHBOURS, len(points)))[1]
    return np.asarray(points[near.reshape(len(points), -1)].mean(axis=1))
