"""Estimates of virtual patients, made up."""

from experiments.common.records.record import Mesh, Model
from experiments.common.study import Result
from mvest.problem.record import EstimateRecord, Unknown

TRUTH = {"E_f.anterior": 6.0, "E_f.posterior": 2.0, "pressure_scale": 1.05}


def unknown(name: str, estimate: float, half: float) -> Unknown:
    """An unknown with the interval estimate ± half; its prior is 1 ± 1."""
    return Unknown(
        name=name,
        label=name.replace(".", " "),
        unit="MPa" if name.startswith("E_f.") else "",
        kind="modulus" if name.startswith("E_f.") else "nuisance",
        prior_mean=1.0,
        prior_std=1.0,
        truth=TRUTH[name],
        estimate=estimate,
        std=half / 1.96,
        low=estimate - half,
        high=estimate + half,
    )


def moduli(anterior: float, posterior: float, half: float = 0.5) -> tuple[Unknown, ...]:
    """The moduli of both leaflets."""
    return unknown("E_f.anterior", anterior, half), unknown("E_f.posterior", posterior, half)


def a_result(anterior: float, posterior: float, status: str = "converged") -> Result:
    """What an estimation leaves, with intervals of ± 20 %, before a truth is known."""
    rows = [
        own.model_copy(
            update={"truth": None, "low": 0.8 * own.estimate, "high": 1.2 * own.estimate}
        )
        for own in moduli(anterior, posterior)
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
