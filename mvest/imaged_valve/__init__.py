"""What users of valve software expect of a valve from images: measures, surfaces, landmarks."""

from mvest.imaged_valve.files import write_for_slicer, write_landmarks, write_surfaces
from mvest.imaged_valve.measures import (
    OPEN_SHARE,
    closed_frame,
    contact_distance,
    measure_meaning,
    measure_sequence,
    write_measures,
)

__all__ = [
    "OPEN_SHARE",
    "closed_frame",
    "contact_distance",
    "measure_meaning",
    "measure_sequence",
    "write_for_slicer",
    "write_landmarks",
    "write_measures",
    "write_surfaces",
]
