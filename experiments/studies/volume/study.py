"""One's own volume over time: from images to moduli with intervals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.common.cases.report import case_text, write_case_tables
from experiments.common.cases.volume import detect_in_volume, run_volume, write_image_step
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.study import Study
from experiments.studies.volume.settings import Settings

__all__ = ["STUDY", "check_volume"]

Values = Mapping[str, Any]


def check_volume(config: Values, folder: Path) -> str:
    """Find, measure and draw the valve without simulating anything: what to tell the user."""
    about = write_image_step(detect_in_volume(config), folder)
    return "\n".join([*about["sentences"], f"In order; drawn in {folder / 'montage.png'}"])


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_volume),
    words=lambda record: case_text(flat(record)),
    write=each(write_case_tables),
    checks=lambda: (check_volume,),
)
