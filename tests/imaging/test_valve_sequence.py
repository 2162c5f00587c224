"""Sequences of valves refuse arrays that do not belong together."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import ValveSequence

LAYOUT = ValveLayout(8, 3)


def fields():
    n = LAYOUT.size
    return {
        "layout": LAYOUT,
        "times": np.array([0.0, 0.1]),
        "vertices": np.random.default_rng(0).normal(size=(2, n, 3)),
        "tips": np.zeros((2, 2, 3)),
        "frame_confidence": np.ones(2),
        "vertex_confidence": np.ones((2, n)),
        "std_mm": np.ones(n),
        "correlation_length_mm": 5.0,
    }


def test_rims_are_rows_of_the_layout():
    sequence = ValveSequence(**fields())
    grid = sequence.vertices.reshape(2, 3, 8, 3)
    np.testing.assert_array_equal(sequence.annulus, grid[:, 0])
    np.testing.assert_array_equal(sequence.free_edge, grid[:, -1])


@pytest.mark.parametrize(
    "name", ["vertices", "tips", "frame_confidence", "vertex_confidence", "std_mm"]
)
def test_a_wrong_shape_is_named(name):
    wrong = fields()
    wrong[name] = wrong[name][..., :-1]
    with pytest.raises(InputError, match=name):
        ValveSequence(**wrong)


@pytest.mark.parametrize("times", [[0.1, 0.0], [0.1, 0.1], [0.0, np.nan]])
def test_times_must_increase(times):
    # With "a difference <= 0" as the test, times that are no numbers pass.
    with pytest.raises(InputError, match="times"):
        ValveSequence(**(fields() | {"times": np.array(times)}))
