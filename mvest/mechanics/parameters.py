"""What the mechanics can be differentiated by: the names, their units, which are positive.

A name is ``KIND`` or ``KIND.PART``: the part is a leaflet of the valve, a family of chordae, a
papillary tip, or the leaflet and number of a mode. This is the one place that knows them; laws say
which of the kinds of tissue they know (:attr:`mvest.mechanics.law.Law.kinds`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum

from mvest.errors import InputError


class NamePart(Enum):
    """What the second half of a name stands for."""

    NONE = ""
    REGION = "REGION"
    CHORDS = "FAMILY or tipN"
    MODE = "REGION.K"


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of parameter.

    Attributes
    ----------
    unit : str
        Empty for what has none.
    positive : bool
        Whether it is positive by nature, so that it is estimated by its logarithm.
    part : NamePart
        What its names are made of.
    whole : bool
        Whether it also exists without a part, for the whole valve.
    description : str
    low, high : float
        Ends of the range that a configuration may ask for.
    """

    unit: str
    positive: bool
    part: NamePart
    whole: bool
    description: str
    low: float
    high: float


KINDS: dict[str, Kind] = {
    "E_f": Kind(
        "MPa", True, NamePart.REGION, False, "Young's modulus along the fibre", 1e-06, 10000
    ),
    "ratio": Kind(
        "", True, NamePart.REGION, False, "E_f over E_perp, at the same E_f", 0.001, 1000
    ),
    "G": Kind(
        "MPa",
        True,
        NamePart.REGION,
        False,
        "shear modulus, where it does not follow E_f",
        1e-06,
        10000,
    ),
    "field": Kind(
        "",
        False,
        NamePart.MODE,
        False,
        "coefficient of a mode of log E_f within a leaflet",
        -10,
        10,
    ),
    "pressure_scale": Kind("", True, NamePart.NONE, True, "factor on the pressure", 0, 100),
    "chord_stiffness": Kind(
        "", True, NamePart.CHORDS, True, "factor on the axial stiffness", 0, 100
    ),
    "chord_rest_length": Kind("", True, NamePart.CHORDS, True, "factor on the rest length", 0, 100),
    "damping": Kind(
        "s", True, NamePart.NONE, True, "stiffness-proportional part of the damping", 0, 1000
    ),
    "c0": Kind("MPa", True, NamePart.REGION, False, "scale of the exponential law", 1e-06, 10000),
    "c1": Kind(
        "", True, NamePart.REGION, False, "its exponent of the isochoric deformation", 0, 100000
    ),
    "c2": Kind("", True, NamePart.REGION, False, "its exponent of the fibres' stretch", 0, 100000),
    "mu": Kind("MPa", True, NamePart.REGION, False, "its shear modulus at rest", 1e-06, 10000),
    "kappa": Kind("MPa", True, NamePart.REGION, False, "its bulk modulus", 1e-06, 10000),
    "stiffening": Kind(
        "",
        True,
        NamePart.REGION,
        False,
        "share of the exponential law over that of the linear one",
        0,
        1e06,
    ),
    "prestretch": Kind(
        "",
        True,
        NamePart.REGION,
        False,
        "length of the open leaflet over that free of stress",
        0,
        5,
    ),
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter to differentiate by: its name and its current value.

    Names are those of ``KINDS``: for example ``E_f.REGION`` (MPa; the region's other moduli follow
    in proportion, except those that are parameters themselves), ``field.REGION.K``,
    ``pressure_scale`` or ``chord_stiffness.FAMILY`` (factors, which multiply).
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


def check_names(
    names: Iterable[str],
    regions: Iterable[str],
    chords: Iterable[str],
    modes: Mapping[str, int] | None = None,
) -> None:
    """Refuse names that are none of a valve's.

    Parameters
    ----------
    names : iterable of str
    regions : iterable of str
        Its leaflets.
    chords : iterable of str
        Its families of chordae and its tips.
    modes : mapping, optional
        Leaflet -> number of modes of its field.

    Raises
    ------
    InputError
        If there is no such kind of parameter, or no such part of this valve.
    """
    fields = [f"{region}.{k}" for region, n in (modes or {}).items() for k in range(n)]
    parts = {NamePart.REGION: list(regions), NamePart.CHORDS: list(chords), NamePart.MODE: fields}
    for name in names:
        part = name.partition(".")[2]
        known = parts.get(kind_of(name).part, [])
        if part and part not in known:
            raise InputError(
                f"parameter {name!r}: unknown {part!r}; known here: {', '.join(known) or '(none)'}"
            )
