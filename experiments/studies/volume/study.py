"""One's own volume over time: from images to moduli with intervals."""

from __future__ import annotations

from experiments.common.cases.report import case_text, write_case_tables
from experiments.common.cases.volume import check_volume, run_volume
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.study import Study
from experiments.studies.volume.settings import Settings

__all__ = ["STUDY"]


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_volume),
    words=lambda record: case_text(flat(record)),
    write=each(write_case_tables),
    checks=lambda: (check_volume,),
)
