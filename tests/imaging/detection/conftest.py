"""Shapes that all tests of detectors share."""

import pytest

from mvest.imaging.detection.shape_model import fit_shape_model
from tests.imaging.detection.made_up import moving_valve


@pytest.fixture(scope="session")
def shape():
    """A small shape model with 14 modes."""
    return fit_shape_model([moving_valve(k) for k in range(8)], 14)
