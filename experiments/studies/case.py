"""Estimates moduli with intervals for your own valve, from a case folder."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.common.cases.own_case import (
    CaseInput,
    PersonalSettings,
    case_words,
    check,
    read_configured,
    run_case,
    write_report,
)
from experiments.common.study import Job, Result, Study
from mvest.cases.case import ValveCase
from mvest.cases.plausibility import require_plausible


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings that the study adds to the configuration."""

    case: CaseInput = None  # folder of a case
    strict: bool = False  # reject an implausible case instead of warning
    gate: bool = False  # with check=true: test whether the closed state is unique (minutes)
    personal: PersonalSettings


def run(job: Job[Settings]) -> Result:
    """Read the configured case and personalise it."""
    return run_case(job.values, job.settings.personal, _read(job.values))


def check_case(values: Mapping[str, Any], folder: Path) -> str:
    """Read, check and draw the configured case, and list the intervals to expect."""
    return check(values, _read(values), folder, gate=values["gate"])


def _read(values: Mapping[str, Any]) -> ValveCase:
    case = read_configured(values["case"])
    if values["strict"]:
        require_plausible(case)
    return case


STUDY = Study(settings=Settings, run=run, words=case_words, files=write_report, check=check_case)
