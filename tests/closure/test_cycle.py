"""The whole cycle on a few elements: its frames, its steps, and its derivatives in every frame."""

import numpy as np
import pytest

from mvest.closure.cycle import CycleModel, CycleProtocol, compare_time_steps
from mvest.closure.model import ClosureModel
from mvest.errors import InputError
from mvest.mechanics.settings import MechanicsSettings, TissueSettings
from mvest.mechanics.steps import NewtonSettings
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.structured import structured_mesh

NAMES = ("E_f.anterior", "E_f.posterior", "pressure_scale", "chord_rest_length")
# Chordae 6 % shorter than usual, so that they pull from the first step on.
AT = np.array([6.0, 4.0, 1.1, 0.94])
TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
EXACT = NewtonSettings(tolerance=1e-13, smallest_move=1e-11)
TIMES = (0.0, 0.05, 0.1, 0.2)
PROTOCOL = CycleProtocol(20.0, rise=0.1, hold=0.02, fall=0.08, dt=0.05, times=TIMES)
TEMPLATE = Template()


def model_of(protocol: CycleProtocol = PROTOCOL) -> CycleModel:
    closure = ClosureModel(
        TEMPLATE.valve(16, 5),
        TEMPLATE.valve(16, 5),
        structured_mesh(TEMPLATE, "hex18", 8, 1),
        MechanicsSettings(TISSUE, newton=EXACT),
        NAMES,
    )
    return CycleModel(closure, protocol)


@pytest.fixture(scope="module")
def cycle():
    model = model_of()
    return model, model(AT)


def test_the_phase_rises_stays_and_falls():
    p = CycleProtocol(rise=0.2, hold=0.1, fall=0.4)
    # The quintic is antisymmetric about the middle of its step, where it is 1/2.
    found = [p.phase(t) for t in (-1.0, 0.0, 0.1, 0.2, 0.25, 0.3, 0.5, 0.7, 2.0)]
    assert found == pytest.approx([0, 0, 0.5, 1, 1, 1, 0.5, 0, 0], abs=1e-12)


def test_steps_meet_every_frame_and_are_no_larger_than_dt():
    p = CycleProtocol(dt=0.025, times=(0.0, 0.05, 0.06, 0.15))
    times = [step.time for step in p.steps()]
    # 0.05 in two steps, 0.01 in one, 0.09 in ceil(3.6) = 4.
    assert times == pytest.approx([0.025, 0.05, 0.06, 0.0825, 0.105, 0.1275, 0.15])
    assert p.frame_steps == (0, 2, 3, 7)
    assert p.frames == ("0 s", "0.05 s", "0.06 s", "0.15 s")


def test_sets_of_frames_are_spread_over_the_cycle():
    p = CycleProtocol(rise=0.3, hold=0.1, fall=0.3, times=tuple(0.05 * k for k in range(15)))
    sets = p.frame_sets()
    assert sets["open and closed"] == [0, 8]
    assert sets["3 frames, evenly"] == [0, 7, 14]
    assert sets["5 frames, evenly"] == [0, 4, 7, 10, 14]
    assert [len(s) for s in sets.values()] == [2, 3, 5, 8, 15, 5, 3, 6]
    with pytest.raises(InputError, match="expected one on the plateau"):
        CycleProtocol(times=(0.0, 0.1)).frame_sets()


@pytest.mark.parametrize(
    "wrong",
    [{"dt": 0.0}, {"times": (0.1, 0.1)}, {"times": (-0.1, 0.1)}, {"times": (0.0,)}, {"rise": 0.0}],
)
def test_a_protocol_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(InputError):
        CycleProtocol(**wrong)


def test_frames_are_the_open_valve_and_those_of_the_motion(cycle):
    model, prediction = cycle
    frames = prediction.y.reshape(len(TIMES), -1, 3)
    rest = model.closure.valve.surface.vertices
    np.testing.assert_allclose(frames[0], rest, atol=1e-9)
    assert not prediction.jacobian[: rest.size].any()
    moved = np.linalg.norm(frames - rest, axis=2).max(axis=1)
    assert moved[2] > 1.0  # mm
    # Unloaded, but held back by the damping of the tissue: on its way, not at home.
    assert 0.1 * moved[2] < moved[3] < moved[2]
    np.testing.assert_array_equal(model.frames(AT), frames)


def test_derivatives_of_every_frame_agree_with_differences(cycle):
    # The error of a central difference falls as h^2: (16 D(h/4) - D(h)) / 15 is free of it. The
    # last frame comes after the load has gone: velocity and history of strain are all that is left.
    model, prediction = cycle
    for k, name in enumerate(NAMES):
        exact = prediction.jacobian[:, k].reshape(len(TIMES), -1)[1:]
        size = np.linalg.norm(exact, axis=1)
        assert size.min() > 1e-4, name
        # Chordae that go slack have a kink in stiffness: their length needs a smaller step.
        step = 4e-5 if name == "chord_rest_length" else 1.6e-3
        differences = []
        for relative in (step, step / 4):
            h = relative * AT[k] * np.eye(len(AT))[k]
            moved = model.frames(AT + h) - model.frames(AT - h)
            differences.append(moved.reshape(len(TIMES), -1)[1:] / (2 * h[k]))
        errors = [np.linalg.norm(d - exact, axis=1) / size for d in differences]
        best = (16 * differences[1] - differences[0]) / 15
        assert (errors[0] / errors[1]).max() == pytest.approx(16, rel=0.15), name
        assert (np.linalg.norm(best - exact, axis=1) / size).max() < 1e-6, name


def test_frames_converge_with_the_first_order_in_the_time_step():
    # Backward Euler: the difference between steps dt and dt/2 halves with dt.
    path = np.array([AT, 1.01 * AT])
    found = compare_time_steps(model_of(), (0.0125, 0.00625, 0.003125), path)
    assert found[0]["order"] == pytest.approx(1.0, abs=0.15)
    assert found[0]["change"] / found[1]["change"] == pytest.approx(2.0 ** found[0]["order"])
    assert found[2]["change"] is None
    assert [(one["unevenness"], one["reason"]) for one in found] == [(1.0, "")] * 3
    with pytest.raises(InputError, match="half of the one before"):
        compare_time_steps(model_of(), (0.05, 0.02), path)
