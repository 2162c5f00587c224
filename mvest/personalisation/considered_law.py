"""What another law of the tissue would do to what a model predicts, as an error of it.

A case is estimated with the linear law. Tissue stiffens: at the same mean stress its shape is
another, and moduli fitted to it are then off as if they were known well. So one leaflet after
another is given an exponential tissue that is as stiff as the linear one where it is stretched as
closed leaflets are, and the equilibrium is looked for from the closed valve. By how much that moves
what is observed is a column of the covariance of its errors, one standard deviation of how far the
tissue is on its way from one law to the other: to first order a quantity that is estimated with the
moduli, from what is seen of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mvest.closure.model import ClosureModel
from mvest.estimation.noise import ErrorColumns
from mvest.mechanics.law.exponential import as_stiff
from mvest.mechanics.settings import ExponentialTissue
from mvest.mechanics.steps import Simulation
from mvest.mechanics.valve_system import HeldState
from mvest.personalisation.considered_geometry import closure_at, observed_change
from mvest.problem.problem import Observed
from mvest.problem.registration import RegisteredModel
from mvest.typing import FloatArray

LAW = "law"
"""What the columns are called."""


def law_columns(
    tissue: Mapping[str, ExponentialTissue],
    registered: RegisteredModel,
    observation: Observed,
    m: FloatArray,
    predicted: FloatArray,
) -> tuple[ErrorColumns, ...] | str:
    """Errors of an observation from those of the law, or why there are none.

    Parameters
    ----------
    tissue : mapping
        Region -> exponential tissue, of which only the shape of its curve counts.
    registered : RegisteredModel
        Of the case; its last closed state is gone on from.
    observation : Observed
        Of the case.
    m : (p,)
        Parameters at which the tissues are as stiff as the linear ones.
    predicted : array
        All frames as predicted at ``m``, stacked.
    """
    change = law_change(*closure_at(registered, m), tissue)
    if isinstance(change, str):
        return change
    return (ErrorColumns(LAW, observed_change(registered, observation, m, predicted, change)),)


def law_change(
    model: ClosureModel,
    m: FloatArray,
    states: Sequence[HeldState],
    tissue: Mapping[str, ExponentialTissue],
) -> FloatArray | str:
    """Change ``(f, n, 3, q)`` mm of the observed valve with another law, or why there is none.

    The open valve is the first frame and stays, the closed one the last; the states come between
    them. Leaflets that have another tissue are asked one after another, on the mesh of the guide
    where there is one: a closure that follows no guide takes as long as an estimation on the other.

    Parameters
    ----------
    model : ClosureModel
        Its last closed state is gone on from.
    m : (p,)
        Parameters of the closure.
    states : sequence of HeldState
        Under other loads, gone to from the closed valve.
    tissue : mapping
        As for `law_columns`.
    """
    model = model.guide or model
    at = np.asarray(m, dtype=np.float64)
    first = model.rests(at, states)
    if not first[-1].converged:
        return first[-1].reason.value
    values = {**model.fixed, **dict(zip(model.names, map(float, at), strict=True))}
    changes = []
    for region, linear in model.settings.tissue.items():
        name = f"E_f.{region}"
        if region not in tissue or name not in values:
            continue
        own = as_stiff(tissue[region], linear, values[name])
        stiffening = replace(linear, law="exponential", exponential=own)
        other = replace(
            model.fresh(),
            settings=replace(model.settings, tissue={**model.settings.tissue, region: stiffening}),
            names=tuple(known for known in model.names if known != name),
            fixed={known: value for known, value in model.fixed.items() if known != name},
            guide=None,
        )
        kept = at[[known != name for known in model.names]]
        moved = other.rests(kept, states, start=first[0].frames[-1])
        if not moved[-1].converged:
            return f"{region} of an exponential law: {moved[-1].reason.value}"
        changes.append(_observed(model, moved) - _observed(model, first))
    n = len(model.valve.surface.vertices)
    return np.stack(changes, axis=-1) if changes else np.zeros((2 + len(states), n, 3, 0))


def _observed(model: ClosureModel, ends: Sequence[Simulation]) -> FloatArray:
    """The observed valve ``(f, n, 3)`` mm: open, under the states, closed."""
    closed, *others = [model.observed(end.frames[-1]) for end in ends]
    return np.stack([model.observed(model.mesh.nodes), *others, closed])
