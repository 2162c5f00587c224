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


def unknowns(estimate: Any, std: Any, bound: Any = None, start: Any = (5.0, 3.0)) -> Any:
    columns = [
        (None, None) if values is None else np.asarray(values, dtype=float).tolist()
        for values in (start, estimate, std, bound, TRUTH)
    ]
    return tuple(
        Unknown(name=name, unit="MPa", prior_mean=m, estimate=e, std=s, bound=b, truth=t)
        for name, m, e, s, b, t in zip(NAMES, *columns, strict=True)
    )


def run(
    seed: int,
    estimate: Any,
    std: Any,
    *,
    bound: Any = None,
    start: Any = (5.0, 3.0),
    **changes: Any,
) -> EstimateRecord:
    """A converged run in three rounds."""
    estimate = np.asarray(estimate, dtype=float).tolist()
    whole = {
        "seed": seed,
        "simulated": True,
        "status": "converged",
        "reason": "converged: the change of every parameter is below the tolerance",
        "unknowns": unknowns(estimate, std, bound, start),
        "distance_mm": Spread(mean=0.02, std=0.015, max=0.2),
        "iterations": 2,
        "forward_solves": 3,
        "iterates": (start, (6.0, 2.0), estimate),
        "seconds": 9.6,
    }
    return EstimateRecord(**{**whole, **changes})


def failed_run(seed: int, reason: str, estimate: Any = None, std: Any = None) -> EstimateRecord:
    return EstimateRecord(
        seed=seed,
        simulated=True,
        status="failed",
        reason=reason,
        unknowns=unknowns(estimate, std),
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


def noise(seeds: int = 20) -> Sweep:
    """White noise at four levels with errors of its size, and an offset at one."""
    rng = np.random.default_rng(2)
    jobs = []
    for kind, level, shift in [("white", v, 0.0) for v in (0.0, 0.1, 0.5, 2.0)] + [
        ("off", 0.5, 3.0)
    ]:
        std = np.array([0.23, 0.05]) * max(level, 0.01)
        runs = [
            run(s, TRUTH - shift * TRUTH / 6 + rng.normal(0, 1, 2) * std, std, bound=std)
            for s in range(1, seeds + 1)
        ]
        jobs.append(job({"kind": kind, "noise_mm": level}, runs))
    return sweep("noise", jobs)


def lost(whole: Sweep) -> Sweep:
    """The same with every job dead."""
    gone = {"estimates": (), "status": "failed", "reason": "killed"}
    jobs = tuple(
        one.model_copy(update={"record": one.record.model_copy(update=gone)}) for one in whole.jobs
    )
    return whole.model_copy(update={"jobs": jobs})
