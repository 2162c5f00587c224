"""The details of a closed valve: information by all fitted frames, as they are observed."""

from types import SimpleNamespace

import numpy as np
import pytest

from mvest.closure.frames import FramesModel
from mvest.closure.physiology import closed_loads, modulus_parts
from mvest.estimation.noise import observation_noise
from mvest.mechanics.resistance import WAYS
from mvest.mechanics.settings import ClosureProtocol
from mvest.mechanics.valve_system import HeldState, held_loading
from mvest.observation.vertices import Observation
from mvest.personalisation.closed import closed_details
from mvest.personalisation.sources import ClosedValve
from mvest.problem.registration import RegisteredModel
from tests.closure.test_model import AT, GENTLE, SMALL, model_of


def test_information_is_that_of_all_frames_as_they_are_seen():
    model = model_of(GENTLE, **SMALL)
    end = model.contact_valve.motion
    state = HeldState(0.3, end.annulus[-1], end.papillary_tips[-1])
    frames = FramesModel(model, "closed", {"held": state}, GENTLE.pressure_mmHg)
    registered = RegisteredModel(frames, (*model.names, "turn.z"))
    m, n = np.array([*AT, 90.0]), len(model.valve.surface.vertices)
    predicted = registered(m)
    seen = Observation(
        ("held", "closed"), np.zeros((2, n, 3)), np.array(1.0), predicted=("open", "held", "closed")
    )
    # Each frame and coordinate has its own error.
    std = np.concatenate([np.tile([0.1, 5.0, 2.0], n), np.tile([3.0, 0.2, 1.0], n)])
    errors = SimpleNamespace(
        fitted=SimpleNamespace(observation=lambda: seen),
        noise=lambda learned: observation_noise(std**2, 6 * n),
    )
    details = closed_details(ClosedValve(registered, m, predicted.y), errors)
    assert {row["quantity"] for row in details["physiology"]} >= {"tenting volume", "area"}
    found = {row["part"]: row for row in details["resistance"] if row["of"] != "strain energy"}
    # By hand: the turned parts (x, y, z -> -y, x, z) of both frames, each over its error.
    closed, held = (one.frames[-1] for one in model.rests(AT, [state]))
    system, _ = model.tuned(AT)
    loads = [held_loading(system, model.contact_valve, state)(0.0), closed_loads(model, system)]
    parts = [modulus_parts(model, AT, x, p) for x, p in zip((held, closed), loads, strict=True)]
    turned = [np.stack([-own[:, 1], own[:, 0], own[:, 2]], axis=1) for own in parts]
    white = np.concatenate([own.reshape(3 * n, 2, 4) for own in turned]) / std[:, None, None]
    J = white.sum(axis=2)
    np.testing.assert_allclose(J, predicted.jacobian[3 * n :, :2] / std[:, None], atol=1e-5)
    for k, name in enumerate(("anterior", "posterior")):
        expected = 100 * J[:, k] @ white[:, k] / (J[:, k] @ J[:, k])
        assert [found[name][way] for way in WAYS] == pytest.approx(expected, abs=1e-6)


def test_nothing_is_said_of_a_valve_that_is_not_at_rest():
    moving = ClosureProtocol(pressure_mmHg=0.3, ramp=0.1, dt=0.1, end=0.1, equilibrium=False)
    model = model_of(moving, **SMALL)
    registered = RegisteredModel(model, model.names)
    valve = ClosedValve(registered, AT, np.zeros(6 * len(model.valve.surface.vertices)))
    assert closed_details(valve, None) == {}
