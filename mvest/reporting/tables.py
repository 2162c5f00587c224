"""Tidy tables with the meaning of their columns: CSV, Markdown, LaTeX and JSON from one writer.

A table has one row per observation and one column per quantity. For each column it knows the unit,
the digits and the columns that belong to it: a standard deviation, the ends of an interval, the
truth. Files for programs (CSV, JSON) hold every column unrounded. Texts for readers (Markdown,
LaTeX) are rounded and show a value and its uncertainty in one cell.
"""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from typing import TYPE_CHECKING, Any

from mvest.errors import InputError
from mvest.reporting.markup import MISSING, markdown_rows, number, shown_text

if TYPE_CHECKING:
    from pandas import DataFrame

WIDTH, MOST_BESIDE = 100, 5
"""Characters of a line of a terminal, and the most rows that are transposed to fit into it."""


@dataclass(frozen=True, slots=True)
class Column:
    """Meaning of a column, and how readers see it."""

    unit: str = ""  #: empty if it has none
    digits: str = ""  #: format specification such as ``.2f``; empty: three significant digits
    std: str = ""  #: column of standard deviations, shown as ``value ± std``
    #: columns of the ends of an interval, shown as ``value (low to high)``
    low: str = ""
    high: str = ""
    truth: str = ""  #: column of true values; an interval that misses it is marked with a cross
    label: str = ""  #: heading for readers; empty: the name with spaces for underscores
    hidden: bool = False  #: whether only files for programs have the column

    def text(self, value: Any) -> str:
        """One value as a reader sees it."""
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return MISSING
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, float):
            return format(value, self.digits) if self.digits else number(value)
        return str(value)


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows of plain values under named columns."""

    values: Mapping[str, Sequence[Any]]  #: column -> its values; None if a value is missing
    #: meaning of columns; one that is not named here has no unit
    columns: Mapping[str, Column] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.values.values()), ()))

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A mapping for each row."""
        return [
            dict(zip(self.values, row, strict=True))
            for row in zip(*self.values.values(), strict=True)
        ]

    @property
    def frame(self) -> DataFrame:
        """The table as a data frame; missing numbers are NaN."""
        import pandas as pd

        # Counts stay whole numbers in a file if some are missing.
        kinds = {name: {*map(type, values)} for name, values in self.values.items()}
        whole = {name: "Int64" for name, kind in kinds.items() if kind == {int, type(None)}}
        return pd.DataFrame(dict(self.values)).astype(whole)

    def csv(self) -> str:
        """The table for programs, with headings ``name [unit]``."""
        units = {name: self._column(name).unit for name in self.values}
        headings = [f"{name} [{unit}]" if unit else name for name, unit in units.items()]
        return str(self.frame.to_csv(index=False, header=headings))

    def readable(self) -> list[dict[str, str]]:
        """Rounded rows, a value and its uncertainty in one cell."""
        joined = {
            other
            for name, column in self.columns.items()
            for other in (column.std, column.low, column.high)
            if name in self.values and other != name
        }
        shown = [n for n in self.values if n not in joined and not self._column(n).hidden]
        return [{self._heading(name): self._cell(name, row) for name in shown} for row in self.rows]

    def markdown(self) -> str:
        """The readable table in Markdown, or a sentence if it is empty."""
        rows = self.readable()
        return markdown_rows(rows) if rows else "No rows."

    def latex(self) -> str:
        r"""The readable table in LaTeX, with ``\usepackage{booktabs}``; first column left."""
        import pandas as pd

        shown = pd.DataFrame(self.readable())
        if shown.empty:
            return "% no rows\n"
        plain = shown.rename(columns=_one_line).map(_one_line)
        sides = "l" + "r" * (plain.shape[1] - 1)
        return str(plain.to_latex(index=False, escape=True, column_format=sides))

    def text(self) -> str:
        """The readable table for a terminal; a few wide rows are transposed."""
        import pandas as pd

        shown = pd.DataFrame(self.readable())
        text = str(shown.to_string(index=False))
        if shown.empty or len(shown) > MOST_BESIDE or len(text.partition("\n")[0]) <= WIDTH:
            return text
        turned = shown.set_index(shown.columns[0]).T
        turned.columns.name = None
        return str(turned.to_string())

    def plain(self) -> dict[str, Any]:
        """Plain data for JSON; `Table.of_plain` reads them."""
        about = {
            name: {key: value for key, value in asdict(column).items() if value}
            for name, column in self.columns.items()
        }
        return {"columns": about, "values": {k: list(v) for k, v in self.values.items()}}

    @classmethod
    def of_plain(cls, data: Mapping[str, Any], where: str) -> Table:
        """A table from plain data; an InputError names ``where`` if they are no table."""
        try:
            columns = {name: Column(**about) for name, about in data["columns"].items()}
            values = {str(name): list(column) for name, column in data["values"].items()}
        except (KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{where} is no table: {error}") from error
        if len({len(column) for column in values.values()}) > 1:
            raise InputError(f"{where} is no table: its columns differ in length")
        return cls(values, columns)

    def _column(self, name: str) -> Column:
        return self.columns.get(name, Column())

    def _heading(self, name: str) -> str:
        column = self._column(name)
        label = column.label or name.replace("_", " ")
        return f"{label} ({column.unit})" if column.unit else label

    def _cell(self, name: str, row: Mapping[str, Any]) -> str:
        column = self._column(name)
        text = column.text(row[name])
        if text == MISSING:
            return text
        std, low, high, truth = (
            row.get(other) if other else None
            for other in (column.std, column.low, column.high, column.truth)
        )
        if (shown := column.text(std)) != MISSING:
            text += f" ± {shown if column.digits else number(std, 2)}"
        if low is not None and high is not None:
            text += f" ({column.text(low)} to {column.text(high)})"
            text += " ✗" if truth is not None and not low <= truth <= high else ""
        return text


def table(rows: Iterable[Any] | DataFrame, **columns: Column | str) -> Table:
    """A table from a data frame, or from rows that are mappings or dataclasses.

    InputError if there are rows without a named column, or without one that belongs to it.

    Parameters
    ----------
    rows : iterable or DataFrame
        NumPy scalars become plain numbers, and numbers that are not finite become None.
    **columns : Column or str
        Meaning of columns, in the order in which they come first; a text is
        ``unit:digits:label``, such as ``"mm:.2f"``, whose last parts may be missing.
    """
    plain = _plain_rows(rows)
    names = list(dict.fromkeys(name for row in plain for name in row))
    about = {
        name: spec if isinstance(spec, Column) else _column(spec) for name, spec in columns.items()
    }
    needed = [
        name
        for key, column in about.items()
        for name in (key, column.std, column.low, column.high, column.truth)
        if name
    ]
    unknown = sorted(set(needed) - set(names))
    if unknown and plain:
        raise InputError(f"a table without the column {', '.join(unknown)}; it has {names}")
    order = list(dict.fromkeys([*about, *names]))
    return Table({name: [row.get(name) for row in plain] for name in order}, about)


def joined(tables: Mapping[str, Table], key: str = "run") -> Table:
    """Concatenated tables; the first column ``key`` has the name of each row's table."""
    names = list(dict.fromkeys(name for part in tables.values() for name in part.values))
    columns = dict(ChainMap(*(dict(part.columns) for part in tables.values())))
    rows = [{key: label, **row} for label, part in tables.items() for row in part.rows]
    return Table({name: [row.get(name) for row in rows] for name in [key, *names]}, columns)


def _column(spec: str) -> Column:
    unit, digits, label = [*spec.split(":", 2), "", ""][:3]
    return Column(unit, digits, label=label)


def _one_line(text: str) -> str:
    return shown_text(" ".join(text.split()))


def _plain_rows(rows: Iterable[Any] | DataFrame) -> list[dict[str, Any]]:
    given: Iterable[Any] = rows.to_dict("records") if hasattr(rows, "to_dict") else rows
    plain = (asdict(row) if is_dataclass(row) else row for row in given)  # type: ignore[arg-type]
    return [{str(name): _plain(value) for name, value in row.items()} for row in plain]


def _plain(value: Any) -> Any:
    value = value.item() if hasattr(value, "item") else value
    if type(value).__name__ == "NAType" or (isinstance(value, float) and not math.isfinite(value)):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
