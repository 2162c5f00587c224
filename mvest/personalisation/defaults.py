"""How a case is personalised where nobody says otherwise.

The values are those of the commands ``own-valve`` and ``volume``
(``conf/personal/renewed.yaml`` and ``imaged.yaml``, where each has its source); only the mesh of an
own valve is structured here.
"""

from __future__ import annotations

from dataclasses import replace

from mvest.cases.case import ValveCase
from mvest.mechanics.settings import ExponentialTissue, MechanicsSettings, TissueSettings
from mvest.mechanics.steps import NewtonSettings
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation.considered_geometry import ConsideredGeometry
from mvest.personalisation.settings import (
    PersonaliseSettings,
    PressureErrors,
    Prior,
    Treatment,
)
from mvest.problem.registration import REGISTRATION

UNKNOWNS = (
    Prior("E_f.anterior", 6.23, 3.1),
    Prior("E_f.posterior", 2.09, 1.05),
    Prior("pressure_scale", 1.0, 0.1),
    Prior("chord_stiffness", 1.0, 0.2),
    Prior("chord_rest_length", 1.0, 0.02),
    *(Prior(name, 0.0, 1.0 if name.startswith("shift") else 2.0) for name in REGISTRATION),
)
"""Priors; moduli in MPa, displacements in mm and degrees."""

CUFF = 0.15
"""Relative standard deviation of a pressure from a cuff and Doppler."""

CURVES = {
    "anterior": ExponentialTissue(0.06, 4.325, 1446.5),
    "posterior": ExponentialTissue(0.04, 4.848, 305.4),
}
"""Exponents of May-Newman and Yin 1998 as usually quoted; the scale does not matter."""


def default_settings(case: ValveCase) -> PersonaliseSettings:
    """The settings that fit where a case is from: surfaces, or a volume with its error samples.

    Parameters
    ----------
    case : ValveCase
        With an anterior and a posterior leaflet.
    """
    surfaces = PersonaliseSettings(
        tuple(
            replace(unknown, std=CUFF) if unknown.name == "pressure_scale" else unknown
            for unknown in UNKNOWNS
        ),
        MechanicsSettings(
            {
                "anterior": TissueSettings(6.23 / 2.35),
                "posterior": TissueSettings(2.09 / 1.89),
            },
            newton=NewtonSettings(max_halvings=3),
        ),
        moduli_only=True,
        confirm=True,
        errors=ErrorBeliefs(resolution_mm=0.1),
        considered_geometry=ConsideredGeometry(
            rest_lengths=0.06, thickness=0.2, share=0.98, renewals=6
        ),
        considered_law=CURVES,
        pressures=PressureErrors(),
    )
    if case.error_samples is None:
        return surfaces
    # Leaflets, annulus and tips come from one volume: nothing is displaced against anything else,
    # and their errors are in the samples.
    return replace(
        surfaces,
        unknowns=tuple(
            replace(unknown, treatment=Treatment.FIXED) if unknown.name in REGISTRATION else unknown
            for unknown in UNKNOWNS
        ),
        errors=ErrorBeliefs(resolution_mm=0.3),
        considered_geometry=ConsideredGeometry(
            shape_mm=0.0, annulus_mm=0.0, tips_mm=0.0, rest_lengths=0.04
        ),
        considered_law={},
    )
