"""Settings of the mechanics: tissue, closure protocol, contact and numerics."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np
from scipy.interpolate import PchipInterpolator

from mvest.errors import InputError, MaterialError, require_numbers
from mvest.mechanics.law.moduli import PoissonReading, TransverselyIsotropic
from mvest.mechanics.steps import Damping, NewtonSettings, Step
from mvest.quantities import (
    BeatTime,
    Count,
    Density,
    Factor,
    LawExponent,
    Length,
    Logarithm,
    Modulus,
    Place,
    PoissonRatio,
    Pressure,
    Ratio,
    Share,
    Stiffening,
    Stiffness,
    Stretch,
    Thicknesses,
    TimeStep,
)
from mvest.typing import FloatArray


def smooth_step(u: float) -> float:
    """Quintic from 0 at ``u <= 0`` to 1 at ``u >= 1`` whose first two derivatives vanish there."""
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10 - 15 * u + 6 * u * u)


@dataclass(frozen=True, slots=True)
class ExponentialTissue:
    """Coefficients of one region.

    MaterialError if a coefficient is not positive (c1, c2 and viscous may be zero).
    """

    c0: Modulus  #: MPa, scale of the exponential
    #: exponents of the isochoric deformation and of the fibres
    c1: LawExponent
    c2: LawExponent
    #: MPa, shear modulus at rest. The default is a third of the Young's modulus of 0.06 MPa of
    #: excised leaflets before they stiffen (Krishnamurthy et al. 2009, J. Biomech. 42:1909).
    mu: Modulus = 0.02
    kappa: Modulus = 5.0  #: MPa, bulk modulus
    viscous: Modulus = 2.0  #: MPa, viscous stiffness of the damping

    def __post_init__(self) -> None:
        for each in fields(self):
            value = float(getattr(self, each.name))
            may_be_zero = each.name in ("c1", "c2", "viscous")
            if not np.isfinite(value) or value < 0 or (value == 0 and not may_be_zero):
                raise MaterialError(
                    f"{each.name} = {value} of the exponential law, expected "
                    f"{'>= 0' if may_be_zero else '> 0'}"
                )


EXPONENTIAL_KINDS = ("c0", "c1", "c2", "mu", "kappa")
"""Coefficients that can be parameters."""


@dataclass(frozen=True, slots=True)
class TissueSettings:
    """Material of one region. Parameters of an estimate override these values."""

    ratio: Ratio  #: E_f over E_perp
    nu: PoissonRatio = 0.488  #: Poisson ratio of the paper
    #: modulus along the fibres in compression over that in tension; 1: the paper's linear law
    #: (:mod:`mvest.mechanics.law.biot`); not with the corotational law
    compression: Share = 1.0
    toe: Share = 0.02  #: strain of the fibres up to which they straighten, if that is below 1
    reading: str = "A"  #: ``A`` or ``C`` (see :class:`mvest.mechanics.law.moduli.PoissonReading`)
    #: ``biot``: the linear law, with all of the above. ``corotational``: its usual form on linear
    #: tetrahedra (:mod:`mvest.mechanics.law.biot`). ``exponential``
    #: (:mod:`mvest.mechanics.law.exponential`). ``stiffening``: a blend of linear and exponential.
    law: str = "biot"
    #: coefficients of the exponential law; a modulus E_f replaces their common scale
    exponential: ExponentialTissue | None = None
    #: share of the exponential law over that of the linear one in a blend
    stiffening: Stiffening = 0.0
    #: stretch of the imaged open leaflet along its fibres relative to its stress-free state
    #: (:mod:`mvest.mechanics.law.regional`); not with the corotational law
    prestretch: Stretch = 1.0
    prestretch_ratio: Ratio = 1.0  #: stretch across the fibres over that along them

    def __post_init__(self) -> None:
        if self.law not in ("biot", "corotational", "exponential", "stiffening"):
            raise InputError(
                f"law of a tissue = {self.law!r}, expected biot, corotational, exponential or "
                "stiffening"
            )
        if self.law in ("exponential", "stiffening") and self.exponential is None:
            raise InputError(f"law of a tissue = {self.law!r}: its coefficients are missing")
        require_numbers(self, "tissue", "stiffening", least=0)
        require_numbers(self, "tissue", "compression", "toe", "prestretch", "prestretch_ratio")
        if self.law == "corotational":
            for name in ("prestretch", "prestretch_ratio", "compression"):
                if getattr(self, name) != 1.0:
                    raise InputError(f"{name} of a tissue: the corotational law has none")
        known = [reading.value for reading in PoissonReading]
        if self.reading not in known:
            raise InputError(
                f"Poisson reading = {self.reading!r}, expected one of {', '.join(known)}"
            )

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the parameters of the tissue."""
        kinds = {"exponential": ("E_f", *EXPONENTIAL_KINDS), "stiffening": ("E_f", "stiffening")}
        own = kinds.get(self.law, ("E_f",))
        return own if self.law == "corotational" else (*own, "prestretch")

    def coefficients(self, values: Mapping[str, float]) -> ExponentialTissue:
        """Coefficients of the exponential law with some values (by kind) replaced."""
        if self.exponential is None:
            raise InputError("the tissue has no coefficients of the exponential law")
        return replace(self.exponential, **values)

    def material(self, E_f: float) -> TransverselyIsotropic:
        """The material with Young's modulus ``E_f`` (MPa) along the fibre."""
        reading = PoissonReading(self.reading)
        linear = TransverselyIsotropic.from_ratio(E_f, self.ratio, self.nu, reading)
        return replace(linear, compression=self.compression, toe=self.toe)


@dataclass(frozen=True, slots=True)
class ModulusField:
    """Prior of the variation of the modulus within a leaflet."""

    correlation_length_mm: Length  #: l of the squared exponential covariance
    std_log: Logarithm  #: standard deviation of log E_f at a point
    modes: Count  #: number of modes

    def __post_init__(self) -> None:
        require_numbers(self, "field", "correlation_length_mm", "std_log")
        require_numbers(self, "field", "modes", least=1)


@dataclass(frozen=True, slots=True)
class StiffPatch:
    """Tissue of different stiffness around a point of a leaflet.

    ``log E_f`` is raised by ``log(factor) (1 - d^2 / radius^2)^2`` at distances d in the reference
    frame below ``radius``.
    """

    region: str
    centre: tuple[Place, ...]  #: ``(x, y, z)`` mm in the reference frame
    radius_mm: Length
    factor: Factor  #: on the stiffness at the centre

    def __post_init__(self) -> None:
        if len(self.centre) != 3 or not np.all(np.isfinite(self.centre)):
            raise InputError(f"centre of a patch {self.centre}, expected (x, y, z) mm")
        require_numbers(self, "patch", "radius_mm", "factor")

    def log_scale(self, points: FloatArray) -> FloatArray:
        """Increase of log E_f ``(...)`` at points ``(..., 3)`` mm of the reference frame."""
        d2 = np.sum((points - np.asarray(self.centre)) ** 2, axis=-1) / self.radius_mm**2
        return np.asarray(np.log(self.factor) * np.maximum(1 - d2, 0.0) ** 2)


@dataclass(frozen=True, slots=True)
class ClosureProtocol:
    """The course of a closure."""

    pressure_mmHg: Pressure = 120.0  #: peak transmitral pressure
    ramp: BeatTime = 0.3  #: s over which pressure and boundary motion rise (smooth step)
    #: s, time step during the ramp. A unique closed state does not depend on it (the gate divides
    #: it by up to 16), so that by default the ramp is one step.
    dt: TimeStep = 0.3
    growth: Factor = 1.5  #: growth factor of the steps after the ramp
    end: BeatTime = 0.5  #: s, end of the dynamic phase
    equilibrium: bool = True  #: whether a static step to exact equilibrium follows
    #: tuple of (s, share), pressure over its peak at increasing times, a monotone cubic in between
    #: and constant outside. If empty, the pressure rises with the motion of the boundary.
    curve: tuple[tuple[Factor, ...], ...] = ()

    def __post_init__(self) -> None:
        if not self.dt > 0:
            raise InputError(f"time step dt = {self.dt} s, expected > 0")
        if not np.isfinite(self.pressure_mmHg):
            raise InputError(f"pressure {self.pressure_mmHg} mmHg, expected a finite number")
        if not (self.ramp > 0 and self.end >= self.ramp and self.growth >= 1):
            raise InputError(f"closure protocol {self}: expected 0 < ramp <= end and growth >= 1")
        times = [row[0] for row in self.curve if len(row) == 2]
        pairs = len(times) == len(self.curve) and len(times) != 1
        if not pairs or np.any(np.diff(times) <= 0) or not np.isfinite(self.curve).all():
            raise InputError(
                f"pressure curve {self.curve}: expected two or more (s, share), increasing in time"
            )

    def steps(self) -> tuple[Step, ...]:
        """The time steps."""
        n = max(1, round(self.ramp / self.dt))
        times = [self.ramp * (k + 1) / n for k in range(n)]
        dt = self.ramp / n
        while times[-1] < self.end * (1 - 1e-9):
            dt *= self.growth
            times.append(min(times[-1] + dt, self.end))
        steps = [Step(t) for t in times]
        if self.equilibrium:
            steps.append(Step(times[-1] + 1.0, static=True))
        return tuple(steps)

    def phase(self, t: float) -> float:
        """Share of the closure at time ``t``: quintic smooth step over the ramp."""
        return smooth_step(t / self.ramp)

    def pressure(self, t: float) -> float:
        """Pressure (mmHg) at time ``t``."""
        if not self.curve:
            return self.pressure_mmHg * self.phase(t)
        times, shares = np.transpose(self.curve)
        share = PchipInterpolator(times, shares)(np.clip(t, times[0], times[-1]))
        return self.pressure_mmHg * float(share)


@dataclass(frozen=True, slots=True)
class ContactSettings:
    """The contact law."""

    reference_pressure: Modulus = 0.016  #: contact pressure p0 (MPa) at the reference distance
    reference_distance: Thicknesses = 1.2  #: c0, midsurface distance at p0 over the thickness
    #: c_h, midsurface distance at which contact begins, over the thickness
    activation_distance: Thicknesses = 2.0
    active: bool = True  #: without contact leaflets pass through each other

    def __post_init__(self) -> None:
        if not self.reference_pressure > 0:
            raise InputError(f"contact reference_pressure {self.reference_pressure}, expected > 0")
        if not 0 < self.reference_distance < self.activation_distance:
            raise InputError(
                f"contact distances: reference {self.reference_distance}, activation "
                f"{self.activation_distance}; expected 0 < reference < activation"
            )


@dataclass(frozen=True, slots=True)
class Relaxation:
    """The valve at the end of isovolumic relaxation, whose leaflets are free of stress.

    From there leaflets in vivo were found to be linear (Krishnamurthy et al. 2009, J. Biomech.
    42:1909). No frame is needed: the shape is that of the closed valve, of leaflets free of stress
    when open, unloaded to the smallest pressure at which they still touch. It is the same for all
    parameters of an estimate.
    """

    E_f: dict[str, Modulus]  #: region -> modulus (MPa) with which that valve closes
    pressure_mmHg: Pressure = 10.0  #: the default template opens between 10 and 5 mmHg

    def __post_init__(self) -> None:
        require_numbers(self, "relaxation", "pressure_mmHg")


@dataclass(frozen=True, slots=True)
class MechanicsSettings:
    """All settings of the mechanics except valve, mesh and parameters."""

    tissue: dict[str, TissueSettings]  #: region name -> :class:`TissueSettings`
    #: see their classes
    protocol: ClosureProtocol = field(default_factory=ClosureProtocol)
    damping: Damping = field(default_factory=Damping)
    newton: NewtonSettings = field(default_factory=NewtonSettings)
    contact: ContactSettings = field(default_factory=ContactSettings)
    density: Density = 1.04e-9  #: t/mm^3
    support: str = "hinge"  #: ``hinge`` (thickness-averaged annulus) or ``clamp`` (both faces)
    support_stiffness: Stiffness = 50.0  #: N/mm per mm of annulus
    #: mm, radius of the patch over which a chord is spread at its insertion
    patch_radius: Length = 2.0
    solver: str = "auto"
    #: region name -> :class:`ModulusField` of a varying modulus. Missing coefficients
    #: ``field.REGION.K`` are 0.
    fields: dict[str, ModulusField] = field(default_factory=dict)
    #: any name -> :class:`StiffPatch`, for simulations
    patches: dict[str, StiffPatch] = field(default_factory=dict)
    #: the shape that is free of stress; None: that of the mesh
    relaxation: Relaxation | None = None

    def __post_init__(self) -> None:
        require_numbers(self, "mechanics", "density", "support_stiffness", "patch_radius")
        if self.support not in ("hinge", "clamp"):
            raise InputError(f"annulus support {self.support!r}, expected hinge or clamp")
        if self.relaxation and any(own.law == "corotational" for own in self.tissue.values()):
            raise InputError("relaxation of mechanics: the corotational law has none")
