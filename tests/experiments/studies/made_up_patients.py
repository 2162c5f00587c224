"""Estimates of virtual patients, made up."""

from typing import Any

from experiments.common.records.record import Mesh, Model, Record
from experiments.common.study import Result
from mvest.problem.record import EstimateRecord, FrameFit, Spread, Unknown
from tests.experiments.studies.made_up import made_up

TRUTH = {"E_f.anterior": 6.0, "E_f.posterior": 2.0, "pressure_scale": 1.05, "shift.x": 0.4}
UNIT = {"E_f": "MPa", "shift": "mm"}


def unknown(name: str, estimate: float | None, half: float) -> Unknown:
    """An unknown with the interval estimate ± half; its prior is 1 ± 1."""
    known = estimate is not None
    return Unknown(
        name=name,
        label=name.replace(".", " "),
        unit=UNIT.get(name.partition(".")[0], ""),
        kind="modulus" if name.startswith("E_f.") else "nuisance",
        prior_mean=1.0,
        prior_std=1.0,
        truth=TRUTH[name],
        estimate=estimate,
        std=half / 1.96 if known else None,
        low=estimate - half if known else None,
        high=estimate + half if known else None,
    )


def moduli(
    anterior: float | None, posterior: float | None, half: float = 0.5
) -> tuple[Unknown, ...]:
    """The moduli of both leaflets."""
    return unknown("E_f.anterior", anterior, half), unknown("E_f.posterior", posterior, half)


def alone(unknowns: tuple[Unknown, ...], reason: str = "converged") -> EstimateRecord:
    """Another estimation."""
    status = "converged" if reason == "converged" else "failed"
    return EstimateRecord(status=status, reason=reason, unknowns=unknowns)


def distances(
    frame: str, seen: bool, generic: float, registered: float, personalised: float
) -> FrameFit:
    """Distances of these means, and of half of them from the truth."""
    means = {"generic": generic, "registered": registered, "personalised": personalised}
    off = {name: Spread(mean=mean, std=0.1, max=3 * mean) for name, mean in means.items()}
    true = {
        f"{name}_to_truth": Spread(mean=mean / 2, std=0.1, max=1.5 * mean)
        for name, mean in means.items()
    }
    return FrameFit(frame=frame, seen=seen, **off, **true)


def patient(name: str = "normal_small", table: str = "patients", **changes: Any) -> Record:
    """Inside for both moduli; without nuisances for one, by the paper's filter for none."""
    whole: dict[str, Any] = {
        "case": name,
        "seed": 1,
        "simulated": True,
        "status": "converged",
        "reason": "converged",
        "unknowns": (
            *moduli(5.8, 2.1),
            unknown("pressure_scale", 1.02, 0.05),
            unknown("shift.x", 0.1, 0.2),
        ),
        "alternatives": {
            "moduli_only": alone(moduli(5.7, 3.1)),
            "paper": alone(moduli(9.0, 4.0), "no rounds left"),
        },
        "frames": (
            distances("closed", True, 2.0, 1.5, 0.5),
            distances("late", False, 1.0, 0.4, 0.8),
        ),
        "details": {"measurements": ({"frame": "open", "annulus_area_mm2": 800.0},)},
    }
    numbers = changes.pop("numbers", {})
    estimate = EstimateRecord(**{**whole, **changes})
    paper = {"paper_generic_mm": 1.5, "paper_personalised_mm": 1.47}
    return made_up(
        study="patient",
        experiment=table,
        table=table,
        row=name,
        status=estimate.status,
        reason=estimate.reason,
        estimates=(estimate,),
        numbers={"anatomies_drawn": 1, "scenario": "reference", "nees": 1.0, "unknowns": 4}
        | paper
        | numbers,
    )


def lost_patient(name: str = "prolapse", table: str = "patients") -> Record:
    """A patient of whom no filter estimated anything."""
    nothing, reason = moduli(None, None), "the model failed"
    return patient(
        name,
        table,
        status="failed",
        reason=reason,
        unknowns=(*nothing, unknown("pressure_scale", None, 0), unknown("shift.x", None, 0)),
        alternatives={"moduli_only": alone(nothing, reason), "paper": alone(nothing, reason)},
        frames=(),
        details={},
        numbers={"nees": None},
    )


def a_result(anterior: float, posterior: float, status: str = "converged") -> Result:
    """What an estimation leaves, with intervals of ± 20 %, before a truth is known."""
    rows = [
        own.model_copy(
            update={"truth": None, "low": 0.8 * own.estimate, "high": 1.2 * own.estimate}
        )
        for own in moduli(anterior, posterior)
        if own.estimate is not None
    ]
    pressure = unknown("pressure_scale", 1.1, 0.1).model_copy(update={"truth": None})
    estimate = EstimateRecord(case="case", status=status, reason=status, unknowns=(*rows, pressure))
    return Result(
        estimates=(estimate,),
        status=estimate.status,
        reason=status,
        parameters=("E_f.anterior", "E_f.posterior"),
        mesh=Mesh(sha256="0" * 64, nodes=1),
        model=Model(element="hex18", cells=(40, 5, 1)),
        gate="not gated",
    )
