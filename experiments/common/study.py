"""A study: what it computes, and what the runner and the writer of results need from it.

A study is a module ``experiments/studies/NAME.py``, or a package of that name, with an object
``STUDY``; it needs no registration. It refuses a request by an `MvestError`, which the runner
prints in one line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar, cast

import experiments.studies
from experiments.common.records.record import Record
from experiments.common.records.record import Result as Result
from experiments.common.schema import Values, hints_of, validated
from mvest.errors import ConfigurationError
from mvest.problem.record import EstimateRecord
from mvest.provenance import NUMBERS
from mvest.reporting.tables import Table, joined

if TYPE_CHECKING:
    from matplotlib.figure import Figure

S = TypeVar("S")

Figures: TypeAlias = "Figure | Mapping[str, Figure] | None"
"""A figure, figures by name ("" is the main one), or None if there is nothing to draw."""

STUDIES = Path(experiments.studies.__file__).parent


@dataclass(frozen=True, slots=True)
class Job(Generic[S]):
    """The input of a study.

    ``values`` is the resolved configuration as plain data, ``settings`` the study's own part of it;
    ``folder``, the output folder, exists.
    """

    values: Mapping[str, Any]
    settings: S
    folder: Path
    config_hash: str = "none"


@dataclass(frozen=True, slots=True)
class Results:
    """The records of all runs of one published table, or of a single run."""

    records: Mapping[str, Record]  # by name; the record that the table is named after is first
    arrays: Mapping[str, Path] = field(default_factory=dict)  # files of those that have arrays

    @property
    def first(self) -> Record:
        """The main record."""
        return next(iter(self.records.values()))

    @property
    def first_arrays(self) -> Path | None:
        """The file of arrays of the main record, if it has one."""
        return self.arrays.get(next(iter(self.records)))

    @property
    def estimates(self) -> list[tuple[Record, EstimateRecord]]:
        """Each record that has estimates, with its first one."""
        return [(one, one.estimates[0]) for one in self.records.values() if one.estimates]

    @property
    def is_empty(self) -> bool:
        """Whether all records failed before they had anything to show."""
        return not any(one.tables or one.estimates for one in self.records.values())

    @property
    def table_names(self) -> tuple[str, ...]:
        """Names of the tables of any record."""
        return tuple(dict.fromkeys(name for one in self.records.values() for name in one.tables))

    def table(self, name: str = "") -> Table:
        """One table of all records; of several records a first column ``run`` names each.

        Raises a `KeyError` if no record has it.
        """
        parts = {one.row: one.table_of(name) for one in self.records.values() if name in one.tables}
        if not parts:
            raise KeyError(name)
        return joined(parts) if len(self.records) > 1 else next(iter(parts.values()))


@dataclass(frozen=True, slots=True, kw_only=True)
class Study(Generic[S]):
    """How a kind of study is run and shown."""

    settings: type[S]  # frozen dataclass: what the study adds to the configuration
    part: str = ""  # name of this part of the configuration; empty: its fields are top-level
    run: Callable[[Job[S]], Result]
    # Tables for readers, by name. The results' own tables are then written as CSV only.
    summary: Callable[[Results], Mapping[str, Table]] | None = None
    figure: Callable[[Results], Figures] | None = None
    captions: Mapping[str, str] = field(default_factory=dict)  # by name of the figure
    latex: tuple[str, ...] = ()  # names of the paper's own tables and figures: LaTeX and PDF, too
    words: Callable[[Record], str] | None = None  # text for the terminal; None: the tables
    # Further files in the folder of a run, for example a report.
    files: Callable[[Path, Record], list[Path]] | None = None
    keep: Callable[[Record], Record] = lambda record: record  # the part that is published
    # Arrays that are published with a record, from the file of all its arrays.
    keep_arrays: Callable[[Record, Path], Mapping[str, Any]] = lambda record, path: {}
    keeps_failures: bool = False  # publish failed runs, too, because the study counts them
    # (configuration, output folder) -> text that ``check=true`` prints without estimating
    check: Callable[[Mapping[str, Any], Path], str] | None = None
    # Raises a `ConfigurationError` for settings that no job could run with.
    require: Callable[[Mapping[str, Any]], None] = lambda values: None
    # Kinds of golden runs whose numbers change if those of this study do (see `NUMBERS`).
    golden: tuple[str, ...] = tuple(NUMBERS)

    @property
    def kinds(self) -> dict[str, Any]:
        """Top-level settings that the study adds -> their types."""
        return {self.part: self.settings} if self.part else hints_of(cast(type, self.settings))

    def settings_of(self, values: Values) -> S:
        """Its settings in a configuration; raises an `MvestError` if one is inadmissible."""
        own = values[self.part] if self.part else values
        return cast(S, validated(self.settings, own, self.part))


def study_names() -> tuple[str, ...]:
    """Names of all studies, in alphabetical order."""
    modules = [p.stem for p in STUDIES.glob("*.py") if p.stem != "__init__"]
    packages = [p.parent.name for p in STUDIES.glob("*/study.py")]
    return tuple(sorted([*modules, *packages]))


def load_study(name: str) -> Study[Any]:
    """The study of that name; no other study is imported.

    Raises a `ConfigurationError` if there is none.
    """
    if name not in study_names():
        raise ConfigurationError(f"study = {name!r}, expected one of {', '.join(study_names())}")
    module = f"{experiments.studies.__name__}.{name}"
    study = import_module(module if (STUDIES / f"{name}.py").is_file() else f"{module}.study").STUDY
    assert isinstance(study, Study)
    return study


def is_present(record: Record) -> bool:
    """Whether the numbers that a record's study follows have not changed since."""
    known, kinds = record.provenance.numbers, load_study(record.study).golden
    return all(known.get(kind, 0) == NUMBERS[kind] for kind in kinds)
