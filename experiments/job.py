"""One run of one configuration: build, simulate, estimate, write down, log."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from experiments.build import Twin, build_twin
from experiments.config import NOT_THE_RESULT, hash_of, register
from experiments.donor import run_donor
from experiments.gate import run_closure_study, run_gate_study
from experiments.progress import SolveBar, announce_compilation
from experiments.record import make_record, measure_frames, write_fields
from experiments.tracking import track_job
from mvest.errors import ConfigurationError, InputError
from mvest.model import ClosureModel
from mvest.provenance import write_json
from mvest.reporting.closure import closure_text, publish_closure, write_closure_tables
from mvest.reporting.donor import donor_text, publish_donor, write_donor_tables
from mvest.reporting.figures import iterates_figure, save_figure, valve_figure
from mvest.reporting.gate import gate_text, publish_gate, write_gate_tables
from mvest.reporting.publish import publish
from mvest.reporting.tables import text_table, write_tables
from mvest.study import ObservedFrames, StudyResult, estimate, simulate_observation

__all__ = ["FailedRunError", "run_job"]

TYPICAL_SOLVES = 6
"""Forward solves that a filter usually needs; only the progress bar's first guess."""

LOCKING = (
    "note: linear tetrahedra are many times too stiff in bending; moduli estimated with tet4 "
    "belong to the mesh, not to the tissue"
)

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
    record, _ = kind.run(values, hash_of(config), folder, started)

    write_json(folder / "config.json", values)
    write_json(folder / "result.json", record)
    kind.tables(folder, record)
    print(kind.text(record))
    print(f"Written to {folder}")
    if values["publish"] and record["status"] == "converged":
        if _as_published(hydra.overrides.task, hydra.sweeper.get("params")):
            target = Path(values["paths"]["results"])
            kind.publish(target, _slug(values, hydra), record, folder)
            print(f"Results in {target}")
        else:
            print(f"{values['paths']['results']} left as it is: this run has overrides")
    track_job(folder, values)
    if record["status"] != "converged":
        raise FailedRunError(
            record["reason"] + f" ({record['detail']})" * bool(record["detail"]), folder
        )


def run_twin(
    config: Mapping[str, Any], config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """A synthetic study: the record, and the figures written to ``folder``."""
    twin = build_twin(config)
    if twin.model.mesh.element_type == "tet4":
        print(LOCKING, file=sys.stderr)
    result = _estimate_twin(twin, np.random.default_rng(config["seed"]))
    confirmed = _confirm(twin, result) if config["confirm"] else None
    mesh = twin.model.mesh
    closure = None
    if result.fitted is not None:
        thickness = float(twin.valve.surface.thickness.mean())
        reach = twin.model.settings.contact.activation_distance * thickness
        closure = measure_frames(twin.valve, result, reach)
    record = make_record(
        result,
        config,
        config_hash=config_hash,
        meshes={
            "sha256": mesh.sha256,
            "nodes": len(mesh.nodes),
            "elements": len(mesh.elements),
            "truth_sha256": twin.truth_model.mesh.sha256,
        },
        closure=closure,
        truth_values=twin.truth_values,
        started=started,
    )
    record["confirmed_mm"] = confirmed
    if confirmed is not None:
        record["forward_solves"] += 1
    files: list[Path] = []
    if record["iterates"]:
        files += save_figure(folder / "iterates", iterates_figure(record), record)
    if result.fitted is not None:
        fields = folder / "fields.npz"
        write_fields(fields, twin.valve.surface, result)
        files += save_figure(folder / "valve", valve_figure(fields), record)
    return record, files


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


def _estimate_twin(twin: Twin, rng: np.random.Generator) -> StudyResult:
    with SolveBar("observation", len(_steps(twin.truth_model)), 1) as bar:
        twin.truth_model.on_step = bar.step
        data = simulate_observation(
            twin.source,
            twin.case.parameters,
            twin.truth_values,
            frames=twin.frames,
            variance=twin.variance,
            noise_mm=twin.noise_mm,
            rng=rng,
        )
    if data.observation is None:
        return StudyResult.failed(twin.case, data.reason, 0.0)
    with SolveBar("estimation", len(_steps(twin.model)), TYPICAL_SOLVES) as bar:
        twin.model.on_step = bar.step
        result = estimate(twin.case, data.observation)
    return result.against(data.truth)


def _confirm(twin: Twin, result: StudyResult) -> float | None:
    """Largest distance (mm) of the fitted closed valve from one closed anew from the open state.

    None where every closure started from the open state, so that there is nothing to confirm, or
    where the new closure failed.
    """
    usual = twin.model.continuation, twin.model.guide
    if result.estimate is None or result.fitted is None or usual == (False, None):
        return None
    twin.model.continuation, twin.model.guide = False, None
    with SolveBar("confirmation", len(_steps(twin.model)), 1) as bar:
        twin.model.on_step = bar.step
        anew = ObservedFrames(twin.model, twin.frames)(result.estimate)
    twin.model.continuation, twin.model.guide = usual
    if not anew.converged:
        return None
    last = anew.y.reshape(result.fitted.shape)[-1]
    return float(np.linalg.norm(last - result.fitted[-1], axis=1).max())


def _steps(model: ClosureModel) -> Sequence[object]:
    return model.settings.protocol.steps()


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
