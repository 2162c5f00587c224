"""Prior of the errors of an observation, which are learned with the parameters.

The standard deviation and the correlation length that a case states are medians of this prior. How
smooth and how rough the errors are, over which distance, and how much larger in one frame than in
another follows from the observation itself (see `mvest.estimation.noise` and
`mvest.estimation.evidence`).
"""

from dataclasses import dataclass, replace

import numpy as np

from mvest.errors import InputError, require_numbers
from mvest.estimation.noise import NoiseBlock, NoiseFamily
from mvest.estimation.spectrum import LogNormal, Spectrum, smooth_basis
from mvest.observation.surfaces import SurfaceObservation
from mvest.observation.vertices import Observation
from mvest.quantities import Factor, Length, Share
from mvest.typing import FloatArray

ROUGH, CURVES = "rough part", "curves"
"""Names of the standard deviations of the rough part and of the points of curves."""

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
    shape: FloatArray | None = None,
) -> NoiseFamily:
    """The noise of an observation, to be learned.

    Parameters
    ----------
    observation : Observation or SurfaceObservation
        States the standard deviations, per vertex and frame; its correlation is not used.
    beliefs : ErrorBeliefs
    length : float
        mm, stated correlation length; 0: independent.
    shape : (n, 3) or (f, n, 3) mm
        Where errors are correlated. For corresponding vertices: all vertices at rest. For surfaces:
        the observed frames of a valve near them, on which errors are correlated over the places
        nearest to the points. The points themselves contain their errors: on a flat leaflet the
        height of a point is its error, and a smooth function of its position. None for surfaces:
        the points themselves.
    """
    if isinstance(observation, Observation):
        if shape is None or shape.shape != observation.positions.shape[1:]:
            raise InputError("errors of corresponding vertices need all vertices at rest")
        stds = np.sqrt(observation.variance)
        stated = float(stds[-1])
        scale = np.ones(len(shape)) if observation.scale is None else observation.scale
        parts = [
            (frame, ROUGH, shape[seen], scale[seen] * own / stds[-1], 3)
            for frame, seen, own in zip(observation.frames, observation.seen, stds, strict=True)
        ]
    else:
        stated, parts = observation.std_mm, []
        places = observation.places(FAR * (length or beliefs.length_mm), shape)
        for seen, (at, edge) in zip(observation.seen, places, strict=True):
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
