"""What a run computed of one case: the values that its page, tables and figures show.

Lengths are in mm, moduli in MPa, intervals hold 95 %; ``p`` counts the unknowns that are estimated
or considered. What a run did not compute is None or empty, so that a page can say so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mvest.problem.verdict import NONE, Verdict
from mvest.reporting.findings import Identified, Innovation, Spread, Vector

__all__ = ["About", "CaseFindings", "Cost", "ErrorRow", "FrameDistances", "GeometryRow",
           "ImageErrors", "ImageStep", "ModuliAlone", "ModulusRow", "Narrower", "Picture",
           "PosteriorCheck", "ToTruth", "UnknownRow", "VolumeAbout", "WhitenessTest"]  # fmt: skip

MODULUS, NUISANCE = "modulus", "nuisance"
"""Kinds of an unknown."""


@dataclass(frozen=True, slots=True)
class About:
    """What a case says of itself.

    ``derived`` are sentences on what was not given, ``doubts`` on what is hardly so.
    """

    name: str
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = False
    derived: tuple[str, ...] = ()
    sha256: str = ""
    regions: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class UnknownRow:
    """What is known of an unknown before and after the estimation, in its unit.

    Its kind is ``modulus`` or ``nuisance``; it was ``estimated``, ``considered`` or ``fixed``.
    The truth is known of simulated valves.
    """

    name: str
    label: str
    unit: str
    kind: str
    treatment: str
    prior_mean: float
    prior_std: float
    estimate: float | None = None
    std: float | None = None
    low: float | None = None
    high: float | None = None
    truth: float | None = None

    @property
    def leaflet(self) -> str:
        """Of a modulus; ``E_f.anterior`` is of the anterior one."""
        return self.name.partition(".")[2]

    @property
    def is_modulus(self) -> bool:
        """Whether it is a modulus of a leaflet."""
        return self.kind == MODULUS

    @property
    def inside(self) -> bool | None:
        """Whether the interval contains the truth; None where one of them is not known."""
        if self.low is None or self.high is None or self.truth is None:
            return None
        return self.low <= self.truth <= self.high


@dataclass(frozen=True, slots=True, kw_only=True)
class ModulusRow:
    """A modulus of a leaflet, estimated or following from one that is."""

    region: str
    name: str
    estimate: float
    std: float
    low: float
    high: float
    truth: float | None = None


@dataclass(frozen=True, slots=True)
class ModuliAlone:
    """An estimation of the moduli with everything else taken as known."""

    converged: bool
    reason: str
    detail: str
    forward_solves: int
    parameters: tuple[UnknownRow, ...]
    distance_mm: Spread | None = None


@dataclass(frozen=True, slots=True)
class ToTruth:
    """Distances of the models from where a simulated valve truly was."""

    generic: Spread
    registered: Spread
    personalised: Spread


@dataclass(frozen=True, slots=True)
class FrameDistances:
    """Distances of the models from a frame as it was observed, which the filter saw or not.

    Models as in `mvest.personalisation.result.FrameDistance`.
    """

    frame: str
    seen: bool
    generic: Spread
    registered: Spread
    personalised: Spread
    to_truth: ToTruth | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorRow:
    """What was learned of the errors of the observed frame, beside what was believed before.

    In ``unit``, or a factor if that is empty. It was moved by ``stretch`` standard deviations of
    what was believed.
    """

    name: str
    unit: str
    believed: float
    believed_low: float
    believed_high: float
    learned: float
    low: float
    high: float
    stretch: float


@dataclass(frozen=True, slots=True)
class GeometryRow:
    """By how much one kind of a geometry is expected to differ from what was seen.

    Root of the mean square in ``unit``; the mode that is moved most, by ``stretch`` standard
    deviations. See `mvest.personalisation.expected.GeometryShift`.
    """

    name: str
    unit: str
    size: float
    stretch: float


@dataclass(frozen=True, slots=True)
class WhitenessTest:
    """A test of the standardised innovation."""

    name: str
    statistic: float
    p_value: float
    verdict: str


@dataclass(frozen=True, slots=True)
class PosteriorCheck:
    """How far two things differ that are alike in a Gaussian posterior, and how far they may.

    See `mvest.estimation.check`; of several the one that is furthest beyond its limit. The value is
    None where it could not be told.
    """

    compared: str
    value: float | None
    limit: float

    @property
    def holds(self) -> bool:
        """Whether the interval means what it says."""
        return self.value is not None and self.value <= self.limit


@dataclass(frozen=True, slots=True)
class Narrower:
    """What knowing something more would do to the SD of the logarithm of a modulus."""

    what: str
    parameter: str
    std_now: float
    std_if_known: float


@dataclass(frozen=True, slots=True)
class ImageErrors:
    """What errors of the frames that the model was built from do to the estimate.

    Of each modulus the share of the variance of its logarithm; None where they did not enter.
    """

    samples: int
    share_of_variance: Mapping[str, float] | None = None


@dataclass(frozen=True, slots=True)
class Cost:
    """SD of a modulus' logarithm if a part of what is not known were, and if it were all there is.

    See `mvest.personalisation.error_budget`.
    """

    part: str
    modulus: str
    without: float
    alone: float


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture that lies beside the page."""

    file: str
    caption: str


@dataclass(frozen=True, slots=True)
class VolumeAbout:
    """A volume over time: frames and voxels ``(4,)``, spacing ``(3,)``."""

    source: str
    sha256: str
    modality: str
    shape: tuple[int, ...]
    spacing_mm: Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageStep:
    """How a case came from the ``f`` frames of a volume.

    Of each frame there are measures by name and the confidence ``(f,)``; of an observed coordinate
    the error's SD, and over which length it is alike. ``unlike`` says how the volume is unlike
    those that detectors were trained on; empty where it is not.
    """

    pictures: Mapping[str, Picture]
    sentences: tuple[str, ...]
    frames: tuple[Mapping[str, Any], ...]
    files: tuple[str, ...]
    model: Mapping[str, Any]
    volume: VolumeAbout
    open_frame: int
    closed_frame: int
    confidence: Vector
    std_mm: float
    correlation_length_mm: float
    unlike: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseFindings:
    """All that a run computed of a case, and why its estimation ended.

    Attributes
    ----------
    correlation : (p, p)
        Of the errors of the unknowns, in the coordinates of the filter; empty without an estimate.
    moduli : tuple of ModulusRow
        All that follow from the estimated ones through fixed ratios.
    iterates, iterate_std : (i, p)
    objective : (i,)
        None where a prediction failed.
    errors : tuple of ErrorRow
        Empty where errors were taken as they are stated.
    geometry : tuple of GeometryRow
        Empty where it was taken as it was seen.
    law_share : float or None
        How far the tissue is expected to be on its way from the linear law to an exponential one;
        None where only the first was considered.
    observation_std_mm : float or None
        Of an observed coordinate, as stated.
    measurements : mapping
        Frame -> ``observed``, ``generic`` or ``personalised`` -> measurement -> value.
    confirmed_mm : float or None
        Largest distance of the fitted closed valve from the one closed anew.
    verdict : Verdict or None
        How far the estimate may be believed; None where it was not judged.
    posterior : PosteriorCheck or None
        None where it was not checked.
    """

    about: About
    converged: bool
    reason: str
    unknowns: tuple[UnknownRow, ...] = ()
    correlation: tuple[Vector, ...] = ()
    moduli: tuple[ModulusRow, ...] = ()
    without_nuisances: ModuliAlone | None = None
    as_in_the_paper: ModuliAlone | None = None
    distances: tuple[FrameDistances, ...] = ()
    iterates: tuple[Vector, ...] = ()
    iterate_std: tuple[Vector, ...] = ()
    objective: tuple[float | None, ...] = ()
    innovation: Innovation | None = None
    whiteness: tuple[WhitenessTest, ...] = ()
    errors: tuple[ErrorRow, ...] = ()
    geometry: tuple[GeometryRow, ...] = ()
    law_share: float | None = None
    identifiability: Identified | None = None
    observation_std_mm: float | None = None
    narrow: tuple[Narrower, ...] = ()
    image_errors: ImageErrors | None = None
    budget: tuple[Cost, ...] = ()
    measurements: Mapping[str, Mapping[str, Mapping[str, float | None]]] = field(
        default_factory=dict
    )
    confirmed_mm: float | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    image_step: ImageStep | None = None
    verdict: Verdict | None = None
    posterior: PosteriorCheck | None = None

    @property
    def title(self) -> str:
        """What a page of it is called."""
        return self.about.description or self.about.name

    @property
    def is_stated(self) -> bool:
        """Whether its moduli may be stated: the verdict is not that there are none."""
        return self.converged and (self.verdict is None or self.verdict.trust != NONE)

    @property
    def status(self) -> str:
        """``converged`` or ``failed``."""
        return "converged" if self.converged else "failed"
