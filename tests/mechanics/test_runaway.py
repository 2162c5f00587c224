"""Iterates that run away end a step; they cost neither the run nor the machine its memory."""

import numpy as np
import pytest

from mvest.mechanics import integrate
from mvest.mechanics.integrate import _largest_step, _StepError
from mvest.mechanics.steps import StepReason
from tests.closure.test_model import AT, CLOSING, TINY, model_of


class NoRoom:
    def largest_step(self, pairs, y, dy, *, detect):
        raise MemoryError("std::bad_alloc")


def test_collision_detection_without_room_is_a_failed_step():
    with pytest.raises(_StepError) as raised:
        _largest_step(NoRoom(), None, np.zeros((1, 3)), np.ones((1, 3)), detect=False)
    assert raised.value.reason is StepReason.NO_CONVERGENCE


def test_a_step_that_leaves_the_body_behind_is_a_failed_one(monkeypatch):
    # The limit is on the iterations of one step: a body that may not move at all closes nowhere.
    monkeypatch.setattr(integrate, "RUNAWAY", 1e-4)
    simulation = model_of(CLOSING, **TINY).close(AT, sensitivities=False).simulation
    assert not simulation.converged
    assert simulation.reason is StepReason.NO_CONVERGENCE
