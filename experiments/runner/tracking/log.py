"""Logging to MLflow what is on disk: a run, a sweep, or all outputs (``mvest sync``).

The folders are the truth. A run of the store with the same result is left as it is, one with
another result is replaced, a missing one is added, at any time.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml
from hydra.core.hydra_config import HydraConfig
from tqdm import tqdm

from experiments.common.config import is_hashed
from experiments.common.records.metrics import implausible, metrics, short_names
from experiments.common.records.record import read_record
from experiments.runner.jobs.folder import CONFIG, RESULT, is_done
from experiments.runner.planning.plan import PLAN
from experiments.runner.tracking.store import ARTIFACTS, opened
from experiments.sweeps.collected import read_sweep
from mvest.errors import MvestError
from mvest.files import sha256_of
from mvest.reading.documents import read_mapping

if TYPE_CHECKING:
    from mlflow.entities import Run

Values = Mapping[str, Any]

SWEEP, TYPED = "sweep.json", ".hydra/overrides.yaml"
"""Files of a sweep: its results; and of a run: what was typed."""

FILES = ("*.json", "*.png", "*.svg", "*.csv", "*.md", "*.html", "*.parquet")
"""Files that MLflow keeps a copy of; of a figure the picture, not its PDF."""

MANY = 1000
"""Jobs of a sweep above which each is a run of its own only where ``tracking.runs`` asks for it."""

PARENT, WHOLE = "mlflow.parentRunId", "result_hash"
"""Tags: of a job, its sweep's run; of a run that was logged to its end, the hash of its result."""

NAMED_ELSEWHERE = {"experiment", "hydra", "launcher", "name", "sweep"}
"""Typed words that choose what is run and by whom."""

HANDFUL = (
    "study", "valve.folder_sha256", "mesh.source", "mechanics.element", "filter.mode",
    "truth.label", "observation.noise_mm", "seed",
)  # fmt: skip
"""Settings that every run shows, typed or not."""


class _Entry(NamedTuple):
    """What a run of MLflow holds; its first tag tells it from all others of its experiment."""

    result: Path
    name: str
    tags: Values
    numbers: Mapping[int, Mapping[str, float]]
    seconds: float


def log_run(folder: Path, config: Values) -> None:
    """Log a run by itself; a store that fails costs a line of warning, and nothing is lost."""
    if (folder / RESULT).is_file():
        log_sweep(folder, config)


def log_sweep(folder: Path, config: Values) -> None:
    """Log a sweep's folder, likewise, with the configuration of its first job."""
    outputs = Path(config["paths"]["outputs"])
    try:
        _log(folder, outputs, config)
    except (MvestError, OSError) as error:
        remedy = f"every result is on disk, and `mvest sync {outputs}` logs what is missing"
        print(f"warning: {error}; {remedy}", file=sys.stderr)


def sync(outputs: Path) -> int:
    """Bring the stores to the state of a folder of outputs; returns the exit status.

    0: the stores have everything; 1: something was left out, as a line of warning says.
    """
    counts, swept = Counter[str](), set[Path]()
    for path in [*sorted(outputs.rglob(PLAN)), *sorted(outputs.rglob(RESULT))]:
        if ARTIFACTS in path.parts or path.parent in swept:
            continue
        try:
            read = read_mapping(path if path.name == PLAN else path.with_name(CONFIG))
            swept |= {path.parent / job["folder"] for job in read.get("jobs", ())}
            counts += _log(path.parent, outputs, read.get("values", read))
        except (MvestError, OSError, KeyError) as error:
            counts["left"] += _left_out(path, error)
    print(f"{outputs}: {counts['added']} runs added to MLflow, {counts['there']} were there")
    return int(counts["left"] > 0)


def _left_out(path: Path, error: Exception) -> int:
    tqdm.write(f"warning: {path} left out: {error}", file=sys.stderr)
    return 1


def _log(folder: Path, outputs: Path, config: Values) -> Counter[str]:
    """Log a run by itself, or a sweep as one run with its jobs below it; counts what was done."""
    counts, name, tracking = Counter[str](), str(config["name"]), config["tracking"]
    if not tracking["enabled"]:
        return counts
    if is_sweep := (folder / PLAN).is_file():
        plan = read_mapping(folder / PLAN)
    else:
        plan = {"jobs": [{"folder": "", "overrides": _typed(folder), "factors": {}}]}
    each = len(plan["jobs"]) <= MANY if tracking.get("runs") is None else tracking["runs"]
    words = {word.partition("=")[0]: "" for job in plan["jobs"] for word in job["overrides"]}
    entries, settings, rows, factors = [], [], [], []
    for job in plan["jobs"]:
        place = folder / job["folder"]
        try:
            if (place / RESULT).is_file():
                own = read_mapping(place / CONFIG)
                entries.append(_job(place, job.get("name")) if each else None)
                settings.append(typed([*words, *job["overrides"], *HANDFUL], own))
                rows.append(columns(settings[-1], own["parameters"]))
                factors.append(columns(job["factors"], own["parameters"]))
        except MvestError as error:
            counts["left"] += _left_out(place, error)
    with opened(tracking["uri"], outputs, name):
        known = runs_of(name, "" if is_sweep else f"tags.folder = '{folder.resolve().name}'")
        parent = None
        if is_sweep:
            texts = [(key, _text(value)) for row in settings for key, value in row.items()]
            swept = {key: dict.fromkeys(v for k, v in texts if k == key) for key, _ in texts}
            whole = {key: ",".join(values) for key, values in swept.items()}
            parent, done = _put(_sweep(folder, plan), whole, known)
            counts[done] += 1
        for entry, row in zip(
            tqdm(entries, disable=None, leave=False), varied(rows, factors), strict=True
        ):
            if entry is not None:
                counts[_put(entry, row, known, parent)[1]] += 1
    return counts


def _typed(folder: Path) -> list[str]:
    """What was typed for a run by itself, as far as that is known."""
    if (folder / TYPED).is_file():
        return list(yaml.safe_load((folder / TYPED).read_text(encoding="utf-8")))
    known = HydraConfig.get() if HydraConfig.initialized() else None
    return list(known.overrides.task) if known and known.runtime.output_dir == str(folder) else []


def typed(words: Iterable[str], config: Values) -> dict[str, Any]:
    """Typed settings (``NAME=VALUE``) that can change a result, with their values in a run.

    Values are those of the configuration beside the result, where no file is named: such a name
    must not reach a store. Of a group (``mesh=coarse``) the value is what was chosen.
    """
    found: dict[str, Any] = {}
    for word in words:
        name, _, text = word.lstrip("+~").partition("=")
        first, *rest = re.split(r"[./]", name)
        value: Any = config.get(first)
        for key in rest:
            value = value.get(key) if isinstance(value, Mapping) else None
        if isinstance(value, Mapping):
            value = text if re.fullmatch(r"[\w -]+", text) else None
        if value not in (None, "") and first not in NAMED_ELSEWHERE:
            found |= {name: value} if is_hashed(name, config["study"]) else {}
    return found


def columns(settings: Values, parameters: Sequence[str]) -> dict[str, Any]:
    """Settings by dotted names; a list has a column for each value, of a matrix the diagonal.

    Where it has a value for each parameter they name its columns (``filter.initial.anterior``).
    """
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, list):
            names = short_names(parameters) if len(value) == len(parameters) else range(len(value))
            diagonal = (item[k] if isinstance(item, list) else item for k, item in enumerate(value))
            value = dict(zip(names, diagonal, strict=True))
        if isinstance(value, Mapping):
            found |= columns({f"{name}.{key}": item for key, item in value.items()}, parameters)
        elif value not in (None, ""):
            found[name] = value
    return found


def varied(rows: Sequence[Values], factors: Sequence[Values]) -> list[dict[str, Any]]:
    """Of the columns of jobs those that differ, and the handful; factors that no column repeats."""
    kept: dict[str, list[Any]] = {}
    for source in (rows, factors):
        for name in dict.fromkeys(name for row in source for name in row):
            values = [row.get(name) for row in source]
            shown = name in HANDFUL or len(rows) == 1 or len(set(map(repr, values))) > 1
            if shown and (source is rows or values not in kept.values()):
                kept[name] = values
    return [{name: values[k] for name, values in kept.items()} for k in range(len(rows))]


def _job(folder: Path, name: str | None) -> _Entry | None:
    """A job; None before all of it is on disk."""
    record = read_record(folder / RESULT)
    source, why = record.provenance, implausible(record)
    tags = {
        "config_hash": source.config_hash,
        "status": record.status,
        "reason": record.reason,
        "verdict": next((one.verdict.trust for one in record.estimates if one.verdict), None),
        "plausible": f"no: {why}" if why else "yes",
        "mlflow.source.git.commit": source.git.sha,
    }
    entry = _Entry(folder / RESULT, name or record.row, tags, metrics(record), record.seconds_total)
    return entry if is_done(folder) or not record.converged else None


def _sweep(folder: Path, plan: Values) -> _Entry:
    """A whole sweep, with its totals."""
    result, totals = folder / PLAN, {"jobs": float(len(plan["jobs"]))}
    tags, name = (
        {"sweep_id": plan["sweep_id"], "kind": "sweep"},
        f"sweep of {len(plan['jobs'])} jobs",
    )
    if (folder / SWEEP).is_file():
        result, sweep = folder / SWEEP, read_sweep(folder / SWEEP)
        means = [one for record in sweep.records if (one := metrics(record)[0].get("error.mean"))]
        totals = {"error.mean": fmean(means)} | totals if means else totals
        totals["failed"] = sum(not record.converged for record in sweep.records)
        totals["seconds"] = sum(record.seconds_total for record in sweep.records)
        tags["mlflow.source.git.commit"] = sweep.provenance.git.sha
    return _Entry(result, name, tags, {0: totals}, totals.get("seconds", 0.0))


def _put(
    entry: _Entry, parameters: Values, known: Sequence[Run], parent: str | None = None
) -> tuple[str, str]:
    """Bring one run to the state of an entry; its id, and whether it was added."""
    import mlflow

    result, name, tags, numbers, seconds = entry
    key, digest, client = next(iter(tags)), sha256_of(result), mlflow.MlflowClient()
    before = [run for run in known if run.data.tags.get(key) == tags[key]]
    same = [run for run in before if run.data.tags.get(WHOLE) == digest]
    texts = {key: _text(value) for key, value in parameters.items() if value is not None}
    if same:
        run_id, data = same[0].info.run_id, same[0].data
        mlflow.log_params({k: v for k, v in texts.items() if k not in data.params}, run_id=run_id)
        if parent and data.tags.get(PARENT) != parent:
            client.set_tag(run_id, PARENT, parent)
            client.update_run(run_id, name=name)
    else:
        about = {"mlflow.source.name": "mvest run", "folder": result.resolve().parent.name, **tags}
        about = {key: value for key, value in about.items() if value is not None}
        with mlflow.start_run(run_name=name, parent_run_id=parent, tags=about) as run:
            mlflow.log_params(texts)
            for step, values in numbers.items():
                mlflow.log_metrics(values, step=step)
            for path in sorted(path for name in FILES for path in result.parent.glob(name)):
                if path.name != PLAN and not path.name.startswith("."):
                    mlflow.log_artifact(str(path))
        # Its duration is that of the computation; the hash comes last and says that it is whole.
        run_id, end = run.info.run_id, run.info.start_time + int(1000 * seconds)
        client.set_terminated(
            run_id, "FAILED" if tags.get("status") == "failed" else "FINISHED", end
        )
        client.set_tag(run_id, WHOLE, digest)
    for old in before:
        if old.info.run_id != run_id:
            client.delete_run(old.info.run_id)
    return str(run_id), "there" if same else "added"


def runs_of(experiment: str, chosen: str) -> list[Run]:
    """The runs of an experiment in the open store that MLflow's filter chooses."""
    import mlflow

    names = [experiment]
    return mlflow.search_runs(experiment_names=names, filter_string=chosen, output_format="list")


def _text(value: Any) -> str:
    """A value as it is typed."""
    if isinstance(value, list):
        return f"[{','.join(map(_text, value))}]"
    return f"{value:.12g}" if isinstance(value, float) else str(value)
