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
        stated, coordinates = float(stds[-1]), 3
        scale = np.ones(len(points)) if observation.scale is None else observation.scale
        parts = [
            (frame, points[seen], scale[seen] * own / stds[-1], 0)
            for frame, seen, own in zip(observation.frames, observation.seen, stds, strict=True)
        ]
    else:
        stated, coordinates = observation.std_mm, 1
        parts = []
        for seen in observation.seen:
            at, q = seen.apart(FAR * (length or beliefs.length_mm)), len(seen.points)
            # A point's own error is part of its position; means of neighbours hardly contain it.
            near = cKDTree(at).query(at, min(NEIGHBOURS, q))[1]
            scale = np.ones(q) if seen.scale is None else seen.scale
            parts.append((seen.frame, at[near].reshape(q, -1, 3).mean(1), scale, seen.size - q))
    smooth, far, rough = beliefs.parts(stated, length)
    spectrum = Spectrum(smooth, far, beliefs.deviation)
    quantities: dict[str, LogNormal] = {}
    blocks, bands = [], None
    for frame, at, scale, curves in parts:
        own = []
        if len(at):
            basis = smooth_basis(at, spectrum.reference_length)
            own.append(NoiseBlock(ROUGH, scale, coordinates, basis))
            quantities[ROUGH] = rough
            bands = bands or spectrum.prior(at)
        if curves:
            own.append(NoiseBlock(CURVES, np.ones(curves)))
            quantities[CURVES] = LogNormal(stated, beliefs.std_factor)
        if own and frame != parts[-1][0]:
            name = f"frame {frame}"
            own = [replace(block, frame=name) for block in own]
            quantities[name] = LogNormal(1.0, beliefs.frame_factor)
        blocks += own
    return NoiseFamily(tuple(blocks), quantities, bands, beliefs.resolution_mm)
