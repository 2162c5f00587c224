"""The tip of a papillary muscle is its end towards the leaflets, wherever it lies."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.cases.importing.papillary import HEAD_MM, papillary_tip
from mvest.errors import GeometryError


def muscle(length=30.0, width=8.0):
    """Half a spheroid of that length along z from its base, tip up."""
    rng = np.random.default_rng(3)
    z = rng.uniform(0.0, 1.0, 4000)
    angle = rng.uniform(0.0, 2 * np.pi, len(z))
    radius = 0.5 * width * np.sqrt(1 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), length * z])


@pytest.mark.parametrize("seed", range(3))
def test_the_head_is_found_at_the_end_towards_the_leaflets(seed):
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.uniform(-50, 50, 3)
    leaflets = np.array([[5.0, 3.0, 45.0], [-5.0, 0.0, 50.0]])
    tip = papillary_tip(muscle() @ turn.T + shift, leaflets @ turn.T + shift)
    back = (tip - shift) @ turn
    # Points are even along z: the middle of the last HEAD_MM.
    np.testing.assert_allclose(back, [0.0, 0.0, 30.0 - 0.5 * HEAD_MM], atol=0.4)


def test_a_muscle_without_a_long_axis_is_refused():
    with pytest.raises(GeometryError, match="which end is its tip is not known; give tips"):
        papillary_tip(muscle(length=8.0, width=14.0), np.array([[0.0, 0.0, 40.0]]))
