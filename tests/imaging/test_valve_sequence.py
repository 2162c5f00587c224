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
CHECKED = {
    ValveSequence: ("vertices", "tips", "frame_confidence", "vertex_confidence", "std_mm"),
    MovingValve: ("vertices", "tips", "thickness", "chord_s", "chord_tip"),
}


def test_rims_are_rows_of_the_layout():
    sequence = ValveSequence(**FIELDS[ValveSequence])
    grid = sequence.vertices.reshape(2, 3, 8, 3)
    np.testing.assert_array_equal(sequence.annulus, grid[:, 0])
    np.testing.assert_array_equal(sequence.free_edge, grid[:, -1])


@pytest.mark.parametrize(("kind", "name"), [(k, n) for k, each in CHECKED.items() for n in each])
def test_a_wrong_shape_is_named(kind, name):
    wrong = FIELDS[kind] | {name: FIELDS[kind][name][..., :-1]}
    kind(**FIELDS[kind])
    with pytest.raises(InputError, match=name):
        kind(**wrong)


@pytest.mark.parametrize("kind", FIELDS)
@pytest.mark.parametrize("times", [[0.1, 0.0], [0.1, 0.1], [0.0, np.nan]])
def test_times_must_increase(kind, times):
    # With "a difference <= 0" as the test, times that are no numbers pass.
    with pytest.raises(InputError, match="times"):
        kind(**(FIELDS[kind] | {"times": np.array(times)}))


def coordinates(layout: ValveLayout, frames: int = 2) -> ValveSequence:
    """A sequence whose vertices are (phi, s, frame), so that a position says which one it is."""
    vertices = np.stack(
        [np.stack([layout.phi, layout.s, np.full(layout.size, t)], axis=1) for t in range(frames)]
    )
    tips = np.array([[[-1.0, tip, t] for tip in (0.0, 180.0)] for t in range(frames)])
    times, ones = np.arange(float(frames)), np.ones((frames, layout.size))
    return ValveSequence(layout, times, vertices, tips, ones[:, 0], ones, ones[0], 5.0)


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
    sequence = coordinates(ValveLayout(16, 4))
    found = landmarks(sequence, 1)
    assert tuple(found) == LANDMARKS == tuple(expected)
    for name, position in expected.items():
        np.testing.assert_allclose(found[name], (*position, 1), err_msg=name)
        found[name][:] = 99.0  # a copy
        np.testing.assert_allclose(landmarks(sequence, 1)[name], (*position, 1))


def test_frames_and_layouts_without_landmarks_are_refused() -> None:
    for frame in (-1, 2):
        with pytest.raises(InputError, match=rf"frame {frame}, expected 0 to 1"):
            landmarks(coordinates(ValveLayout(16, 4)), frame)
    with pytest.raises(InputError, match="no column of 12 lies at 45 degrees"):
        landmark_vertices(ValveLayout(12, 3))
