"""The configured filter, its coordinates, its prior and the noise that it assumes."""

from contextlib import suppress
from importlib import import_module
from typing import Any

import numpy as np

from experiments.common.schema import Values
from mvest.errors import ConfigurationError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import observation_noise
from mvest.estimation.run import Filter
from mvest.estimation.transform import Identity, Log, Transform
from mvest.mechanics.parameters import is_positive
from mvest.reading.text import one_line
from mvest.typing import FloatArray


def build_filter(
    settings: Values, parameters: tuple[str, ...], *, positive: bool = False
) -> tuple[Filter, Transform, Gaussian]:
    """The filter, its coordinates, and the prior of the parameters.

    The registered parameters of the mechanics are known to be positive or not; ``positive`` says
    it for those of another model.
    """
    mean, P0 = np.array(settings["initial"], dtype=float), settings["P0"]
    require_one_each("filter.initial", mean, parameters)
    try:
        prior = Gaussian.from_variance(mean, P0)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"filter.P0 = {P0}: {error}") from error
    transform: Transform = Identity()
    if settings["transform"] == "log":
        transform = Log(None if positive else tuple(map(is_positive, parameters)))
    transform.forward(mean)
    return filter_of(settings["method"]), transform, prior


def filter_of(method: Values) -> Filter:
    """The filter that ``_target_`` names; raises a `ConfigurationError` if there is none."""
    target, settings = method.get("_target_"), {k: v for k, v in method.items() if k != "_target_"}
    module, _, name = str(target).rpartition(".")
    kind: Any = None
    if module.startswith("mvest.estimation.filters."):  # import no other code
        with suppress(ImportError):
            kind = getattr(import_module(module), name, None)
    if not (isinstance(kind, type) and issubclass(kind, Filter)):
        raise ConfigurationError(
            f"filter.method: _target_ {target!r}, expected the full name of a filter, for example "
            "mvest.estimation.filters.paper.PaperFilter"
        )
    try:
        return kind(**settings)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"filter.method: {one_line(error)}") from error


def require_one_each(name: str, values: FloatArray, parameters: tuple[str, ...]) -> None:
    """Refuse a setting that does not have one value for each parameter."""
    if values.shape != (len(parameters),):
        raise ConfigurationError(
            f"{name} has {values.size} values; expected one for each of {', '.join(parameters)}"
        )


def observation_variance(R: Any) -> FloatArray:
    """``filter.R``, mm²: one positive variance, or one for each observed frame."""
    try:
        observation_noise(np.atleast_1d(R), np.size(R))
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"filter.R = {R}: {error}") from error
    return np.asarray(R, dtype=np.float64)
