"""From a valve in images to a case: the joint of the image step and the estimation.

The frames of a sequence are taken as those of a case folder would be, with the same checks and the
same derivations: fibres run around the valve, and chordae are laid out as in the template, as long
as the closed frame asks for. Coordinates stay those of the images (LPS).
"""

from mvest.imaged_case.build import CaseTexts, case_of_sequence
from mvest.imaged_case.errors_in_world import samples_in_world, valve_axes, without_mean_error
from mvest.imaged_case.frames import CaseFrames, choose_frames

__all__ = [
    "CaseFrames",
    "CaseTexts",
    "case_of_sequence",
    "choose_frames",
    "samples_in_world",
    "valve_axes",
    "without_mean_error",
]
