"""Collected sweeps as they could come from the valve, made up with a fixed seed.

Numbers are near those of the real model: Cramér–Rao standard deviations of 0.18 and 0.06 MPa for
1 mm of independent noise, a paper's filter that fails from far away. Some jobs fail.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from experiments.sweeps.collected import SCHEMA, Cost, Sweep, check_sweep

TRUTH = np.array([6.23, 2.09])
BOUND_PER_MM = np.array([0.183, 0.058])
FAILED = {
    "memory": "killed: out of memory (signal 9)",
    "time": "stopped after the time limit of 600 s",
    "model": "not converged: the model gives no prediction where the filter needs one",
}


def _hash(*what: Any) -> str:
    return hashlib.sha256(repr(what).encode()).hexdigest()[:16]


def run(
    seed: int,
    estimate: Any,
    std: Any,
    *,
    bound: Any = None,
    start: Any = (5.0, 3.0),
    **changes: Any,
) -> dict[str, Any]:
    """A converged run that approaches its estimate by a factor of 5 a round."""
    estimate, std = np.asarray(estimate, float), np.asarray(std, float)
    rounds = int(changes.pop("iterations", 5))
    shrink = np.append(0.2 ** np.arange(rounds), 0.0)[:, None]
    iterates = estimate + (np.asarray(start) - estimate) * shrink
    entry: dict[str, Any] = {
        "seed": seed,
        "status": "converged",
        "reason": "converged: the change of every parameter is below the tolerance",
        "detail": f"{rounds} rounds",
        "estimate": estimate.tolist(),
        "std": std.tolist(),
        "relative_error": ((estimate - TRUTH) / TRUTH).tolist(),
        "bound": None if bound is None else np.asarray(bound, float).tolist(),
        "distance_mm": {"mean": 0.02, "std": 0.015, "max": 0.2},
        "distance_to_truth_mm": {"mean": 0.02, "std": 0.015, "max": 0.2},
        "nis": 19500.0,
        "nis_band": [19102.9, 19876.8],
        "iterations": rounds,
        "forward_solves": rounds + 1,
        "iterates": iterates.tolist(),
        "iterate_std": [[3.0, 3.0], *([std.tolist()] * rounds)],
        "seconds": 3.2 * (rounds + 1),
    }
    return entry | changes


def failed_run(seed: int, reason: str, **changes: Any) -> dict[str, Any]:
    absent = "estimate std relative_error bound distance_mm distance_to_truth_mm nis nis_band"
    nothing = dict.fromkeys([*absent.split(), "iterates", "iterate_std"])
    entry: dict[str, Any] = {
        "seed": seed,
        "status": "failed",
        "reason": reason,
        "detail": "",
        **nothing,
        "iterations": 2,
        "forward_solves": 3,
        "seconds": 9.0,
    }
    return entry | changes


def job(
    factors: dict[str, Any], runs: list[dict[str, Any]], reason: str = "", **changes: Any
) -> dict[str, Any]:
    good = bool(runs) and all(entry["status"] == "converged" for entry in runs)
    entry = {
        "hash": _hash(factors, changes.get("row")),
        "row": ", ".join(f"{name} {value}" for name, value in factors.items()),
        "factors": factors,
        "status": "converged" if good else "failed",
        "reason": reason or (runs[0]["reason"] if runs else "died"),
        "model": {"element": "hex18", "cells": [36, 4, 1], "filter": "iterated", "noise_mm": 0.0},
        "initial": [5.0, 3.0],
        "truth": TRUTH.tolist(),
        "P0": 9.0,
        "Q": 0.0,
        "R": 0.01,
        "filter": "iterated",
        "runs": runs,
    }
    return entry | changes


def sweep(kind: str, jobs: Iterable[dict[str, Any]], **changes: Any) -> Sweep:
    return check_sweep(sweep_data(kind, jobs, **changes), "made up")


def sweep_data(kind: str, jobs: Iterable[dict[str, Any]], **changes: Any) -> dict[str, Any]:
    """The same as ``sweep.json`` holds it."""
    jobs = list(jobs)
    seconds = [sum(entry["seconds"] for entry in found["runs"]) for found in jobs]
    entry: dict[str, Any] = {
        "schema": SCHEMA,
        "sweep": {"name": kind, "size": "small", "kind": kind},
        "title": f"Sweep over {kind.replace('_', ' ')}",
        "parameters": ["E_f.anterior", "E_f.posterior"],
        "paper": None,
        "truth_hits": max(len(jobs) - 1, 0),
        "truth_misses": min(len(jobs), 1),
        "provenance": {
            "git": {"sha": "0123456789abcdef" * 2 + "01234567", "dirty": False},
            "versions": {"mvest": "0.1.0"},
            "config_hash": "cd" * 32,
            "mesh_hash": "ab" * 32,
            "seed": 1,
            **{"threads": {}, "python": "3.12", "platform": "Linux", "machine": "x86_64"},
            **{"cpu_count": 2, "finished": "2024-01-01T00:00:00Z"},
        },
        "settings": {
            "filter": {"transform": "identity", "tolerance": 1e-4, "max_iterations": 30},
            "mesh": {"source": "structured", "columns": 36, "rows": 4, "layers": 1},
            "observation": {"columns": 112, "rows": 29, "frames": ["open", "closed"]},
        },
        "jobs": jobs,
        "cost": [
            {
                "hash": found["hash"],
                "seconds": time if found["runs"] else None,
                "seconds_total": time + 0.3 if found["runs"] else None,
            }
            for found, time in zip(jobs, seconds, strict=True)
        ],
    }
    return entry | changes


def initial_guess() -> Sweep:
    rng = np.random.default_rng(1)
    jobs = []
    for mode in ("iterated", "paper"):
        for a in np.geomspace(1, 12, 6).round(2).tolist():
            for b in np.geomspace(0.5, 8, 6).round(2).tolist():
                start = np.array([a, b])
                far = float(np.linalg.norm(np.log(start / TRUTH)))
                factors = {"start_anterior": a, "start_posterior": b, "filter": mode}
                extra = {
                    "initial": [a, b],
                    "filter": mode,
                    "P0": 9.0 if mode == "iterated" else 0.01,
                }
                if (mode == "paper" and b < 0.6 and a > 3) or (a == 12.0 and b == 8.0):
                    reason = FAILED["model"] if mode == "paper" else FAILED["memory"]
                    runs = [failed_run(1, reason)] if mode == "paper" else []
                    jobs.append(job(factors, runs, reason, **extra))
                    continue
                error = 10 ** (rng.normal(-4.6, 0.4, 2))
                rounds = 4 + int(far)
                if mode == "paper":
                    error = 10 ** (rng.normal(-4.8, 0.3, 2) + 2.1 * max(far - 0.8, 0))
                    rounds = 6 + int(4 * far)
                estimate = TRUTH * (1 + np.minimum(error, 0.6) * rng.choice([-1, 1], 2))
                runs = [run(1, estimate, [0.0229, 0.0049], start=start, iterations=rounds)]
                jobs.append(job(factors, runs, **extra))
    paper = {
        "table": "Table 1",
        "estimate": [6.02, 2.13],
        "error_percent": [3.37, 1.91],
        "moduli_error_percent": [2.84, 0.67],
        "distance_mm": [0.06, 0.07],
    }
    return sweep("initial_guess", jobs, paper=paper, title="Initial guess of the moduli")


def covariance() -> Sweep:
    jobs = []
    for mode in ("iterated", "paper"):
        for varied in ("P0", "Q", "R", "all"):
            for scale in (0.01, 0.1, 1.0, 10.0, 100.0):
                ratio = {"P0": 1 / scale, "Q": 1.0, "R": scale, "all": 1.0}[varied]
                prior = 3.0 if mode == "iterated" else 0.1 * (scale if varied == "Q" else 1.0)
                std = 0.2 * BOUND_PER_MM * np.sqrt(scale if varied in ("R", "all") else 1.0)
                pull = ratio * (std / prior) ** 2
                estimate = TRUTH + pull * (np.array([5.0, 3.0]) - TRUTH) / (1 + pull) + 1e-5
                factors = {"varied": varied, "scale": scale, "filter": mode}
                if mode == "paper" and varied == "R" and scale == 100.0:
                    jobs.append(job(factors, [], FAILED["time"], filter=mode))
                else:
                    jobs.append(job(factors, [run(1, estimate, std)], filter=mode))
    return sweep("covariance", jobs, title="Prior, process and observation covariance")


def noise(seeds: int = 40) -> Sweep:
    rng = np.random.default_rng(2)
    inflate = {"white": 1.0, "correlated": 2.4, "dropout": 1.15, "annulus": 1.7}
    jobs = []
    for kind, factor in inflate.items():
        for level in (0.0, 0.1, 0.5, 1.0, 1.5):
            bound = BOUND_PER_MM * max(level, 0.01) * (1.1 if kind == "dropout" else 1.0)
            shift = np.array([-0.03, 0.012]) if kind == "annulus" else np.zeros(2)
            runs = []
            for seed in range(1, seeds + 1):
                if kind == "correlated" and level == 1.5 and seed % 13 == 0:
                    runs.append(failed_run(seed, FAILED["model"]))
                    continue
                error = rng.normal(0, factor if level else 0.02, 2) * bound
                runs.append(run(seed, TRUTH + error + shift * level, bound, bound=bound))
            reason = ""
            if kind == "dropout" and level == 1.5:
                runs, reason = [], FAILED["memory"]
            model = {"element": "hex18", "cells": [36, 4, 1], "noise_mm": level}
            more = {"model": model, "seed": 1, "repeats": seeds}
            jobs.append(job({"kind": kind, "noise_mm": level}, runs, reason, **more))
    return sweep("noise", jobs, title="Noise of the observation")


def discrepancy() -> Sweep:
    percent = {
        "none": (0.0004, 0.0002),
        "finer mesh": (-0.8, 1.3),
        "smaller time step": (0.001, -0.002),
        "other element": (-1.4, -7.2),
        "other law": (3.1, -2.2),
        "pressure +10 %": (-10.6, -12.4),
        "pressure -10 %": (11.3, 13.5),
        "chords +5 %": (-30.5, -57.4),
        "rest length -5 %": (25.1, 38.2),
        "annulus 1 mm": (13.0, 38.0),
    }
    jobs = [
        job({"discrepancy": name}, [run(1, TRUTH * (1 + np.array(e) / 100), [0.0229, 0.0049])])
        for name, e in percent.items()
    ]
    jobs.append(job({"discrepancy": "chords -5 %"}, [], FAILED["model"]))
    return sweep("discrepancy", jobs, title="Discrepancy between the truth and the model")


def filters(seeds: int = 12) -> Sweep:
    rng = np.random.default_rng(3)
    made = {
        "iterated": (1.0, 5),
        "paper": (1.3, 8),
        "extended": (2.1, 1),
        "unscented": (1.05, 30),
        "ensemble": (1.8, 60),
    }
    jobs = []
    for name, (factor, rounds) in made.items():
        bound = 0.5 * BOUND_PER_MM
        runs = [
            run(s, TRUTH + rng.normal(0, factor, 2) * bound, bound, bound=bound, iterations=rounds)
            for s in range(1, seeds + 1)
        ]
        jobs.append(job({"filter": name}, runs, filter=name))
    jobs.append(job({"filter": "gradient descent"}, [], FAILED["time"], filter="gradient descent"))
    return sweep("filter", jobs, title="Filters on the same observations")


def unknown() -> Sweep:
    jobs = [job({"moon_phase": phase}, [run(1, TRUTH * 1.01, [0.02, 0.005])]) for phase in (0, 1)]
    return sweep("astrology", jobs, title="Something else")


ALL: dict[str, Callable[[], Sweep]] = {
    "initial_guess": initial_guess,
    "covariance": covariance,
    "noise": noise,
    "discrepancy": discrepancy,
    "filter": filters,
    "astrology": unknown,
}


def all_failed(kind: str) -> Sweep:
    """The sweep of this kind with every job dead."""
    whole = ALL[kind]()
    jobs = tuple(
        replace(lost, runs=(), status="failed", reason=FAILED["memory"]) for lost in whole.jobs
    )
    return replace(whole, jobs=jobs, cost=tuple(Cost(job.hash, None, None) for job in jobs))


def empty(kind: str) -> Sweep:
    """The sweep of this kind without a job."""
    return replace(ALL[kind](), jobs=(), cost=())


def correlated_noise(seeds: int = 20) -> Sweep:
    """As `noise`, with one kind over several levels and others at one, two jobs for each."""
    rng = np.random.default_rng(5)
    cases = [("white", level, 0.0, 0.0, 1.0) for level in (0.1, 0.5, 1.0)]
    cases += [
        ("correlated over 5 mm", 0.0, 0.5, length, 5.0 - 0.8 * length) for length in (0.0, 5.0)
    ]
    cases += [("white, coaptation hidden", 0.5, 0.0, 0.0, 1.1)]
    cases += [("white, annulus 1 mm off", 0.5, 0.0, 0.0, 6.0)]
    jobs = []
    for kind, level, correlated, length, factor in cases:
        for first in (1, 1 + seeds):
            bound = BOUND_PER_MM * max(level, correlated)
            runs = [
                run(s, TRUTH + rng.normal(0, factor, 2) * bound, bound, bound=bound)
                for s in range(first, first + seeds)
            ]
            factors = {"kind": kind, "noise_mm": level, "correlated_mm": correlated}
            factors |= {"R": max(level, correlated) ** 2, "R_correlation_mm": length}
            jobs.append(job(factors, runs, row=f"{kind} {first}", seed=first, repeats=seeds))
    return sweep("noise", jobs, title="Estimates from noisy observations")


def covariance_values() -> Sweep:
    """As `covariance`, over values of P0, Q and R."""
    jobs = []
    for mode in ("paper", "iterated"):
        for p0 in (1e-4, 0.01, 1.0, 9.0):
            for q in (0.0, 1e-4, 0.01, 1.0) if mode == "paper" else (0.0,):
                for r in (0.01, 0.25):
                    std = BOUND_PER_MM * r**0.5
                    pull = (std / (p0 + 5 * q) ** 0.5) ** 2
                    estimate = TRUTH * (1 + np.array([0.011, -0.008]))
                    estimate += pull * (np.array([5.0, 3.0]) - TRUTH) / (1 + pull)
                    factors = {"filter": mode, "P0": p0, "Q": q, "R": r}
                    lost = mode == "paper" and p0 == 1e-4 and q == 1.0
                    runs = [] if lost else [run(1, estimate, std)]
                    jobs.append(job(factors, runs, FAILED["model"] if lost else "", filter=mode))
    return sweep("covariance", jobs, title="Estimates under covariances")


def filter_conditions() -> Sweep:
    """As `filters`, in two coordinates, from two starts, without noise and with it."""
    rng = np.random.default_rng(4)
    jobs = []
    for start, level in (((5.0, 3.0), 0.0), ((9.0, 6.0), 0.0), ((5.0, 3.0), 0.5)):
        for mode in ("paper", "iterated"):
            for transform in ("identity", "log"):
                bound = BOUND_PER_MM * max(level, 1e-4)
                n = 5 if level else 1
                runs = [
                    run(s, TRUTH + rng.normal(0, 1, 2) * bound, bound, bound=bound)
                    for s in range(1, n + 1)
                ]
                factors = {"filter": mode, "transform": transform, "start_anterior": start[0]}
                factors |= {"start_posterior": start[1], "noise_mm": level}
                lost = transform == "identity" and start[0] == 9.0
                reason = FAILED["model"] if lost else ""
                jobs.append(job(factors, [] if lost else runs, reason, filter=mode))
    return sweep("filter", jobs, title="Filters side by side")


def truths() -> Sweep:
    """As `discrepancy`, named by the truth."""
    whole = discrepancy()
    names = [job.factors["discrepancy"] for job in whole.jobs]
    jobs = [
        replace(job, factors={"truth": "same model" if name == "none" else name})
        for job, name in zip(whole.jobs, names, strict=True)
    ]
    return replace(whole, jobs=tuple(jobs))


VARIANTS: dict[str, Callable[[], Sweep]] = {
    "correlated_noise": correlated_noise,
    "covariance_values": covariance_values,
    "filter_conditions": filter_conditions,
    "truths": truths,
}
"""The same kinds with their factors named in other ways."""
