"""A study: what its room offers to the runner, and how rooms are found.

A room is a folder ``experiments/studies/NAME`` whose module ``study`` holds the object ``STUDY``.
It is found by being there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Generic, TypeVar

import experiments.studies
from experiments.common.records.record import Outcome, Record
from mvest.errors import ConfigurationError

__all__ = ["Check", "Job", "Section", "Study", "load_settings", "load_study", "study_names"]

S = TypeVar("S")
F = TypeVar("F")

Check = Callable[[Mapping[str, Any], Path], str]

ROOMS = Path(experiments.studies.__file__).parent


@dataclass(frozen=True, slots=True)
class Job(Generic[S]):
    """What a study is asked to compute.

    Attributes
    ----------
    values : mapping
        The resolved configuration as plain data, for what all studies build alike.
    settings : S
        The study's own part of it.
    folder : Path
        Output folder, which exists.
    config_hash : str
        For studies that leave files beside their record.
    """

    values: Mapping[str, Any]
    settings: S
    folder: Path
    config_hash: str = "none"


@dataclass(frozen=True, slots=True)
class Section:
    """A section of the page of all results.

    Attributes
    ----------
    name : str
        Of ``results/NAME.md``, which is its text.
    pictures : mapping
        Picture in ``results/`` without its ending -> caption.
    title : str
        Where the text brings no heading.
    validation : bool
        Whether it shows that the model and its numerics are right, rather than what a study found.
    table : str
        Of the kept records; empty: of this name.
    answer : callable or None
        Name -> kept record of the table -> what follows, in one line.
    headline : bool
        Whether the page begins with its answer.
    opens : str
        The picture of it that stands there too, above its answer; empty for most.
    """

    name: str
    pictures: Mapping[str, str] = field(default_factory=dict)
    title: str = ""
    validation: bool = False
    table: str = ""
    answer: Callable[[Mapping[str, Record[Any]]], str] | None = None
    headline: bool = False
    opens: str = ""


def _nothing(*_: Any) -> None:
    """Nothing more is done."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study(Generic[S, F]):
    """How a kind of study is run, put into words, tabulated and published.

    Attributes
    ----------
    settings : type
        Frozen dataclass of the room's ``settings.py``: what the study adds to the configuration.
    findings : type
        Dataclass of what it computes.
    run : callable
        Job -> outcome.
    words : callable
        Record -> text for the terminal.
    write : callable
        (folder, name -> record, name -> file of arrays) -> files written there. The records are all
        those of one table, the main one first; a run by itself hands over its own record. Arrays
        are those that a run left as ``fields.npz``, for the records that still have them.
    write_run : callable or None
        (folder, record) -> files written into a run's own folder; None: those of `write`.
    keep : callable
        Record -> what of it the results keep.
    keep_arrays : callable
        File of arrays of a run -> those that the results keep beside its record; none by default.
    keeps_failures : bool
        Whether the results also take over a run that found no estimate: where a share of runs is
        counted, those must count that failed.
    finish : callable
        (job, record): what is done with a run that is on disk, also with one that was done before.
    checks : callable
        () -> what ``check=true`` says, one after another, without estimating anything, each
        (configuration, output folder) -> text. Made once for all jobs of a sweep.
    require : callable
        Configuration -> None; raises `ConfigurationError` for settings that no job could run with.
    sections : tuple of Section
    """

    settings: type[S]
    findings: type[F]
    run: Callable[[Job[S]], Outcome[F]]
    words: Callable[[Record[F]], str]
    write: Callable[[Path, Mapping[str, Record[F]], Mapping[str, Path]], list[Path]]
    write_run: Callable[[Path, Record[F]], list[Path]] | None = None
    keep: Callable[[Record[F]], Record[F]] = lambda record: record
    keep_arrays: Callable[[Record[F], Path], Mapping[str, Any]] = lambda record, path: {}
    keeps_failures: bool = False
    finish: Callable[[Job[S], Record[F]], None] = _nothing
    checks: Callable[[], tuple[Check, ...]] = tuple
    require: Callable[[Mapping[str, Any]], None] = _nothing
    sections: tuple[Section, ...] = ()


def study_names() -> tuple[str, ...]:
    """Names of all rooms, in alphabetical order."""
    return tuple(sorted(path.parent.name for path in ROOMS.glob("*/study.py")))


def load_settings(name: str) -> type:
    """The settings of a room, without what computes with them."""
    settings = import_module(f"{experiments.studies.__name__}.{name}.settings").Settings
    assert isinstance(settings, type)
    return settings


def load_study(name: str) -> Study[Any, Any]:
    """The study of a room; no other room is imported.

    Raises
    ------
    ConfigurationError
        If there is no such room.
    """
    if name not in study_names():
        raise ConfigurationError(f"study = {name!r}, expected one of {', '.join(study_names())}")
    study = import_module(f"{experiments.studies.__name__}.{name}.study").STUDY
    assert isinstance(study, Study)
    return study
