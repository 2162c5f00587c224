"""The parameters of the mechanics: their names, units and ranges.

A name is ``KIND`` or ``KIND.PART``. The part is a leaflet of the valve, a family of chordae, a
papillary tip, or the leaflet and number of a mode. Each law lists the kinds that it has
(:attr:`mvest.mechanics.law.Law.kinds`).
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from mvest.errors import InputError


class NamePart(Enum):
    """Meaning of the second part of a name."""

    NONE = ""
    REGION = "REGION"
    CHORDS = "FAMILY or tipN"
    MODE = "REGION.K"


class Kind(NamedTuple):
    """One kind of parameter."""

    unit: str  #: empty if dimensionless
    part: NamePart
    #: range that a configuration may use
    low: float
    high: float
    description: str
    positive: bool = True  #: whether it is positive, so that its logarithm is estimated

    @property
    def whole(self) -> bool:
        """Whether the name without a part exists, for the whole valve."""
        return self.part in (NamePart.NONE, NamePart.CHORDS)


_REGION, _CHORDS = NamePart.REGION, NamePart.CHORDS

KINDS: dict[str, Kind] = {
    "E_f": Kind("MPa", _REGION, 1e-6, 1e4, "Young's modulus along the fibre"),
    "field": Kind(
        "", NamePart.MODE, -10, 10, "coefficient of a mode of log E_f within a leaflet", False
    ),
    "pressure_scale": Kind("", NamePart.NONE, 0, 100, "factor on the pressure"),
    "chord_stiffness": Kind("", _CHORDS, 0, 100, "factor on the axial stiffness"),
    "chord_rest_length": Kind("", _CHORDS, 0, 100, "factor on the rest length"),
    "damping": Kind("s", NamePart.NONE, 0, 1e3, "stiffness-proportional part of the damping"),
    "c0": Kind("MPa", _REGION, 1e-6, 1e4, "scale of the exponential law"),
    "c1": Kind("", _REGION, 0, 1e5, "its exponent of the isochoric deformation"),
    "c2": Kind("", _REGION, 0, 1e5, "its exponent of the fibres' stretch"),
    "mu": Kind("MPa", _REGION, 1e-6, 1e4, "its shear modulus at rest"),
    "kappa": Kind("MPa", _REGION, 1e-6, 1e4, "its bulk modulus"),
    "stiffening": Kind(
        "", _REGION, 0, 1e6, "share of the exponential law over that of the linear one"
    ),
    "prestretch": Kind("", _REGION, 0, 5, "length of the open leaflet over that free of stress"),
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter: its name and its current value.

    Names are made of ``KINDS``: for example ``E_f.REGION`` (MPa; the region's other moduli are
    proportional), ``field.REGION.K``, ``pressure_scale`` or ``chord_stiffness.FAMILY`` (factors).
    """

    name: str
    value: float

    @property
    def kind(self) -> str:
        """The name without its part."""
        return self.name.partition(".")[0]

    @property
    def part(self) -> str:
        """The part, empty for parameters of the whole valve."""
        return self.name.partition(".")[2]

    @property
    def region(self) -> str:
        """The part without the number of a mode."""
        return self.part.rpartition(".")[0] if self.kind == "field" else self.part

    @property
    def mode(self) -> int:
        """Number of the mode of a field; -1 if the name has none."""
        number = self.part.rpartition(".")[2]
        return int(number) if self.kind == "field" and number.isdecimal() else -1

    def require(self, kinds: Collection[str]) -> None:
        """Raise InputError unless the parameter is of one of a law's kinds."""
        if self.kind not in kinds:
            known = known_names(kinds) if kinds else "none"
            raise InputError(f"parameter {self.name!r}: the law of its leaflet knows {known}")


def known_names(kinds: Iterable[str] = ()) -> str:
    """The names of all or of some kinds, as text."""
    words = []
    for kind in kinds or KINDS:
        known = KINDS[kind]
        words += [kind] if known.whole else []
        words += [f"{kind}.{known.part.value}"] if known.part is not NamePart.NONE else []
    return ", ".join(words)


def kind_of(name: str) -> Kind:
    """The kind of the parameter ``name``; InputError if it is none or has a wrong part."""
    kind, _, part = name.partition(".")
    known = KINDS.get(kind)
    fits = known is not None and (
        known.part is not NamePart.NONE if part else known.whole and name == kind
    )
    if known is None or not fits:
        raise InputError(f"unknown parameter {name!r}; known: {known_names()}")
    return known


def is_positive(name: str) -> bool:
    """Whether parameter ``name`` is positive; InputError if there is no such parameter."""
    return kind_of(name).positive
