"""Dimensions of the parametric valve (:class:`mvest.valve.anatomy.template.Template`).

Lengths are mm and angles degrees. Axes are those of :mod:`mvest.valve.anatomy.template`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any, TypeVar, cast

from mvest.errors import InputError
from mvest.quantities import Angle, Count, Factor, Length, Place, Share, Stiffness, Thickness

Group = TypeVar("Group")


@dataclass(frozen=True, slots=True)
class AnnulusDimensions:
    """The annulus: an ellipse with a flatter anterior half, bent to a saddle.

    Sources. Diameters of normal annuli by three-dimensional echocardiography: 24 ± 3 to 29 ± 3 and
    30.8 ± 4.4 mm anteroposterior, 35 ± 5 to 39 ± 4 mm commissural, height 5.9 to 6.8 ± 1 mm
    (PMC7368231, table 3). A higher saddle puts the bellies of closed leaflets under more tension
    (Salgo et al. 2002, Circulation 106:711); the height is the largest within two standard
    deviations. The open frame is the last one before closure: most of the contraction lies behind
    it.
    """

    commissural_diameter: Length = 36.0
    anteroposterior_diameter: Length = 23.0
    saddle_height: Place = 7.9  #: extent along the valve's axis
    commissure_angle: Angle = 18.0  #: parametric angle of the commissures above the x axis
    #: relative shortening of the annulus until the valve is closed
    commissural_contraction: Share = 0.01
    anteroposterior_contraction: Share = 0.012
    saddle_deepening: Share = 0.1  #: relative increase of the height until then


@dataclass(frozen=True, slots=True)
class LeafletDimensions:
    """One leaflet."""

    length: Length  #: from annulus to free edge in the middle
    thickness: Thickness  #: of the half next to the annulus
    belly: Share  #: depth of its bulge into the lumen, over its length


@dataclass(frozen=True, slots=True)
class LeafletPair:
    """Both leaflets.

    The posterior leaflet has three scallops. Between them it is shorter by the `indentation`. Each
    scallop of the open valve bulges away from the lumen, and into the atrium when it is closed.
    Lengths of the anterior leaflet are 20 to 25 mm, of the middle scallop 10 to 14 mm [recalled].
    Thickness is that of the paper.
    """

    anterior: LeafletDimensions = LeafletDimensions(24.1, 1.32, 0.11)
    posterior: LeafletDimensions = LeafletDimensions(13.9, 1.26, 0.07)
    commissural_length: Length = 9.0  #: from annulus to free edge at the commissures
    indentation: Share = 0.2  #: of the length
    scallop_bulge: Share = 0.09  #: depth of a scallop's bulge over its length
    edge_thinning: Share = 0.75  #: thickness at the free edge over that next to the annulus
    #: share of the anterior leaflet's angle, at each commissure, over which its fibres turn from
    #: parallel to perpendicular to the annulus
    fibre_turn: Angle = 0.23


@dataclass(frozen=True, slots=True)
class FreeEdge:
    """The free edges: of the open valve seen from above, and the line on which they meet.

    The line of coaptation is ``y = commissural_y - sag (1 - u^2)``, ``z = -depth - drop u^2`` with
    ``u = 2 x / width``. It defines the rest lengths of the chordae.
    """

    width: Length = 29.0  #: between the commissures
    commissural_y: Place = 1.4  #: y of the commissures
    #: distance of the middle of the open edge from there along y, towards its own annulus
    anterior_opening: Place = 1.0
    posterior_opening: Place = 4.8
    sag: Place = 8.8
    depth: Place = 8.2
    drop: Place = 2.0


@dataclass(frozen=True, slots=True)
class PapillaryPlace:
    """Positions of the papillary tips."""

    #: (x, y, z), the tip at positive x; the other one is its mirror image
    tip: tuple[Place, Place, Place] = (17.7, 4.0, -25.0)
    #: (x, y, z), displacement of this tip after the chordae got their lengths; the other tip moves
    #: as its mirror image. The chordae tether the leaflets then, but are never taut in the open
    #: valve.
    displacement: tuple[Place, Place, Place] = (0.0, 0.0, 0.0)


FAMILIES = ("marginal", "basal", "strut")
"""Families of chordae."""


@dataclass(frozen=True, slots=True)
class ChordLayout:
    """The chordae of one half of the valve in material coordinates; the other half is mirrored.

    Angles are degrees from the commissure, positive on the anterior leaflet. Marginal chordae
    branch into fans that insert next to the free edge; basal chordae and the strut chordae of the
    anterior leaflet insert at its body. With 7 fans, 4 basal chordae and a strut chord, each tip
    sends out 12 chordae: 24 in all, as in human valves (25: 9 anterior, 14 posterior, 2
    commissural; Lam et al. 1970, Circulation 41:449) [recalled].

    Attributes
    ----------
    marginal : tuple of float
        Middles of the fans.
    branches : int
        Branches of a fan; 1 for straight marginal chordae.
    fan_width : float
        Angle between the outermost branches.
    basal, strut : tuple of (float, float)
        Places (angle, s).
    stiffness : tuple of three float
        Axial stiffness EA (N) of marginal trunks, basal and strut chordae. Branches share that of
        their trunk. Moduli and sections: 40 MPa and 0.3 to 0.4 mm² marginal, 22 MPa and 0.6 to 0.8
        mm² basal (Kunzelman and Cochran 1990) [recalled]; a trunk of three branches has their
        sections together, a strut chord 1.6 mm².
    marginal_slack, basal_slack : float
        Rest length over the distance to the intended closed position.
    open_slack : float
        Least ratio of the rest length to the open length.
    toe_strain : float
    elongated : tuple of (float, float, float)
        (from, to, factor): chordae that insert in this range of ``phi`` of the whole valve (not
        mirrored) are longer by the factor. The factors of overlapping ranges multiply.
    absent : tuple of (float, float)
        (from, to): chordae that insert in this range of ``phi`` of the whole valve are missing.

    Raises
    ------
    InputError
        If there is no chord, an insertion is incomplete, a range empty or a factor not positive.
    """

    marginal: tuple[Angle, ...] = (-78.0, -52.0, -26.0, 0.0, 26.0, 52.0, 78.0)
    branches: Count = 3
    fan_width: Angle = 17.0
    basal: tuple[tuple[Angle, Share], ...] = ((-58.0, 0.32), (-12.0, 0.32), (76.0, 0.3))
    strut: tuple[tuple[Angle, Share], ...] = ((44.0, 0.5),)
    stiffness: tuple[Stiffness, Stiffness, Stiffness] = (48.0, 16.0, 40.0)
    marginal_slack: Factor = 0.96
    basal_slack: Factor = 1.02
    open_slack: Factor = 1.035
    toe_strain: Share = 0.015
    elongated: tuple[tuple[Angle, Angle, Angle], ...] = ()
    absent: tuple[tuple[Angle, Angle], ...] = ()

    def __post_init__(self) -> None:
        if not (self.marginal or self.basal or self.strut):
            raise InputError("a chord layout needs at least one chord")
        if len(self.stiffness) != len(FAMILIES) or not min(self.stiffness) > 0:
            raise InputError(
                f"stiffness of chordae {self.stiffness}, expected one > 0 for each of "
                f"{', '.join(FAMILIES)}"
            )
        if self.branches < 1:
            raise InputError(f"branches of a marginal chord = {self.branches}, expected >= 1")
        for name in ("basal", "strut"):
            for k, place in enumerate(getattr(self, name)):
                if len(place) != 2:
                    raise InputError(f"{name} chord {k} is {place}, expected (phi, s)")
        for elongation in self.elongated:
            if len(elongation) != 3 or not (elongation[0] < elongation[1] and elongation[2] > 0):
                raise InputError(
                    f"elongated chordae {elongation}, expected (from, to, factor) with from < to "
                    "and factor > 0"
                )
        for gap in self.absent:
            if len(gap) != 2 or not gap[0] < gap[1]:
                raise InputError(f"absent chordae {gap}, expected (from, to) with from < to")


POSITIVE = (
    "annulus.commissural_diameter",
    "annulus.anteroposterior_diameter",
    "leaflets.anterior.length",
    "leaflets.anterior.thickness",
    "leaflets.posterior.length",
    "leaflets.posterior.thickness",
    "leaflets.commissural_length",
    "leaflets.edge_thinning",
    "free_edge.width",
)


@dataclass(frozen=True, slots=True)
class TemplateParameters:
    """Shape of the valve; lengths in mm, angles in degrees.

    Raises
    ------
    InputError
        If a length is not positive, a position has not three coordinates, or fibres do not turn
        within half a leaflet.
    """

    annulus: AnnulusDimensions = AnnulusDimensions()
    leaflets: LeafletPair = LeafletPair()
    free_edge: FreeEdge = FreeEdge()
    papillary: PapillaryPlace = PapillaryPlace()
    chordae: ChordLayout = ChordLayout()

    def __post_init__(self) -> None:
        for name in ("papillary.tip", "papillary.displacement"):
            place = attrgetter(name)(self)
            if len(place) != 3:
                raise InputError(f"template {name} = {place}, expected (x, y, z)")
        turn = self.leaflets.fibre_turn
        if not 0 < turn <= 0.5:
            raise InputError(f"template leaflets.fibre_turn = {turn}, expected in (0, 0.5]")
        for name in POSITIVE:
            value = attrgetter(name)(self)
            if not value > 0:
                raise InputError(f"template {name} = {value}, expected > 0")

    def changed(self, values: Mapping[str, Any]) -> TemplateParameters:
        """Copy with other values by dotted names, such as ``annulus.saddle_height``; InputError."""
        return _changed(self, values)


def _changed(group: Group, values: Mapping[str, Any]) -> Group:
    own: dict[str, Any] = {}
    within: dict[str, dict[str, Any]] = {}
    known = [field.name for field in fields(cast(Any, group))]
    for name, value in values.items():
        head, _, rest = name.partition(".")
        if head not in known:
            raise InputError(f"template parameter {name!r}, expected one of {', '.join(known)}")
        if rest:
            within.setdefault(head, {})[rest] = value
        else:
            own[head] = value
    own |= {head: _changed(getattr(group, head), inner) for head, inner in within.items()}
    return cast(Group, replace(cast(Any, group), **own))
