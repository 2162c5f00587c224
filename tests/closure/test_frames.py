"""Several closed frames of a valve: each is closed under its pressure, and differentiated."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.closure.continuation import ClosedState
from mvest.closure.frames import ERROR, OFFSET, FramesModel
from mvest.errors import InputError
from mvest.mechanics.valve_system import HeldState
from tests.closure.test_model import AT, CLOSING, MODULI, model_of, settings_of, step_study

NAMES = (*MODULI, "pressure_scale")
ERRORS = (OFFSET, f"{ERROR}.systole", f"{ERROR}.early")
M = np.array([*AT, 1.02, 2.0, -3.0, 1.5])
"""With errors of pressures in mmHg that shift the frames against each other."""


@pytest.fixture(scope="module")
def frames():
    model = model_of(CLOSING, NAMES, continuation=True)
    motion = model.contact_valve.motion
    tips = motion.papillary_tips[-1] + [0.0, 0.0, 0.2]
    early = HeldState(98.0, motion.annulus[-1], tips)
    both = FramesModel(model, "systole", {"early": early}, CLOSING.pressure_mmHg, ERRORS)
    prediction = both(M)
    assert prediction.converged
    return both, prediction, model.closed


def split(y):
    return y.reshape(3, -1, 3)


def test_each_frame_is_the_valve_closed_under_its_true_pressure(frames):
    both, prediction, _ = frames
    assert both.frames == ("early", "systole")
    # P = 1.02 (P stated + 2 + own error).
    for which, pressure in ((2, 1.02 * 99.0), (1, 1.02 * 101.5)):
        contact = both.model.contact_valve
        if which == 1:
            tips = np.stack([contact.motion.papillary_tips[0], both.states["early"].papillary_tips])
            contact = replace(contact, motion=replace(contact.motion, papillary_tips=tips))
        alone = replace(
            both.model,
            contact_valve=contact,
            settings=settings_of(replace(CLOSING, pressure_mmHg=pressure)),
            continuation=False,
        )
        seen = alone(np.array([*AT, 1.0])).y.reshape(2, -1, 3)[1]
        np.testing.assert_allclose(split(prediction.y)[which], seen, rtol=0, atol=1e-7)
    apart = split(prediction.y)[2] - split(prediction.y)[1]
    assert np.abs(apart).max() > 0.05


@pytest.mark.parametrize("k", range(len(M)), ids=(*NAMES, *ERRORS))
def test_derivatives_agree_with_differences(frames, k):
    both, prediction, closed = frames

    def run(m):
        both.restart(ClosedState(closed.at, closed.positions))
        found = both(m)
        assert found.converged
        return found.y

    exact = prediction.jacobian[:, k]
    assert np.linalg.norm(exact) > 1e-3
    # Errors are a hundredth of the pressure: steps relative to them would be lost in round-off.
    _, fine, best = step_study(exact, run, M, k, 8e-4 if k < len(NAMES) else 1.6e-2)
    assert fine < 1e-5
    assert best < 1e-7


def test_pressures_that_leave_none_are_no_prediction(frames):
    both, _, _ = frames
    gone = np.array([*AT, 1.0, -100.0, 0.0, 0.0])
    assert "leave none" in both(gone).reason


@pytest.mark.parametrize(
    ("names", "errors", "message"),
    [
        (NAMES, (f"{ERROR}.late",), "'pressure_error.late'; expected some of pressure_offset"),
        (MODULI, (OFFSET,), "need pressure_scale among the parameters"),
    ],
)
def test_errors_are_of_frames_that_there_are(names, errors, message):
    with pytest.raises(InputError, match=message):
        FramesModel(model_of(CLOSING, names), "systole", {}, 100.0, errors)
