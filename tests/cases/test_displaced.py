"""A case as one of its error samples says that it may have been."""

import dataclasses

import numpy as np
import pytest

from mvest.cases.case import ErrorSamples, Role
from mvest.cases.displaced import displaced_case
from mvest.errors import InputError
from tests.cases.test_uncertainty import corresponding


def told(follow):
    case = corresponding(40, 12)
    n = len(case.surface.vertices)
    shift = np.array([1.0, -2.0, 0.5])
    vertices = np.zeros((4, 3, n, 3))
    tips = np.zeros((4, 3, 2, 3))
    vertices[1], tips[1] = shift, shift  # everything as one
    vertices[2, 2, :, 2] = 8.0  # the closed frame's leaflets alone
    return dataclasses.replace(
        case, error_samples=ErrorSamples(vertices, tips), chordae_follow=follow
    ), shift


@pytest.mark.parametrize("follow", [True, False])
def test_a_valve_that_moves_as_one_is_the_same_valve(follow):
    case, shift = told(follow)
    still, moved = displaced_case(case, 0), displaced_case(case, 1)
    assert moved.error_samples is None
    for before, after in zip(still.frames, moved.frames, strict=True):
        for name in ("vertices", "annulus", "free_edge", "papillary_tips"):
            np.testing.assert_allclose(getattr(after, name), getattr(before, name) + shift)
    np.testing.assert_array_equal(moved.surface.vertices, moved.frame(Role.REFERENCE).vertices)
    np.testing.assert_allclose(moved.chordae.insertion, still.chordae.insertion + shift, atol=1e-9)
    np.testing.assert_allclose(moved.chordae.rest_length, still.chordae.rest_length, atol=1e-9)
    np.testing.assert_allclose(moved.valve.motion.annulus, still.valve.motion.annulus + shift)


def test_chordae_that_follow_are_as_long_as_the_displaced_closed_frame_asks_for():
    case, _ = told(True)
    still, moved = displaced_case(case, 0), displaced_case(case, 2)
    # Leaflets farther from the tips: chordae that were as long as this asks for are longer.
    longer = moved.chordae.rest_length - still.chordae.rest_length
    assert longer.max() > 1.0
    assert longer.min() >= -1e-9
    np.testing.assert_array_equal(still.surface.vertices, moved.surface.vertices)
    given, _ = told(False)
    np.testing.assert_array_equal(
        displaced_case(given, 2).chordae.rest_length, given.chordae.rest_length
    )


def test_a_sample_that_there_is_not_is_refused():
    case, _ = told(False)
    for number in (4, -1):
        with pytest.raises(InputError, match=f"error sample {number} of 4"):
            displaced_case(case, number)
    with pytest.raises(InputError, match="error sample 0 of 0"):
        displaced_case(corresponding(), 0)
