"""Dimensions of the parametric valve (:class:`mvest.valve.anatomy.template.Template`).

Lengths are mm and angles degrees. Axes are those of :mod:`mvest.valve.anatomy.template`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any, TypeVar, cast

import numpy as np

from mvest.errors import InputError
from mvest.quantities import Angle, Factor, Length, Place, Share, Stiffness, Thickness

Group = TypeVar("Group")


@dataclass(frozen=True, slots=True)
class AnnulusDimensions:
    """The annulus: an ellipse with a flatter anterior half, bent to a saddle.

    Attributes
    ----------
    commissural_half_axis, anteroposterior_half_axis : float
    saddle_height : float
        Extent along the valve's axis.
    anterior_flattening : float
        Relative shortening of the anterior half axis.
    commissure_angle : float
        Parametric angle of the commissures above the x axis.
    commissural_contraction, anteroposterior_contraction : float
        Relative shortening of the annulus until the valve is closed.
    """

    commissural_half_axis: Length = 18.0
    anteroposterior_half_axis: Length = 14.0
    saddle_height: Place = 6.5
    anterior_flattening: Share = 0.08
    commissure_angle: Angle = 19.6
    commissural_contraction: Share = 0.008
    anteroposterior_contraction: Share = 0.064


@dataclass(frozen=True, slots=True)
class LeafletDimensions:
    """One leaflet."""

    length: Length  #: from annulus to free edge in the middle
    thickness: Thickness  #: of the half next to the annulus
    #: exponent of the sine by which the length decreases towards the commissures
    length_exponent: Factor = 1.2


@dataclass(frozen=True, slots=True)
class LeafletPair:
    """Both leaflets.

    Attributes
    ----------
    anterior, posterior : LeafletDimensions
    commissural_length : float
        From annulus to free edge at the commissures.
    belly_depth : float
        Depth of a leaflet's belly over its length.
    edge_thinning : float
        Thickness at the free edge over that next to the annulus.
    fibre_turn : float
        Share of the anterior leaflet's angle, at each commissure, over which its fibres turn from
        parallel to perpendicular to the annulus.
    """

    anterior: LeafletDimensions = LeafletDimensions(24.0, 1.32)
    posterior: LeafletDimensions = LeafletDimensions(18.8, 1.26)
    commissural_length: Length = 11.0
    belly_depth: Share = 0.04
    edge_thinning: Share = 0.75
    fibre_turn: Angle = 0.23


@dataclass(frozen=True, slots=True)
class FreeEdge:
    """The free edge of the open valve from above: two arcs that meet at the commissures.

    Attributes
    ----------
    half_width : float
        Half the distance between the commissures.
    commissural_y : float
        y of the commissures.
    anterior_depth, posterior_depth : float
        Distance of the middles of the arcs from there along y.
    exponent : float
        1 gives half ellipses, 2 parabolas that meet at an angle.
    """

    half_width: Length = 15.5
    commissural_y: Place = 1.83
    anterior_depth: Place = 6.5
    posterior_depth: Place = 10.5
    exponent: Factor = 2.0


@dataclass(frozen=True, slots=True)
class ClosedEdge:
    """Line on which the free edges are meant to meet; it defines the rest lengths of the chordae.

    The line is ``y = free_edge.commissural_y - sag (1 - u^2)``, ``z = middle_z - drop u^2`` with
    ``u = x / half_width``.
    """

    half_width: Length = 13.0
    sag: Place = 7.19
    middle_z: Place = -10.9
    drop: Place = 3.4


@dataclass(frozen=True, slots=True)
class PapillaryPlace:
    """Positions of the papillary tips."""

    #: (x, y, z), the tip at positive x; the other one is its mirror image
    tip: tuple[Place, Place, Place] = (16.0, -0.24, -25.0)
    #: (x, y, z), displacement of this tip after the chordae got their lengths; the other tip moves
    #: as its mirror image. The chordae tether the leaflets then, but are never taut in the open
    #: valve.
    displacement: tuple[Place, Place, Place] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ChordLayout:
    """Insertions of the chordae in material coordinates of one half; the other half is mirrored.

    Attributes
    ----------
    marginal_phi : tuple of float
        Degrees from the commissure, positive on the anterior leaflet, at ``s = marginal_s``.
    basal : tuple of (float, float)
        (phi, s) of the basal chordae.
    marginal_s : float
    marginal_stiffness, basal_stiffness : float
        Axial stiffness EA, N.
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

    marginal_phi: tuple[Angle, ...] = tuple(np.linspace(-87.0, 88.0, 14).round(3).tolist())
    basal: tuple[tuple[Angle, Angle], ...] = ((-60.0, 0.5), (50.0, 0.55), (75.0, 0.55))
    marginal_s: Share = 0.97
    marginal_stiffness: Stiffness = 20.0
    basal_stiffness: Stiffness = 16.0
    marginal_slack: Factor = 0.985
    basal_slack: Factor = 1.03
    open_slack: Factor = 1.035
    toe_strain: Share = 0.015
    elongated: tuple[tuple[Angle, Angle, Angle], ...] = ()
    absent: tuple[tuple[Angle, Angle], ...] = ()

    def __post_init__(self) -> None:
        if not self.marginal_phi and not self.basal:
            raise InputError("a chord layout needs at least one chord")
        for k, place in enumerate(self.basal):
            if len(place) != 2:
                raise InputError(f"basal chord {k} is {place}, expected (phi, s)")
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
    "annulus.commissural_half_axis",
    "annulus.anteroposterior_half_axis",
    "leaflets.anterior.length",
    "leaflets.anterior.thickness",
    "leaflets.posterior.length",
    "leaflets.posterior.thickness",
    "leaflets.commissural_length",
    "leaflets.edge_thinning",
    "free_edge.half_width",
    "closed_edge.half_width",
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
    closed_edge: ClosedEdge = ClosedEdge()
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
