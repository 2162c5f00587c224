"""One's own valve: from a case folder to moduli with intervals."""

from __future__ import annotations

from experiments.common.cases.own_case import check_case, run_case
from experiments.common.cases.report import case_text, write_case_tables
from experiments.common.expectation import foresee_own
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.study import Study
from experiments.studies.case.settings import Settings

__all__ = ["STUDY"]


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_case),
    words=lambda record: case_text(flat(record)),
    write=each(write_case_tables),
    checks=lambda: (check_case, foresee_own),
)
