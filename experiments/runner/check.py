"""Refuses what can be seen to be wrong in a configuration before anything is built or launched."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.common.build import mechanics_of
from experiments.common.study import load_study
from experiments.runner.tracking import require_no_password

__all__ = ["require_admissible"]


def require_admissible(values: Mapping[str, Any]) -> None:
    """Refuse settings that no job could run with.

    Raises
    ------
    MvestError
        If a setting is inadmissible; the message names it.
    """
    study = load_study(values["study"])
    require_no_password(values["tracking"]["uri"])
    mechanics_of(values)
    study.require(values)
