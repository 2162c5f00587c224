"""A virtual patient for imaging: a valve in motion, and the truth that its images do not state.

It is closed as the valves are on which detectors are trained and calibrated
(:mod:`mvest.simulation.motion`), under its own pressure and with chordae that differ from what is
stated. Nothing is displaced: leaflets, annulus and tips are in the same images.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mvest.imaging.valve_sequence import MovingValve
from mvest.problem.registration import REGISTRATION
from mvest.simulation.motion import DrawnValve, MotionSettings, close_in_motion
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Valve
from mvest.valve.geometry.proximity import closest_points


@dataclass(frozen=True, slots=True, eq=False)
class ImagedPatient:
    """A virtual patient in motion."""

    valve: MovingValve  #: true, in the open frame, those of closing, the closed one, and those held
    closed: int  #: number of the closed frame
    pressure_mmHg: float  #: stated of the closed frame
    stated: Valve  #: in the layout, with the chordae as they would be stated
    values: Mapping[str, float]  #: parameter -> true value, as in `VirtualPatient`

    def chord_ratios(self) -> dict[str, FloatArray]:
        """Family -> true rest lengths of its chordae over the distance of their ends, closed.

        `mvest.cases.tissue` lays chordae out by these ratios.
        """
        surface, chordae = self.stated.surface, self.stated.chordae
        place = closest_points(chordae.insertion, surface.vertices, surface.triangles)
        ends = place.interpolate(self.valve.vertices[self.closed], surface.triangles)
        away = np.linalg.norm(ends - self.valve.tips[self.closed][chordae.end_tip], axis=1)
        ratio = self.values["chord_rest_length"] * chordae.along(chordae.rest_length) / away
        return {
            name: ratio[chordae.family[: len(ratio)] == family]
            for family, name in enumerate(chordae.family_names)
        }


def simulate_imaged_patient(drawn: DrawnValve, settings: MotionSettings) -> ImagedPatient:
    """Close a valve as a patient's.

    The displacement in its values (`draw_patient_values`) is not used. GeometryError if the valve
    does not close, or not as a valve does.
    """
    values = {name: value for name, value in drawn.values.items() if name not in REGISTRATION}
    drawn = replace(drawn, values=values)
    seen = drawn.sampled(settings.columns, settings.rows)
    pressure = drawn.mechanics.protocol.pressure_mmHg
    valve = close_in_motion(drawn, settings)
    return ImagedPatient(valve, settings.frames - 1, pressure, seen, values)
