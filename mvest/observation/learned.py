"""What is believed of the errors of an observation before they are learned with the parameters.

What is stated of the errors of a case, a standard deviation and over which length they are alike,
is the median of a belief and no more: how smooth and how rough they are, each over which distance,
and how much larger in one frame than in another follows from the observation itself, together with
the parameters (see `mvest.estimation.noise` and `mvest.estimation.evidence`).
"""

from __future__ import annotations

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
"""Points over which where they are seen is averaged."""

FAR = 100.0
"""Lengths over which errors are alike that leaflets are moved apart, so that theirs are not."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorBeliefs:
    """How well the errors are known that a case states; factors are one standard deviation.

    The defaults are weak: twice or half as large or as far alike as stated is nothing unusual.

    Attributes
    ----------
    std_factor, length_factor : float
        Of the standard deviation that is stated, and of the length over which errors are alike.
    length_mm : float
        Median of that length where errors are stated to be independent.
    deviation : float
        Of errors that vary over one distance from what the two say of them.
    other_share : float
        Median of the part of which nothing is stated, as a share of the stated standard deviation:
        the rough part where errors are alike, the smooth part where they are not.
    other_factor : float
        Of that part.
    frame_factor : float
        Of each frame before the last, against what is stated of it.
    resolution_mm : float
        Standard deviation below which no single point is believed: finer are neither meshes nor
        images, and errors without any roughness have no end of detail from which to learn.
    """

    std_factor: Factor = 2.0
    length_factor: Factor = 2.0
    length_mm: Length = 10.0
    deviation: Factor = 1.65
    other_share: Share = 0.2
    other_factor: Factor = 3.0
    frame_factor: Factor = 1.5
    resolution_mm: Length = 0.02

    def __post_init__(self) -> None:
        factors = "std_factor", "length_factor", "deviation", "other_factor", "frame_factor"
        require_numbers(self, "errors", *factors, least=1)
        require_numbers(self, "errors", "length_mm", "other_share")
        require_numbers(self, "errors", "resolution_mm", least=0)

    def parts(self, std: float, length: float) -> tuple[LogNormal, LogNormal, LogNormal]:
        """Smooth part, its length, and rough part of errors that are stated; all in mm."""
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
    """The noise of an observation as it is to be learned.

    Parameters
    ----------
    observation : Observation or SurfaceObservation
        Its standard deviations are what is stated, per vertex and frame; not its correlation.
    beliefs : ErrorBeliefs
    length : float
        mm, over which errors are stated to be alike; 0: independent.
    points : (n, 3) mm, optional
        Vertices at rest, of an observation whose vertices correspond.
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
        parts = [
            (
                seen.frame,
                _averaged(seen.apart(FAR * (length or beliefs.length_mm))),
                np.ones(len(seen.points)) if seen.scale is None else seen.scale,
                observation.size_of(seen) - len(seen.points),
            )
            for seen in observation.seen
        ]
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


def _averaged(points: FloatArray) -> FloatArray:
    """Points, each the mean of those about it.

    Where points are seen their own errors are in it, which along the normal are then a linear
    function of where they are: nothing would be as smooth.
    """
    near = cKDTree(points).query(points, min(NEIGHBOURS, len(points)))[1]
    return np.asarray(points[near].reshape(len(points), -1, 3).mean(axis=1))
