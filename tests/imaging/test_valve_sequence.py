"""Moving valves and sequences refuse arrays that do not belong together.

Named points: a wrong angle, row, tip or frame, and what a layout cannot give.
"""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import (
    LANDMARKS,
    MovingValve,
    ValveSequence,
    landmark_vertices,
    landmarks,
)

LAYOUT = ValveLayout(8, 3)


SIZE = LAYOUT.size
BOTH = {
    "layout": LAYOUT,
    "times": np.array([0.0, 0.1]),
    "vertices": np.random.default_rng(0).normal(size=(2, SIZE, 3)),
    "tips": np.zeros((2, 2, 3)),
}
FIELDS = {
    ValveSequence: BOTH
    | {
        "frame_confidence": np.ones(2),
        "vertex_confidence": np.ones((2, SIZE)),
        "std_mm": np.ones(SIZE),
        "correlation_length_mm": 5.0,
    },
    MovingValve: BOTH
    | {
        "name": "made up",
        "thickness": np.ones(SIZE),
        "chord_phi": np.zeros(4),
        "chord_s": np.zeros(4),
        "chord_tip": np.zeros(4, np.int64),
    },
}


@pytest.mark.parametrize("kind", FIELDS)
def test_arrays_of_other_shapes_and_times_that_do_not_increase_are_refused(kind):
    kind(**FIELDS[kind])
    wrong = {"vertices": BOTH["vertices"][..., :2], "tips": np.zeros((2, 1, 3))}
    # With "a difference <= 0" as the test, times that are no numbers pass.
    for name, values in [*wrong.items(), ("times", [0.1, 0.1]), ("times", [0.0, np.nan])]:
        with pytest.raises(InputError, match=name):
            kind(**(FIELDS[kind] | {name: np.array(values)}))


def test_every_landmark_is_where_its_name_says() -> None:
    expected = {
        **{f"commissure_{phi}": (phi, 0) for phi in (0, 180)},
        "annulus_anterior": (90, 0),
        "annulus_posterior": (270, 0),
        "free_edge_anterior": (90, 1),
        "free_edge_posterior": (270, 1),
        **{f"annulus_{phi}": (phi, 0) for phi in (45, 135, 225, 315)},
        **{f"tip_{phi}": (-1, phi) for phi in (0, 180)},
    }
    layout, ones = ValveLayout(16, 4), np.ones((2, 64))
    # A position is (phi, s, frame).
    vertices = np.stack(
        [np.stack([layout.phi, layout.s, np.full(layout.size, t)], axis=1) for t in range(2)]
    )
    tips = np.array([[[-1.0, tip, t] for tip in (0.0, 180.0)] for t in range(2)])
    sequence = ValveSequence(layout, np.arange(2.0), vertices, tips, ones[:, 0], ones, ones[0], 5.0)
    found = landmarks(sequence, 1)
    assert tuple(found) == LANDMARKS == tuple(expected)
    for name, position in expected.items():
        np.testing.assert_allclose(found[name], (*position, 1), err_msg=name)
    with pytest.raises(InputError, match="frame 2, expected 0 to 1"):
        landmarks(sequence, 2)
    with pytest.raises(InputError, match="no column of 12 lies at 45 degrees"):
        landmark_vertices(ValveLayout(12, 3))
