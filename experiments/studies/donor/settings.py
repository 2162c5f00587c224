"""Settings of the study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from experiments.common.schema import Reads, contents
from mvest.errors import InputError

__all__ = ["DonorSettings", "Settings"]


def _recording(value: str, _beside: Mapping[str, Any]) -> Any:
    from mvest.valve.io.donor.arrays import donor_file

    try:
        return contents(donor_file(value))
    except InputError:
        # The study says where to get it.
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class DonorSettings:
    """What a study of the recorded donor valve adds."""

    # Folder or file; null: where the environment variable MVEST_TRIVALVE says.
    recording: Annotated[str | None, Reads(_recording)] = None
    vertices: int = 430  # of the midsurface that is meshed and observed
    contact_vertices: int = 3000  # of the midsurface on which contact is sampled
    starts: tuple[Any, ...] = ()  # MPa, moduli from which each fit starts
    largest_change: float = 0.15  # of a modulus' logarithm from one closed state to the next


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    donor: DonorSettings = field(default_factory=DonorSettings)
