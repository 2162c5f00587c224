"""Refuses what can be seen to be wrong in a configuration before anything is built or launched."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.common.building.closure import mechanics_of
from experiments.common.study import Check, load_study, study_names
from experiments.runner.tracking.store import require_no_password
from mvest.errors import ConfigurationError


def require_admissible(values: Mapping[str, Any]) -> None:
    """Refuse settings that no job could run with.

    Raises
    ------
    MvestError
        If a setting is inadmissible; the message names it.
    """
    require_no_password(values["tracking"]["uri"])
    mechanics_of(values)
    load_study(values["study"]).require(values)


def require_checks(values: Mapping[str, Any]) -> tuple[Check, ...]:
    """What ``check=true`` says of a study.

    Raises
    ------
    ConfigurationError
        If it has nothing to say of studies of this kind.
    """
    checks = load_study(values["study"]).checks()
    if not checks:
        kinds = ", ".join(name for name in study_names() if load_study(name).checks())
        raise ConfigurationError(
            f"experiment {values['name']}: check=true has nothing to say of a study of the kind "
            f"{values['study']}; expected one of {kinds}"
        )
    return checks
