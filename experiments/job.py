"""One run of one configuration: build, simulate, estimate, write down, log."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from experiments.config import NOT_THE_RESULT, hash_of, register
from experiments.donor import run_donor
from experiments.gate import run_closure_study, run_gate_study
from experiments.progress import announce_compilation
from experiments.tracking import log_run
from experiments.twin import run_twin
from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.provenance import write_json
from mvest.reporting.closure import closure_text, publish_closure, write_closure_tables
from mvest.reporting.donor import donor_text, publish_donor, write_donor_tables
from mvest.reporting.gate import gate_text, publish_gate, write_gate_tables
from mvest.reporting.publish import publish
from mvest.reporting.tables import text_table, write_tables

__all__ = ["FailedRunError", "run_job"]

# Workers of a launcher import this module before they compose their configuration.
register()


class FailedRunError(Exception):
    """A run ended without an estimate; it is recorded, with its reason, in its output folder."""

    def __init__(self, reason: str, folder: Path) -> None:
        super().__init__(reason, folder)
        self.reason = reason
        self.folder = folder

    def __str__(self) -> str:
        return f"{self.reason} (recorded in {self.folder / 'result.json'})"


def run_job(config: DictConfig) -> None:
    """Run one composed configuration in Hydra's output folder.

    Raises
    ------
    MvestError
        If a setting is inadmissible or a file cannot be written.
    FailedRunError
        If the computation found no estimate; the run is recorded all the same.
    """
    started = time.time()
    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    values: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    if values["study"] not in STUDIES:
        raise ConfigurationError(
            f"study = {values['study']!r}, expected one of {', '.join(STUDIES)}"
        )
    require_writable(folder)
    announce_compilation()
    kind = STUDIES[values["study"]]
    record, files = kind.run(values, hash_of(config), folder, started)

    write_json(folder / "config.json", values)
    write_json(folder / "result.json", record)
    tables = kind.tables(folder, record)
    print(kind.text(record))
    print(f"Written to {folder}")
    if values["publish"] and record["status"] == "converged":
        if _as_published(hydra.overrides.task, hydra.sweeper.get("params")):
            target = Path(values["paths"]["results"])
            kind.publish(target, _slug(values, hydra), record, folder)
            print(f"Results in {target}")
        else:
            print(f"{values['paths']['results']} left as it is: this run has overrides")
    if values["tracking"]["enabled"]:
        artifacts = [folder / "result.json", folder / "config.json", *tables, *files]
        try:
            log_run(record, values, artifacts, started)
        except MvestError as error:
            print(f"warning: {error}; the result is in {folder}", file=sys.stderr)
    if record["status"] != "converged":
        raise FailedRunError(
            record["reason"] + f" ({record['detail']})" * bool(record["detail"]), folder
        )


@dataclass(frozen=True, slots=True)
class Study:
    """A kind of study: how it is run, told, tabulated and published.

    Attributes
    ----------
    run : callable
        (configuration, its hash, output folder, start time) -> record and the files written.
    text : callable
        record -> text for the terminal.
    tables : callable
        (folder, record) -> table files written there.
    publish : callable
        (results folder, name, record, output folder) -> files written.
    """

    run: Callable[[Mapping[str, Any], str, Path, float], tuple[dict[str, Any], list[Path]]]
    text: Callable[[Mapping[str, Any]], str]
    tables: Callable[[Path, Mapping[str, Any]], list[Path]]
    publish: Callable[[Path, str, Mapping[str, Any], Path], list[Path]]


STUDIES: dict[str, Study] = {
    "twin": Study(
        run_twin,
        lambda record: text_table([record]),
        lambda folder, record: write_tables(folder, record["table"], [record]),
        lambda results, name, record, folder: publish(results, name, record, folder / "fields.npz"),
    ),
    "closure": Study(
        run_closure_study,
        closure_text,
        write_closure_tables,
        lambda results, _, record, folder: publish_closure(results, record, folder),
    ),
    "gate": Study(
        run_gate_study,
        gate_text,
        write_gate_tables,
        lambda results, _name, record, _folder: publish_gate(results, record),
    ),
    "donor": Study(
        run_donor,
        donor_text,
        write_donor_tables,
        lambda results, _, record, folder: publish_donor(results, record, folder / "fields.npz"),
    ),
}
"""Kinds of studies that a configuration can name."""


def _as_published(overrides: Sequence[str], swept: Mapping[str, Any] | None) -> bool:
    """Whether a run is its experiment as configured: nothing overridden that changes the result."""
    allowed = {"experiment", *NOT_THE_RESULT, *(swept or {})}
    keys = (re.split(r"[=.]", override.lstrip("+~"), maxsplit=1)[0] for override in overrides)
    return all(key in allowed for key in keys)


def _slug(values: Mapping[str, Any], hydra: Any) -> str:
    """Name of a published record: the experiment's, with its row if it has several."""
    if str(hydra.mode).endswith("MULTIRUN"):
        return re.sub(r"[^a-z0-9]+", "-", f"{values['name']} {values['row']}".lower()).strip("-")
    return str(values["name"])


def require_writable(folder: Path) -> None:
    """Refuse a folder that cannot be written, before anything is computed."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}") from error
