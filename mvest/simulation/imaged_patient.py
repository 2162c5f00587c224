"""A virtual patient for imaging: a valve in motion, and the truth that its images do not state.

Open, closed and held frames are those of a virtual patient
(:mod:`mvest.simulation.virtual_patient`): closed on a fine mesh, in exact equilibrium under the
patient's own pressure, with chordae that differ from what is stated. The frames in between come
from a coarse mesh, as for a population. Nothing is displaced: leaflets, annulus and tips are in the
same images.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mvest.errors import InputError
from mvest.imaging.valve_sequence import MovingValve
from mvest.problem.registration import REGISTRATION
from mvest.simulation.motion import DrawnValve, MotionSettings, closing_frames, moving_valve
from mvest.simulation.virtual_patient import PatientSimulation, close_patient
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Valve
from mvest.valve.geometry.proximity import closest_points

IMAGED = PatientSimulation(
    columns=54,
    rows=6,
    held_pressure_mmHg=(100.0, 80.0),
    held_relaxation=(0.15, 0.3),
    held_tips=(0.0, 0.0, 0.0),
)
"""How these patients are closed. The settings of the observation are not used."""


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


def simulate_imaged_patient(
    drawn: DrawnValve, simulation: PatientSimulation, settings: MotionSettings
) -> ImagedPatient:
    """Close a valve as a patient's.

    The displacement in its values (`draw_patient_values`) is not used. ``simulation`` applies to
    the open, closed and held frames; ``settings`` give layout, duration, limits, and mesh and
    number of the frames of closing. GeometryError if the valve does not close, or not as a valve
    does; InputError if its mechanics do not end in an equilibrium.
    """
    values = {name: value for name, value in drawn.values.items() if name not in REGISTRATION}
    drawn, protocol = replace(drawn, values=values), drawn.mechanics.protocol
    if not protocol.equilibrium:
        raise InputError(
            "mechanics protocol equilibrium = False, expected True for a patient who is imaged"
        )
    # The coarse closure comes first: it is refused soonest.
    closing, tips, _ = closing_frames(drawn, settings)
    seen = drawn.sampled(settings.columns, settings.rows)
    later = close_patient(drawn, seen, simulation)
    shapes = [seen.surface.vertices, *closing[1:-1], *later.values()]
    tips += [state.papillary_tips for state in simulation.held_states(seen).values()]
    closed = len(closing) - 1
    valve = moving_valve(drawn, settings, shapes, tips, closed)
    return ImagedPatient(valve, closed, protocol.pressure_mmHg, seen, values)
