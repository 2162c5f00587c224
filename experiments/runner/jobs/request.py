"""One job, asked for in plain data, so that another process can be asked for it as well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from experiments.common.config import hash_of, plain, require_in_range
from experiments.results.publish import publish_as


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
        What was requested in Hydra's syntax.

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
        hydra, values = HydraConfig.get(), plain(config)
        overrides = tuple(hydra.overrides.task)
        published = publish_as(values, overrides, None)
        return cls(values, hash_of(values), Path(hydra.runtime.output_dir), published, overrides)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Request:
        """The request that :meth:`to_json` wrote."""
        typed = tuple(data["overrides"])
        return cls(**{**data, "folder": Path(data["folder"]), "overrides": typed})

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        data = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**data, "folder": str(self.folder)}
