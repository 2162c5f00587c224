"""What the closed valve of a case is like, and by which tissue its moduli are known."""

import numpy as np

from mvest.closure.physiology import closed_loads, modulus_parts, physiology, resistance_rows
from mvest.estimation.evidence import LearnedNoise
from mvest.mechanics.resistance import has_one_layer
from mvest.mechanics.valve_system import held_loading
from mvest.personalisation.errors import FrameErrors
from mvest.personalisation.sources import ClosedValve
from mvest.problem.record import Row


def closed_details(
    valve: ClosedValve, errors: FrameErrors, learned: LearnedNoise | None = None
) -> dict[str, tuple[Row, ...]]:
    """``physiology`` and ``resistance`` as in `mvest.personalisation.record`.

    The information is that of all fitted frames about each modulus, all else known, with all errors
    besides the samples. Nothing if a frame has no equilibrium, or the closure ends in none.
    """
    model, at, states = valve.closure()
    ends = model.rests(at, states) if model.settings.protocol.equilibrium else ()
    if not ends or not ends[-1].converged:
        return {}
    system, _ = model.tuned(at)
    closed, *others = [end.frames[-1] for end in ends]
    whitened = None
    if has_one_layer(model.mesh):
        loads = [held_loading(system, model.contact_valve, state)(0.0) for state in states]
        held = [modulus_parts(model, at, *one) for one in zip(others, loads, strict=True)]
        last = modulus_parts(model, at, closed, closed_loads(model, system))
        moves = np.stack([np.zeros_like(last), *held, last])
        moves = valve.turned(moves.reshape(*moves.shape[:3], -1))
        rows = valve.rows(errors.fitted.observation(), moves)
        whitened = errors.noise(learned).whiten(rows).reshape(len(rows), *last.shape[2:])
    return {
        "physiology": tuple(physiology(model, system, closed)),
        "resistance": tuple(resistance_rows(model, at, closed, whitened)),
    }
