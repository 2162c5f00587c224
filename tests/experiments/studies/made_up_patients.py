"""Findings of cases and of virtual patients, made up."""

from dataclasses import replace
from typing import Any

from experiments.common.cases.findings import Findings, Revealed
from experiments.common.records.estimates import Data, SeedRun
from experiments.common.records.record import Outcome, Record
from mvest.reporting.case.findings import (
    About,
    CaseFindings,
    FrameDistances,
    ModuliAlone,
    Narrower,
    ToTruth,
    UnknownRow,
)
from mvest.reporting.findings import Spread
from tests.experiments.studies.made_up import made_up

TRUTH = {"E_f.anterior": 6.0, "E_f.posterior": 2.0, "pressure_scale": 1.05, "shift.x": 0.4}
UNIT = {"E_f": "MPa", "shift": "mm"}


def unknown(name: str, estimate: float | None, half: float) -> UnknownRow:
    """An unknown with the interval estimate ± half."""
    row = UnknownRow(
        name=name,
        label=name.replace(".", " "),
        unit=UNIT.get(name.partition(".")[0], ""),
        kind="modulus" if name.startswith("E_f.") else "nuisance",
        treatment="estimated",
        prior_mean=1.0,
        prior_std=1.0,
        truth=TRUTH[name],
    )
    if estimate is None:
        return row
    return replace(
        row, estimate=estimate, std=half / 1.96, low=estimate - half, high=estimate + half
    )


def moduli(
    anterior: float | None, posterior: float | None, half: float = 0.5
) -> tuple[UnknownRow, ...]:
    """The unknowns of both leaflets."""
    return unknown("E_f.anterior", anterior, half), unknown("E_f.posterior", posterior, half)


def alone(parameters: tuple[UnknownRow, ...], reason: str = "converged") -> ModuliAlone:
    """Another estimation."""
    return ModuliAlone(reason == "converged", reason, "", 3, parameters)


def distances(
    frame: str, seen: bool, generic: float, registered: float, personalised: float
) -> FrameDistances:
    """Distances of these means, and of half of them from the truth."""
    means = (generic, registered, personalised)
    first, second, third = (Spread(mean, 0.1, 3 * mean) for mean in means)
    truth = ToTruth(*(Spread(mean / 2, 0.1, 1.5 * mean) for mean in means))
    return FrameDistances(frame, seen, first, second, third, truth)


def findings_of(case: CaseFindings) -> Findings:
    """Findings of a run without anything else."""
    own = [row for row in case.unknowns if row.is_modulus]
    known = all(row.estimate is not None for row in own)
    run = SeedRun(
        seed=None,
        status=case.status,
        reason=case.reason,
        estimate=tuple(row.estimate for row in own) if known else None,
        std=tuple(row.std for row in own) if known else None,
    )
    return Findings(
        repeats=(run,),
        data=Data("tests", "0" * 64),
        case=case,
        memory_mb=100.0,
        parts_s={},
    )


def patient(name: str = "normal_small", table: str = "patients", **changes: Any) -> Record:
    """Inside for both moduli; without nuisances for one, by the paper's filter for none."""
    case = CaseFindings(
        about=About(name),
        converged=True,
        reason="converged",
        unknowns=(
            *moduli(5.8, 2.1), unknown("pressure_scale", 1.02, 0.05), unknown("shift.x", 0.1, 0.2)
        ),
        without_nuisances=alone(moduli(5.7, 3.1)),
        as_in_the_paper=alone(moduli(9.0, 4.0), "no rounds left"),
        distances=(
            distances("closed", True, 2.0, 1.5, 0.5), distances("late", False, 1.0, 0.4, 0.8)
        ),
        narrow=(
            Narrower("E_f anterior, pressure known", "E_f.anterior", 0.4, 0.3),
            Narrower("E_f posterior, pressure known", "E_f.posterior", 0.4, 0.1),
            Narrower("E_f anterior, registration known", "E_f.anterior", 0.4, 0.38),
        ),
        settings={"personal": {}},
        measurements={"open": {"observed": {"annulus_area_mm2": 800.0}}},
    )  # fmt: skip
    case = replace(case, **changes)
    findings = replace(findings_of(case), revealed=Revealed(1, (6.28, 2.61), (1.5, 1.47)))
    return made_up(
        findings,
        study="patient",
        experiment=table,
        table=table,
        row=name,
        status=case.status,
        reason=case.reason,
    )


def lost_patient(name: str = "prolapse", table: str = "patients") -> Record:
    """A patient of whom no filter estimated anything."""
    nothing, reason = moduli(None, None), "the model failed"
    return patient(
        name,
        table,
        converged=False,
        reason=reason,
        unknowns=(*nothing, unknown("pressure_scale", None, 0), unknown("shift.x", None, 0)),
        without_nuisances=alone(nothing, reason),
        as_in_the_paper=alone(nothing, reason),
        distances=(),
        narrow=(),
    )


def an_outcome(anterior: float, posterior: float, status: str = "converged") -> Outcome[Findings]:
    """What an estimation leaves, with intervals of ± 20 %, before a truth is known."""
    rows = (
        replace(row, truth=None, low=0.8 * row.estimate, high=1.2 * row.estimate)
        for row in moduli(anterior, posterior)
    )
    pressure = replace(unknown("pressure_scale", 1.1, 0.1), truth=None)
    case = CaseFindings(
        about=About("case"),
        converged=status == "converged",
        reason=status,
        unknowns=(*rows, pressure),
    )
    return Outcome(
        findings=findings_of(case),
        status=status,
        reason=status,
        parameters=("E_f.anterior", "E_f.posterior"),
    )
