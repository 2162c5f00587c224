"""A made-up valve of three leaflets: the template with a cleft, as a surface and as a case.

The template's posterior leaflet is cut in two: its free edge runs up to a cleft in the middle,
where the septal leaflet meets the posterior one. The free edges of the closed valve meet in a star.
"""

from dataclasses import dataclass, field

import numpy as np

from mvest.cases.case import Frame, Role, Uncertainty, ValveCase
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Valve, sampled_valve

NAMES = ("anterior", "septal", "posterior")
MODULI = (6.0, 2.0, 3.0)
"""MPa, along the fibres."""
CLEFT_MM, HALF_WIDTH = 4.0, 25.0
"""Depth of the cleft and its half width in degrees of the template."""


class Cleft(Template):
    """The template, its posterior leaflet shorter in the middle."""

    def length(self, phi):
        """Leaflet lengths; the cleft is half a wave."""
        away = np.clip((np.mod(phi, 360.0) - 270.0) / HALF_WIDTH, -1.0, 1.0)
        return super().length(phi) - CLEFT_MM * np.cos(0.5 * np.pi * away) ** 2


@dataclass(frozen=True)
class ThreeLeaflets:
    """The same in coordinates of three leaflets, of which each has 120 degrees.

    Around the valve they are the anterior, the posterior and the septal one, which is not the order
    of their names.
    """

    sections: tuple[int, ...] = (0, 2, 1)
    region_names: tuple[str, ...] = NAMES
    whole: Template = field(default_factory=Cleft)

    def _phi(self, phi):
        return np.interp(np.mod(phi, 360.0), [0.0, 120.0, 240.0, 360.0], [0.0, 180.0, 270.0, 360.0])

    def position(self, phi, s, zeta=0.0):
        """Reference positions ``(..., 3)`` mm."""
        return self.whole.position(self._phi(phi), s, zeta)

    def fibre(self, phi, s, region):
        """Those of the template's leaflets."""
        return self.whole.fibre(self._phi(phi), s, np.minimum(region, 1))

    def thickness(self, phi, s):
        """Thickness ``(k,)`` mm."""
        return self.whole.thickness(self._phi(phi), s)

    def valve(self, columns=108, rows=25) -> Valve:
        """The valve on a grid of vertices."""
        return sampled_valve(
            self,
            columns,
            rows,
            lambda phi: (
                self.whole.papillary_tips,
                self.whole.chordae(),
                self.whole.motion(self._phi(phi)),
            ),
        )


def case_of(valve: Valve) -> ValveCase:
    """A case of the open valve alone."""
    surface = valve.surface
    x = surface.vertices
    loops = x[valve.annulus], x[valve.free_edge]
    shape = x, surface.triangles, surface.region
    frame = Frame(
        "open", 0.0, Role.REFERENCE, 0.0, *shape, *loops, valve.papillary_tips, corresponds=True
    )
    return ValveCase(
        name="three leaflets", description="made up", source="mvest", licence="CC0",
        simulated=True, surface=surface, annulus=valve.annulus, free_edge=valve.free_edge,
        frames=(frame,), chordae=valve.chordae, uncertainty=Uncertainty(1.0, 10.0),
    )  # fmt: skip
