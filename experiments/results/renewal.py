"""Which published results are stale, what it costs to renew them, and their renewal.

A record is stale if its job has another configuration today, or if the numbers that its study
follows have changed (`mvest.provenance.NUMBERS`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from experiments.cli import comment_of, quoted
from experiments.common.config import register
from experiments.common.places import CONF
from experiments.common.progress import say
from experiments.common.records.record import Record
from experiments.common.study import is_present, load_study
from experiments.results.published import publish, publish_as, records_of
from experiments.runner.compose import expand, make_plan
from experiments.runner.jobs import Request
from experiments.runner.plan import Plan
from experiments.runner.plugins import register_plugins
from experiments.runner.sweep import run_plan, share_of
from experiments.sweeps.collected import SWEEPS, head_of, read_sweep
from mvest.errors import ConfigurationError, MvestError
from mvest.provenance import NUMBERS
from mvest.reporting.tables import Column, table

FULL = "full"  # size of published sweeps
WITHOUT = "without_records.yaml"  # generations of pages of results that have no records


@dataclass(frozen=True)
class Configured:
    """A file of ``conf/experiment`` or ``conf/sweep``, read without composing it."""

    group: str
    stem: str
    values: dict[str, Any]  # top-level settings, own or inherited within the group
    about: str  # its leading comment

    @property
    def name(self) -> str:
        """What the command calls it."""
        return f"sweep_{self.stem}" if self.group == "sweep" else self.stem

    @property
    def table(self) -> str:
        """Its table of the results."""
        return str(self.values.get("table") or self.name)

    @property
    def words(self) -> list[str]:
        """Its overrides."""
        sized = FULL in (self.values.get("sweep") or {})
        return [f"{self.group}={self.stem}", *([f"sweep.size={FULL}"] if sized else [])]

    @property
    def has_many(self) -> bool:
        """Whether it is several jobs."""
        return dict(self.values.get("hydra") or {}).get("mode") == "MULTIRUN"

    @property
    def command(self) -> str:
        """The command that runs all of it."""
        return " ".join(["mvest run", *(["-m"] if self.has_many else []), *self.words])

    @cached_property
    def jobs(self) -> int:
        """The number of its jobs."""
        hydra, sweep = (self.values.get(key) or {} for key in ("hydra", "sweep"))
        config = OmegaConf.create({"hydra": {"sweeper": {}, **hydra}, "sweep": sweep})
        if config.sweep:
            config.sweep.size = FULL
        return len(expand(config, [], None)) if self.has_many else 1

    def records(self, results: Path) -> dict[str, Record]:
        """Its published records, by name, or of a sweep by the hash of the configuration."""
        if self.group == "sweep":
            path = results / SWEEPS / f"{self.stem}.json"
            kept = read_sweep(path).records if path.is_file() else []
            return {record.provenance.config_hash: record for record in kept}
        name = self.values.get("name", self.stem)
        every = records_of(results, self.table).records
        return {key: record for key, record in every.items() if record.experiment == name}

    def of_today(self, records: Mapping[str, Record], jobs: Sequence[Request]) -> set[str]:
        """Names of the records that today's jobs would give again."""
        named = {
            job.config_hash if self.group == "sweep" else str(job.publish_as): job.config_hash
            for job in jobs
        }
        return {
            name
            for name, record in records.items()
            if is_present(record) and named.get(name) == record.provenance.config_hash
        }

    def plan(self, results: Path) -> Plan:
        """All its jobs, composed; raises Hydra's and OmegaConf's errors, or an `MvestError`."""
        register()
        register_plugins()
        words = [*self.words, f"paths.results={quoted(str(results))}"]
        with initialize_config_dir(str(CONF), version_base="1.3"):
            settings = [*words, "hydra.mode=MULTIRUN"]
            config = compose("config", settings, return_hydra_config=True)
            loader = GlobalHydra.instance().config_loader()
            plan = make_plan(config, loader, expand(config, words, loader))
        if self.has_many:
            return plan
        (job,) = plan.jobs
        named = publish_as(job.values, job.overrides, None)
        return replace(plan, jobs=(replace(job, publish_as=named),))


def configured(folder: Path) -> list[Configured]:
    """What the files of a folder of ``conf/`` configure; a setting may be inherited."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.yaml"))}
    own = {stem: yaml.safe_load(text) for stem, text in texts.items()}

    def inherited(stem: str) -> dict[str, Any]:
        bases = [one for one in own[stem].get("defaults", ()) if one in list(own)]
        of_base = inherited(bases[0]) if bases else {}
        hydra = {**(of_base.get("hydra") or {}), **(own[stem].get("hydra") or {})}
        return of_base | own[stem] | ({"hydra": hydra} if hydra else {})

    return [Configured(folder.name, one, inherited(one), comment_of(texts[one])) for one in own]


@cache
def published() -> list[Configured]:
    """Everything whose results are published, in the order by which jobs are shared out."""
    found = [*configured(CONF / "experiment"), *configured(CONF / "sweep")]
    return sorted((one for one in found if one.values.get("publish")), key=lambda one: one.name)


def chosen(names: Sequence[str]) -> list[Configured]:
    """The published configurations of these names or tables, or all.

    Raises a `ConfigurationError` for an unknown name.
    """
    every = published()
    known = {name for one in every for name in (one.name, one.table)}
    for name in names:
        if name not in known:
            raise ConfigurationError(
                f"{name}: no published study; known: {', '.join(sorted(known))}"
            )
    return [one for one in every if not names or {one.name, one.table} & set(names)]


@dataclass(frozen=True, slots=True)
class Status:
    """How far the published results of a configuration are those of today's code."""

    of: Configured
    present: int  # jobs whose records are of today
    stale: int  # records that are not
    why: str  # "configuration", "numbers" or both; empty without a stale record
    seconds: float | None  # mean of a job, by the records; None without a record

    @property
    def missing(self) -> int:
        """Jobs without a record."""
        return max(0, self.of.jobs - self.present - self.stale)

    @property
    def to_make(self) -> int:
        """Jobs that are missing or stale."""
        return self.of.jobs - self.present

    @property
    def hours(self) -> float | None:
        """CPU hours of the jobs to make; None if no record tells."""
        if not self.to_make:
            return 0.0
        return None if self.seconds is None else self.to_make * self.seconds / 3600.0

    @property
    def text(self) -> str:
        """What is stale or missing; empty if every run is of today."""
        jobs = f" of {self.of.jobs} runs" if self.of.has_many else ""
        counts = {"stale": self.stale, "missing": self.missing}
        parts = [f"{count}{jobs} {name}" for name, count in counts.items() if count]
        return f"{self.of.name} ({', '.join(parts)})" if parts else ""


def status_of(one: Configured, results: Path) -> Status:
    """Compare published records with today's jobs.

    These are composed only if a record has today's numbers, because composing takes seconds.
    """
    records = one.records(results)
    old = {name for name, record in records.items() if not is_present(record)}
    jobs = one.plan(results).jobs if len(old) < len(records) else ()
    present = one.of_today(records, jobs)
    others = records.keys() - old - present
    reasons = (("numbers", old), ("configuration", others))
    return Status(
        one,
        len(present),
        len(records) - len(present),
        " and ".join(name for name, found in reasons if found),
        fmean(record.seconds_total for record in records.values()) or None if records else None,
    )


def run_results(studies: Sequence[str], run: bool, shard: str, results: Path) -> int:
    """List how far published results are of today, or make those that are not; the exit status.

    ``shard`` "K/N" makes every N-th job from the K-th on, counted over all that is published.

    Raises a `ConfigurationError` for an unknown study or shard.
    """
    take = share_of(shard)
    statuses = [status_of(one, results) for one in chosen(studies)]
    print(listing(statuses, results))
    if not run:
        return 0
    failed = 0
    for one in sorted(statuses, key=lambda one: (one.hours is None, one.hours)):
        try:
            failed += renew(one.of, results, take) if one.to_make or one.stale else 0
        except MvestError as error:
            say(f"failed: {one.of.name}: {error}")
            failed += 1
    from experiments.results.quoted import requote

    requote(results.resolve().parent / "README.md", results)
    return 1 if failed else 0


def renew(one: Configured, results: Path, take: slice = slice(None)) -> int:
    """Make the share ``take`` of what is missing or stale; returns how many jobs have no estimate.

    Finished jobs are published, also after an interruption. As soon as one is, the stale records
    are removed: a table of both would be a result of neither.

    Raises an `MvestError` if a job cannot be run.
    """
    plan, before = one.plan(results), one.records(results)
    known = {
        kept.provenance.config_hash: head_of(kept) for kept in before.values() if is_present(kept)
    }
    plan = replace(plan, before={**plan.before, **known})
    left = {job.config_hash for job in plan.to_run} - known.keys()
    todo = [job for job in share(one, plan.jobs, take) if job.config_hash in left]
    try:
        found = run_plan(plan, todo)
    finally:
        now = one.records(results)
        today = one.of_today(now, plan.jobs)
        gone = now.keys() - today
        if one.group != "sweep" and today and gone:
            publish(load_study(plan.common["study"]), results, one.table, {}, gone)
    hashes = {job.config_hash for job in todo}
    lost = [r for r in found.records if not r.converged and r.provenance.config_hash in hashes]
    return len(lost)


def share(one: Configured, jobs: Sequence[Request], take: slice) -> list[Request]:
    """Those of its jobs that a shard takes, counted over the jobs of all that is published."""
    before = itertools.takewhile(lambda other: other.name != one.name, published())
    first = sum(other.jobs for other in before)
    mine = range(first + len(jobs))[take]
    return [job for k, job in enumerate(jobs, first) if k in mine]


def listing(statuses: Sequence[Status], results: Path) -> str:
    """A table of all, the hours in total, and results that no record belongs to."""
    about = dict.fromkeys(("study", "jobs", "present", "missing", "stale", "why"), Column())
    about |= {"CPU hours": Column(digits=".2f"), "command": Column()}
    rows = [
        {
            "study": one.of.name,
            "jobs": one.of.jobs,
            **{key: getattr(one, key) for key in ("present", "missing", "stale", "why")},
            "CPU hours": "unknown" if one.hours is None else one.hours,
            "command": one.of.command,
        }
        for one in statuses
    ]
    hours = [one.hours for one in statuses]
    unknown = hours.count(None)
    jobs = sum(one.to_make for one in statuses)
    total = f"{jobs} jobs to make, about {sum(filter(None, hours)):.1f} CPU hours"
    if unknown:
        total += f", and the unknown ones of {unknown} studies"
    others = [f"{name} (stale)" if old else name for name, old in without_records(results).items()]
    if others:
        total += f"\nwithout records, written by other commands: {', '.join(others)}"
    return f"{table(rows, **about).text()}\n{total}"


def without_records(results: Path) -> dict[str, bool]:
    """Page of results without a record -> whether it is stale, by the file that lists them."""
    path = results / WITHOUT
    listed = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return {
        name: any(NUMBERS[kind] != of for kind, of in made.items()) for name, made in listed.items()
    }
