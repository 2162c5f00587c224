"""What a case prints."""

from dataclasses import replace

import numpy as np

from mvest.cases.case import ErrorSamples, Uncertainty
from tests.cases.folders import template_case


def test_a_case_prints_what_a_person_wants_to_know() -> None:
    case = template_case(40, 12)
    lines = str(case).splitlines()
    assert lines == [
        "case template (simulated): anterior, posterior",
        f"480 vertices, {len(case.chordae)} chordae",
        "frames: open (reference, -0.333 mmHg), held (held out, 80.1 mmHg), "
        "closed (closed, 121 mmHg)",
        "seen within 0.9 mm, alike over 7.5 mm",
    ]


def test_what_a_case_lacks_is_not_printed() -> None:
    case = template_case(40, 12)
    frames = tuple(replace(frame, corresponds=True) for frame in case.frames)
    samples = ErrorSamples(np.zeros((5, 3, 480, 3)), np.zeros((5, 3, 2, 3)))
    plain = replace(
        case,
        simulated=False,
        frames=frames,
        uncertainty=Uncertainty(0.5),
        error_samples=samples,
    )
    lines = str(plain).splitlines()
    assert lines[0] == "case template: anterior, posterior"
    assert lines[3] == "seen within 0.5 mm, independent; 5 error samples"
