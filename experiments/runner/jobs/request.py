"""One job, asked for in plain data, so that another process can be asked for it as well."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from experiments.common.config import hash_of, is_hashed, plain, require_in_range


@dataclass(frozen=True, slots=True)
class Request:
    """One composed configuration and where it is run.

    Attributes
    ----------
    values : dict
        The resolved configuration.
    config_hash : str
        SHA-256 of what in it can change the result.
    folder : Path
        Output folder of the job.
    publish_as : str or None
        Name of its record in the results; None where they are not to be touched.
    overrides : tuple of str
        Those that it was composed with.

    Raises
    ------
    ConfigurationError
        If a setting is outside its range.
    """

    values: dict[str, Any]
    config_hash: str
    folder: Path
    publish_as: str | None = None
    overrides: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_in_range(self.values)

    @classmethod
    def of(cls, config: DictConfig) -> Request:
        """What Hydra composed for the job it is just starting."""
        hydra = HydraConfig.get()
        values = plain(config)
        return cls(
            values,
            hash_of(values),
            Path(hydra.runtime.output_dir),
            publish_as(values, hydra.overrides.task, None),
            tuple(hydra.overrides.task),
        )

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Request:
        """The request that :meth:`to_json` wrote."""
        given = {"folder": Path(data["folder"]), "overrides": tuple(data["overrides"])}
        return cls(**{**data, **given})

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "values": self.values,
            "config_hash": self.config_hash,
            "folder": str(self.folder),
            "publish_as": self.publish_as,
            "overrides": self.overrides,
        }


def publish_as(
    values: Mapping[str, Any], overrides: Sequence[str], swept: Mapping[str, Any] | None
) -> str | None:
    """Name of a run's record in the results; None where they are not to be touched.

    Parameters
    ----------
    values : mapping
        The resolved configuration.
    overrides : sequence of str
    swept : mapping or None
        What the experiment itself varies (empty: nothing), if this is one run of several.
    """
    # A sweep is published as a whole.
    if (
        not values["publish"]
        or values["sweep"]
        or not as_published(overrides, swept, values["study"])
    ):
        return None
    if swept is None:
        return str(values["name"])
    return re.sub(r"[^a-z0-9]+", "-", f"{values['name']} {values['row']}".lower()).strip("-")


def as_published(
    overrides: Sequence[str], swept: Mapping[str, Any] | None, study: str | None
) -> bool:
    """Whether a run is its experiment as configured: nothing overridden that changes the result."""
    allowed = {"experiment", "hydra", *(swept or {})}
    keys = (override.lstrip("+~").partition("=")[0] for override in overrides)
    return all({key, key.partition(".")[0]} & allowed or not is_hashed(key, study) for key in keys)
