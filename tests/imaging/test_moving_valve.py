"""Moving valves refuse arrays that do not belong together."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve

LAYOUT = ValveLayout(8, 3)


def fields():
    n = LAYOUT.size
    return {
        "name": "made up",
        "layout": LAYOUT,
        "times": np.array([0.0, 0.1]),
        "vertices": np.zeros((2, n, 3)),
        "tips": np.zeros((2, 2, 3)),
        "thickness": np.ones(n),
        "chord_phi": np.zeros(4),
        "chord_s": np.zeros(4),
        "chord_tip": np.zeros(4, np.int64),
    }


def test_what_belongs_together_passes():
    assert MovingValve(**fields()).name == "made up"


@pytest.mark.parametrize("name", ["vertices", "tips", "thickness", "chord_s", "chord_tip"])
def test_a_wrong_shape_is_named(name):
    wrong = fields()
    wrong[name] = wrong[name][..., :-1]
    with pytest.raises(InputError, match=f"moving valve made up, {name}"):
        MovingValve(**wrong)


@pytest.mark.parametrize("times", [[0.1, 0.0], [0.1, 0.1], [0.0, np.nan]])
def test_times_must_increase(times):
    with pytest.raises(InputError, match="times"):
        MovingValve(**(fields() | {"times": np.array(times)}))
