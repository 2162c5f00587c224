"""Settings of the study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from experiments.common.schema import Reads, contents
from mvest.errors import InputError

__all__ = ["CITATION", "DATA_VARIABLE", "DonorSettings", "Settings", "recording_folder"]

DATA_VARIABLE = "MVEST_TRIVALVE"
"""Environment variable that names a checkout of the donor's data."""
CITATION = (
    "Mathur et al. 2022, Engineering with Computers, doi 10.1007/s00366-022-01659-w; data: "
    "https://github.com/SoftTissueBiomechanicsLab/Texas_TriValve_1.1, licence CC BY 4.0"
)


def recording_folder(recording: str | None, case: str) -> Path:
    """The folder of a case in a checkout of the donor's data.

    Raises
    ------
    InputError
        If there is none; the message says where to get it.
    """
    origin = (
        f"The donor valve is not part of this package: clone Texas TriValve 1.1 ({CITATION}) and "
        f"name the clone as donor.recording or in the environment variable {DATA_VARIABLE}"
    )
    if not recording:
        raise InputError(f"no folder given for the donor valve. {origin}")
    folder = Path(recording) / case
    if not folder.is_dir():
        raise InputError(f"donor valve: there is no folder {folder}. {origin}")
    return folder


def _recording(value: str | None, beside: Mapping[str, Any]) -> Any:
    from mvest.valve.io.abaqus.recording import recording_files

    try:
        return contents(recording_files(recording_folder(value, str(beside.get("case", "")))))
    except InputError:
        # The study says where to get it.
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class DonorSettings:
    """What a study of a recorded closure adds; names of sets are those of its input deck."""

    # Checkout of the data.
    recording: Annotated[str | None, Reads(_recording)] = None
    # Folder in it, after which its deck and its frames are called.
    case: str = ""
    # Element set of each leaflet, by the leaflet's name.
    leaflets: Mapping[str, str] = field(default_factory=dict)
    annulus: str = ""  # node set
    free_edge: str = ""  # node set
    vertices: int = 430  # of the midsurface that is meshed and observed
    contact_vertices: int = 3000  # of the midsurface on which contact is sampled
    starts: tuple[Any, ...] = ()  # MPa, moduli from which each fit starts
    largest_change: float = 0.15  # of a modulus' logarithm from one closed state to the next


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    donor: DonorSettings = field(default_factory=DonorSettings)
