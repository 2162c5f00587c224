"""One's own volume over time: from images to moduli with intervals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.common.cases.findings import Findings
from experiments.common.cases.report import case_text, write_cases
from experiments.common.cases.settings import ImagedSettings
from experiments.common.cases.volume import detect_in_volume, run_volume, write_image_step
from experiments.common.records.record import Outcome
from experiments.common.schema import build
from experiments.common.study import Job, Study
from experiments.studies.volume.settings import Settings

__all__ = ["STUDY", "check_volume", "run_own_volume"]


def run_own_volume(job: Job[Settings]) -> Outcome[Findings]:
    """Find the valve in the configured volume and personalise it."""
    settings = job.settings
    return run_volume(job.values, settings.volume, settings.imaged, settings.personal, job.folder)


def check_volume(values: Mapping[str, Any], folder: Path) -> str:
    """Find, measure and draw the valve without simulating anything, and say so."""
    settings = build(ImagedSettings, values["imaged"])
    detected = detect_in_volume(values["volume"], settings, folder, estimate=False)
    step = write_image_step(detected, folder)
    return "\n".join([*step.sentences, f"In order; drawn in {folder / 'montage.png'}"])


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_own_volume,
    words=case_text,
    write=write_cases,
    checks=lambda: (check_volume,),
)
