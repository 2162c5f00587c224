"""Settings of the study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from experiments.common.schema import Reads, contents
from mvest.cases.importing.reference_heart import ReferenceHeartOptions
from mvest.errors import InputError

__all__ = ["HeartSettings", "Settings"]


def _parts(value: str, _beside: Mapping[str, Any]) -> Any:
    from mvest.cases.importing.reference_heart import heart_files

    try:
        return contents([str(file) for file in heart_files(value)])
    except InputError:
        # The study says where to get them.
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class HeartSettings:
    """What a study of the reference heart adds."""

    # The heart (GLB) or a folder with its parts; null: what the variable MVEST_HRA names.
    source: Annotated[str | None, Reads(_parts)] = None
    options: ReferenceHeartOptions = field(default_factory=ReferenceHeartOptions)
    # Further closures: what the annulus and chordae do (annulus_contraction, closed_depth).
    closures: dict[str, dict[str, float]] = field(default_factory=dict)
    # Variations of the gate that are asked, by name.
    gate: tuple[str, ...] = ()
    # Of each twin, what its truth has otherwise than the estimator's model (settings of truth).
    twins: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    heart: HeartSettings = field(default_factory=HeartSettings)
