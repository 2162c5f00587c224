"""From a valve in images to a case, and to the measures and files that users of images expect.

The frames of a sequence are taken as those of a case folder would be, with the same checks and the
same derivations: fibres run around the valve, and chordae are laid out as in the template, as long
as the closed frame asks for. Coordinates stay those of the images (LPS).
"""

from mvest.cases.from_images.build import CaseTexts, case_of_sequence
from mvest.cases.from_images.errors_in_world import (
    samples_in_world,
    valve_axes,
    without_mean_error,
)
from mvest.cases.from_images.files import write_for_slicer, write_landmarks, write_surfaces
from mvest.cases.from_images.frame_choice import CaseFrames, choose_frames
from mvest.cases.from_images.measures import (
    OPEN_SHARE,
    closed_frame,
    contact_distance,
    measure_meaning,
    measure_sequence,
    write_measures,
)

__all__ = [
    "OPEN_SHARE",
    "CaseFrames",
    "CaseTexts",
    "case_of_sequence",
    "choose_frames",
    "closed_frame",
    "contact_distance",
    "measure_meaning",
    "measure_sequence",
    "samples_in_world",
    "valve_axes",
    "without_mean_error",
    "write_for_slicer",
    "write_landmarks",
    "write_measures",
    "write_surfaces",
]
