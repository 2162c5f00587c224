"""Refuses what can be seen to be wrong in a configuration before anything is built or launched."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.common.build import build_filter, mechanics_of
from experiments.runner.job import require_study
from experiments.runner.tracking import require_no_password
from experiments.studies.imaging.study import require_imaging
from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.estimation.noise import observation_noise

__all__ = ["require_admissible"]


def require_admissible(values: Mapping[str, Any]) -> None:
    """Refuse settings that no job could run with.

    Raises
    ------
    MvestError
        If a setting is inadmissible; the message names it.
    """
    require_study(values)
    require_no_password(values["tracking"]["uri"])
    for name in ("repeats", "time_limit_s"):
        if values.get(name) is not None and not values[name] > 0:
            raise ConfigurationError(f"{name} = {values[name]}, expected > 0")
    mechanics_of(values)
    if values["study"] == "imaging":
        require_imaging(values)
    if values["study"] != "twin":
        return
    build_filter(values["filter"], tuple(values["parameters"]))
    variance = values["filter"]["R"]
    try:
        observation_noise(np.atleast_1d(np.asarray(variance, dtype=float)), np.size(variance))
    except (InputError, TypeError, ValueError) as error:
        text = str(error) if isinstance(error, MvestError) else "expected a number or numbers"
        raise ConfigurationError(f"filter.R = {variance}: {text}") from error
    noise = values["observation"]["noise_mm"]
    if noise < 0:
        raise ConfigurationError(f"observation.noise_mm = {noise}, expected at least 0")
