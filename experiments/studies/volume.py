"""Estimates moduli with intervals from your own volume over time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.common.cases.own_case import (
    ImagedInput,
    PersonalSettings,
    VolumeInput,
    case_words,
    find_valve,
    run_volume,
    write_report,
)
from experiments.common.schema import build
from experiments.common.study import Job, Result, Study


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings that the study adds to the configuration."""

    volume: VolumeInput = None  # file of a volume over time
    imaged: ImagedInput = field(default_factory=ImagedInput)
    personal: PersonalSettings


def run(job: Job[Settings]) -> Result:
    """Find the valve in the configured volume and personalise it."""
    own = job.settings
    return run_volume(job.values, own.volume, own.imaged, own.personal, job.folder)


def check_volume(values: Mapping[str, Any], folder: Path) -> str:
    """Find, measure and draw the valve without simulating anything."""
    from mvest.reporting.images import write_image_step

    imaged = build(ImagedInput, values["imaged"])
    detected = find_valve(values["volume"], imaged, folder, estimate=False)
    write_image_step(detected, folder)
    return "\n".join([*detected.sentences, f"In order; drawn in {folder / 'montage.png'}"])


STUDY = Study(settings=Settings, run=run, words=case_words, files=write_report, check=check_volume)
