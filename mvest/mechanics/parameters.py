"""What the mechanics can be differentiated by: the names, their units, which are positive.

A name is ``KIND`` or ``KIND.PART``: the part is a leaflet of the valve, a family of chordae, a
papillary tip, or the leaflet and number of a mode. This is the one place that knows them; laws say
which of the kinds of tissue they know (:attr:`mvest.mechanics.law.Law.kinds`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from mvest.errors import InputError


class NamePart(Enum):
    """What the second half of a name stands for."""

    NONE = ""
    REGION = "REGION"
    CHORDS = "FAMILY or tipN"
    MODE = "REGION.K"


class Kind(NamedTuple):
    """One kind of parameter.

    Attributes
    ----------
    unit : str
        Empty for what has none.
    part : NamePart
        What its names are made of.
    low, high : float
        Ends of the range that a configuration may ask for.
    description : str
    positive : bool
        Whether it is positive by nature, so that it is estimated by its logarithm.
    """

    unit: str
    part: NamePart
    low: float
    high: float
    description: str
    positive: bool = True

    @property
    def whole(self) -> bool:
        """Whether it also exists without a part, for the whole valve."""
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
    """One parameter to differentiate by: its name and its current value.

    Names are those of ``KINDS``: for example ``E_f.REGION`` (MPa; the region's other moduli follow
    in proportion), ``field.REGION.K``, ``pressure_scale`` or ``chord_stiffness.FAMILY`` (factors,
    which multiply).
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
        """Number of the mode of a field; -1 where the name has none that can be read."""
        number = self.part.rpartition(".")[2]
        return int(number) if self.kind == "field" and number.isdecimal() else -1

    def require(self, kinds: Collection[str]) -> None:
        """Raise InputError where a law, which knows these kinds, does not know the parameter."""
        if self.kind not in kinds:
            known = known_names(kinds) if kinds else "none"
            raise InputError(f"parameter {self.name!r}: the law of its leaflet knows {known}")


def known_names(kinds: Iterable[str] = ()) -> str:
    """The names that there are, or those of some kinds, in words."""
    words = []
    for kind in kinds or KINDS:
        known = KINDS[kind]
        words += [kind] if known.whole else []
        words += [f"{kind}.{known.part.value}"] if known.part is not NamePart.NONE else []
    return ", ".join(words)


def kind_of(name: str) -> Kind:
    """What kind of parameter ``name`` is.

    Raises
    ------
    InputError
        If it is none, or its part is missing or too much.
    """
    kind, _, part = name.partition(".")
    known = KINDS.get(kind)
    fits = known is not None and (
        known.part is not NamePart.NONE if part else known.whole and name == kind
    )
    if known is None or not fits:
        raise InputError(f"unknown parameter {name!r}; known: {known_names()}")
    return known


def is_positive(name: str) -> bool:
    """Whether parameter ``name`` is positive by nature; InputError if there is none such."""
    return kind_of(name).positive
