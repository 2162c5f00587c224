"""Collected sweeps that no run made: two moduli of 6.23 and 2.09 MPa, by a few lines each."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from experiments.common.records.record import Model
from experiments.sweeps.collected import Sweep, SweptJob
from mvest.problem.record import EstimateRecord, Spread, Unknown
from tests.experiments.studies.made_up import NAMES, SOURCE, made_up

TRUTH = np.array([6.23, 2.09])


def unknowns(estimate: Any, std: Any, bound: Any = None) -> Any:
    columns = [
        (None, None) if values is None else np.asarray(values, dtype=float).tolist()
        for values in ((5.0, 3.0), estimate, std, bound, TRUTH)
    ]
    return tuple(
        Unknown(name=name, unit="MPa", prior_mean=m, estimate=e, std=s, bound=b, truth=t)
        for name, m, e, s, b, t in zip(NAMES, *columns, strict=True)
    )


def run(seed: int, estimate: Any, std: Any, *, bound: Any = None) -> EstimateRecord:
    """A converged run in three rounds."""
    return EstimateRecord(
        seed=seed,
        simulated=True,
        status="converged",
        reason="converged: the change of every parameter is below the tolerance",
        unknowns=unknowns(estimate, std, bound),
        distance_mm=Spread(mean=0.02, std=0.015, max=0.2),
        iterations=2,
        forward_solves=3,
        seconds=9.6,
    )


def failed_run(seed: int, reason: str) -> EstimateRecord:
    return EstimateRecord(
        seed=seed,
        simulated=True,
        status="failed",
        reason=reason,
        unknowns=unknowns(None, None),
        iterations=2,
        forward_solves=3,
        seconds=9.0,
    )


def job(
    factors: dict[str, Any],
    runs: Sequence[EstimateRecord],
    reason: str = "died",
    row: str = "",
    **changes: Any,
) -> SweptJob:
    good = bool(runs) and all(one.converged for one in runs)
    row = row or ", ".join(f"{name} {value}" for name, value in factors.items())
    digest = hashlib.sha256(repr((factors, row)).encode()).hexdigest()
    record = made_up(
        study="twin",
        experiment="sweep",
        table="sweep",
        row=row,
        factors=factors,
        status="converged" if good else "failed",
        reason="completed" if good else reason,
        parameters=NAMES,
        model=Model(element="hex18", cells=(36, 4, 1), filter="iterated", noise_mm=0.5),
        provenance=SOURCE.model_copy(update={"config_hash": digest}),
        seconds_total=sum(one.seconds or 0.0 for one in runs) + 0.3,
        estimates=tuple(runs),
    )
    first = runs[0].seed if runs else 1
    whole = {"hash": digest[:16], "seed": first, "repeats": max(len(runs), 1), "record": record}
    return SweptJob(**{**whole, **changes})


def sweep(name: str, jobs: Iterable[SweptJob], **changes: Any) -> Sweep:
    whole = {
        "name": name,
        "size": "small",
        "title": f"Sweep over {name}",
        "parameters": NAMES,
        "provenance": SOURCE,
        "commits": (SOURCE.git.sha,),
        "settings": {"mesh": {"columns": 36, "rows": 4}},
        "jobs": tuple(jobs),
    }
    return Sweep(**{**whole, **changes})


def lost(whole: Sweep) -> Sweep:
    """The same with every job dead."""
    gone = {"estimates": (), "status": "failed", "reason": "killed"}
    jobs = tuple(
        one.model_copy(update={"record": one.record.model_copy(update=gone)}) for one in whole.jobs
    )
    return whole.model_copy(update={"jobs": jobs})
