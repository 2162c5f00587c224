"""Tables and figures of synthetic studies, and what is refused before one runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import build_filter
from experiments.common.plain import Plain, flat
from experiments.common.record import Record
from experiments.studies.twin.tables import text_table, write_tables
from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.estimation.noise import observation_noise

__all__ = ["require_twin", "table1_answer", "text_table_of", "write_twin", "write_twin_run"]


def text_table_of(record: Mapping[str, Any]) -> str:
    """The table of one run for the terminal."""
    return text_table([record])


def write_twin(
    folder: Path, records: Mapping[str, Record[Plain]], arrays: Mapping[str, Path]
) -> list[Path]:
    """The table of all records, and the figures of the one that the table is named after."""
    from mvest.reporting.figures import iterates_figure, save_figure, valve_figure

    first, main = next(iter(records.items()))
    table = main.table
    written = write_tables(folder, table, [flat(record) for record in records.values()])
    if first == table and main.findings["iterates"]:
        written += save_figure(folder / table, iterates_figure(flat(main)), flat(main))
    if first == table and first in arrays:
        written += save_figure(folder / f"{table}_valve", valve_figure(arrays[first]), flat(main))
    return written


def table1_answer(records: Mapping[str, Record[Plain]]) -> str:
    """How far moduli are off, in one line: seen by the same model, and by others."""
    sentences = []
    for record in records.values():
        error = record.findings["moduli_error_percent"]
        off = f"{error['mean']:.2g} %" if record.converged and error else "no estimate"
        sentences.append(f"{record.row} {off}")
    return f"Mean error of all moduli by what was seen (simulated): {', '.join(sentences)}."


def write_twin_run(folder: Path, record: Record[Plain]) -> list[Path]:
    """The table of one run."""
    return write_tables(folder, record.table, [flat(record)])


def require_twin(values: Mapping[str, Any]) -> None:
    """Refuse settings of filter and observation that no job could run with.

    Raises
    ------
    ConfigurationError
        If a setting is inadmissible; the message names it.
    """
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
