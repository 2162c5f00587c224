"""Settings of the study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from experiments.common.schema import InputFile, Reads, contents

__all__ = ["ExternalSettings", "Settings"]


def _command(value: Sequence[str], beside: Mapping[str, Any]) -> Any:
    from mvest.external.process import files_of_command

    files = contents(files_of_command(value, beside.get("environment") or {}))
    return [*value, files] if value else value


@dataclass(frozen=True, slots=True, kw_only=True)
class ExternalSettings:
    """A program as the model, asked through files (mvest/external/README.md)."""

    command: Annotated[
        tuple[str, ...], Reads(_command)
    ] = ()  # the program and its arguments, no shell
    folder: str | None = None  # where its runs are kept; null: in the folder of the job
    observation: InputFile = None  # .csv x,y,z (mm), one row per observed point
    points: InputFile = None  # .csv x,y,z (mm), reference positions that the program is given
    units: tuple[str, ...] = ()  # of the parameters; empty: not stated
    prior_std: tuple[float, ...] = ()  # of the parameters, in their units
    noise_mm: float | None = None  # SD of the error of each observed coordinate
    settings: dict[str, Any] = field(default_factory=dict)  # given to the program as they are
    environment: dict[str, str] = field(default_factory=dict)  # beside what this process has
    # Files and folders after whose change runs are done anew, beside those in the command.
    inputs: Annotated[tuple[str, ...], Reads(contents)] = ()
    time_limit_s: float = 600.0  # of one run
    differences: str = "central"  # or forward, or none: the program must give jacobian.csv
    relative_step: float = 1e-3  # of a parameter, in differences
    floor: float = 0.0  # size of a parameter that may be zero
    processes: int = 1  # runs at a time
    reuse: bool = True  # finished runs serve again


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    external: ExternalSettings = field(default_factory=ExternalSettings)
