"""Axial stiffness of trusses, as a deck states their material."""

from __future__ import annotations

from collections.abc import Mapping

from mvest.errors import InputError
from mvest.reading.text import one_line
from mvest.valve.io.abaqus.deck import ElementSection
from mvest.valve.io.abaqus.keywords import Block

MAX_STRAIN = 0.1
"""Of a linearisation: chordae tear beyond."""


def truss_stiffness(
    section: ElementSection, materials: Mapping[str, Mapping[str, Block]], strain: float
) -> float:
    """Secant stiffness (N for mm and MPa) of a truss: force over ``strain``.

    Raises
    ------
    InputError
        If the section has no area, or its material no law that is read.
    """
    if section.size is None:
        raise InputError(f"trusses of {one_line(section.material, 40)} have no cross section")
    return section.size * secant_modulus(materials.get(section.material, {}), strain)


def secant_modulus(material: Mapping[str, Block], strain: float) -> float:
    """Nominal stress over ``strain`` of a bar under tension.

    Linear elastic, or incompressible Ogden with the nominal stress
    ``sum 2 mu/alpha (l^(alpha-1) - l^(-alpha/2-1))`` at stretch ``l = 1 + strain`` (Ogden 1972,
    Proc. R. Soc. A 326:565, in Abaqus' convention).

    Raises
    ------
    InputError
        If it is neither, or the strain is not between 0 and 0.1.
    """
    if not 0 < strain < MAX_STRAIN:
        raise InputError(f"linearisation strain {strain}, expected between 0 and {MAX_STRAIN}")
    if "ELASTIC" in material:
        linear = material["ELASTIC"]
        isotropic = linear.options.get("TYPE", "ISOTROPIC").upper() in ("ISO", "ISOTROPIC")
        values = linear.checked(linear.words)
        if not isotropic or len(values) < 1 or not values[0] > 0:
            raise InputError(f"{linear}: expected isotropic, with a modulus > 0")
        return float(values[0])
    block = material.get("HYPERELASTIC")
    if block is None or "OGDEN" not in block.options:
        what = "no elastic material" if block is None else str(block)
        raise InputError(f"trusses: {what}, expected *ELASTIC or *HYPERELASTIC, OGDEN")
    terms = block.options.get("N", "1")
    values = block.checked(block.words)
    count = int(terms) if terms in "123456" and len(terms) == 1 else 0
    if not count or len(values) < 2 * count or not all(values[1 : 2 * count : 2]):
        raise InputError(f"{block}: N = {one_line(terms, 20)}, expected 1 to 6 pairs mu, alpha")
    stretch = 1 + strain
    stress = sum(
        2 * mu / alpha * (stretch ** (alpha - 1) - stretch ** (-alpha / 2 - 1))
        for mu, alpha in values[: 2 * count].reshape(-1, 2)
    )
    if not 0 < stress < float("inf"):
        raise InputError(f"{block}: nominal stress {stress:g} at {strain:g}, expected > 0")
    return float(stress / strain)
