"""Random anatomies around a given one, for populations of simulated valves.

The overall size and the other deviations are normal deviates z, truncated at two standard
deviations. In the logarithms of the parameters,

* annulus and free edge have the size and one deviation along each direction in common, so that a
  wide valve is wide at its edge too;
* leaflets have half of both, and a deviation of their own: they vary less than annuli;
* papillary tips have the size and a shift of their own;
* thickness (equal for both leaflets), saddle and contraction vary independently.

Sources. Annulus diameters of normal valves have standard deviations of 12 to 14 % (24 ± 3 mm and
30.8 ± 4.4 mm antero-posterior, 35 ± 5 mm commissural), measurement errors included; here they have
6 % at a scale of 1 and 12 % at 2. Anterior leaflets are 20 to 25 mm long, that is ± 11 %, which is
the largest deviation at a scale of 1. Tips are 13 to 19 mm from the middle. The other spreads are
choices.
"""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np
import scipy

from mvest.errors import GeometryError, InputError
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template

LIMIT = 2.0
"""Truncation of the normal deviates, in standard deviations."""

MAX_REFUSED = 100
"""Number of successive refused shapes after which the scale counts as too large."""

SIZE, AP, COMMISSURAL = 0.05, 0.035, 0.03
LEAFLET, EDGE, SADDLE, THICKNESS, CONTRACTION = 0.01, 0.04, 0.10, 0.07, 0.15
"""Standard deviations of logarithms."""

TIP = 0.7
"""Standard deviation (mm) of each coordinate of a papillary tip, in addition to the size."""

SAMPLING = (112, 29)
"""Vertices of the valve that tests whether a shape is admissible."""


def vary(
    parameters: TemplateParameters, rng: np.random.Generator, scale: float = 1.0
) -> TemplateParameters:
    """Draw a random anatomy around a given one until the template accepts it.

    Parameters
    ----------
    parameters : TemplateParameters
        The median anatomy. Its chordae keep their insertions; their rest lengths follow the shape.
    rng : numpy.random.Generator
    scale : float
        Factor on all standard deviations.

    Raises
    ------
    InputError
        If the scale is negative or not finite, or so large that hardly any shape is a valve.
    """
    if not (np.isfinite(scale) and scale >= 0):
        raise InputError(f"scale of a variation = {scale}, expected a number >= 0")
    for _ in range(MAX_REFUSED):
        z = scale * scipy.stats.truncnorm.rvs(-LIMIT, LIMIT, size=13, random_state=rng)
        try:
            varied = _changed(parameters, z)
            Template(varied).valve(*SAMPLING)
        except GeometryError:
            continue
        return varied
    raise InputError(
        f"scale of a variation = {scale}: {MAX_REFUSED} shapes in a row are no valve; take a "
        "smaller one"
    )


def _changed(p: TemplateParameters, z: FloatArray) -> TemplateParameters:
    """The anatomy with the deviates ``z (13,)``."""
    size, ap, commissural = SIZE * z[0], AP * z[1], COMMISSURAL * z[2]
    along_y, along_x = np.exp(size + ap), np.exp(size + commissural)
    half = 0.5 * (size + ap)
    thickness = np.exp(THICKNESS * z[8])
    tip = np.exp(size) * np.array(p.papillary.tip) + TIP * z[10:13]
    factors = {
        "annulus.commissural_diameter": along_x,
        "annulus.anteroposterior_diameter": along_y,
        "annulus.saddle_height": np.exp(size + SADDLE * z[7]),
        "annulus.anteroposterior_contraction": np.exp(CONTRACTION * z[9]),
        "leaflets.anterior.length": np.exp(half + LEAFLET * z[3]),
        "leaflets.posterior.length": np.exp(half + LEAFLET * z[4]),
        "leaflets.commissural_length": np.exp(half),
        "leaflets.anterior.thickness": thickness,
        "leaflets.posterior.thickness": thickness,
        "free_edge.width": along_x,
        "free_edge.commissural_y": along_y,
        "free_edge.anterior_opening": along_y * np.exp(EDGE * z[5]),
        "free_edge.posterior_opening": along_y * np.exp(EDGE * z[6]),
        "free_edge.sag": along_y,
        "free_edge.depth": np.exp(size),
        "free_edge.drop": np.exp(size),
    }
    values: dict[str, Any] = {
        name: float(attrgetter(name)(p) * factor) for name, factor in factors.items()
    }
    return p.changed({**values, "papillary.tip": tuple(tip.tolist())})
