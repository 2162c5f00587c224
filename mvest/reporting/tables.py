"""Tidy tables with the meaning of their columns: CSV, Markdown, LaTeX and JSON from one writer.

A table is a data frame (one row an observation, one column a quantity) and, for each column, its
unit, its digits and the columns that belong to it: a standard deviation, the ends of an interval,
the truth. Files for programs (CSV, JSON) hold every column as it is; texts for readers (Markdown,
LaTeX) round, and join what belongs together.
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
"""Characters of a line of a terminal, and rows that a terminal shows beside each other."""


@dataclass(frozen=True, slots=True)
class Column:
    """What the numbers of a column mean, and how a reader sees them.

    Attributes
    ----------
    unit : str
        Empty for what has none.
    digits : str
        Format specification, ``.2f`` say; empty: three significant digits.
    std : str
        Column with the standard deviation of this one: shown as ``value ± std``.
    low, high : str
        Columns with the ends of its interval: shown as ``value (low to high)``.
    truth : str
        Column with its true value, which has a place of its own: an interval that misses it is
        marked with a cross.
    label : str
        Heading for readers; empty: the name with spaces for underscores.
    hidden : bool
        Whether readers do not see it; files for programs always have it.
    """

    unit: str = ""
    digits: str = ""
    std: str = ""
    low: str = ""
    high: str = ""
    truth: str = ""
    label: str = ""
    hidden: bool = False

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
    """Rows of plain values under named columns.

    Attributes
    ----------
    values : mapping of str to list
        Column -> its values; None where a value is missing.
    columns : mapping of str to Column
        What columns mean; one that is not named here has no unit.
    """

    values: Mapping[str, Sequence[Any]]
    columns: Mapping[str, Column] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.values.values()), ()))

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The same, a mapping for each row."""
        return [
            dict(zip(self.values, row, strict=True))
            for row in zip(*self.values.values(), strict=True)
        ]

    @property
    def frame(self) -> DataFrame:
        """The same as a data frame; numbers that are missing are NaN."""
        import pandas as pd

        # Not with another type for whole numbers where one is missing: 3 stays 3 in a file.
        kinds = {name: {*map(type, values)} for name, values in self.values.items()}
        whole = {name: "Int64" for name, kind in kinds.items() if kind == {int, type(None)}}
        return pd.DataFrame(dict(self.values)).astype(whole)

    def csv(self) -> str:
        """The table for programs: a heading says its unit as ``name [unit]``."""
        units = {name: self._column(name).unit for name in self.values}
        headings = [f"{name} [{unit}]" if unit else name for name, unit in units.items()]
        return str(self.frame.to_csv(index=False, header=headings))

    def readable(self) -> list[dict[str, str]]:
        """Rows as readers see them: rounded, and joined with what belongs to a column."""
        joined = {
            other
            for name, column in self.columns.items()
            for other in (column.std, column.low, column.high)
            if name in self.values and other != name
        }
        shown = [n for n in self.values if n not in joined and not self._column(n).hidden]
        return [{self._heading(name): self._cell(name, row) for name in shown} for row in self.rows]

    def markdown(self) -> str:
        """The readable table in Markdown; a sentence where there is no row."""
        rows = self.readable()
        return markdown_rows(rows) if rows else "No rows."

    def latex(self) -> str:
        r"""The readable table in LaTeX, with ``\usepackage{booktabs}``; first column left."""
        import pandas as pd

        plain = [
            {
                shown_text(" ".join(k.split())): shown_text(" ".join(v.split()))
                for k, v in row.items()
            }
            for row in self.readable()
        ]
        if not plain:
            return "% no rows\n"
        sides = "l" + "r" * (len(plain[0]) - 1)
        return str(pd.DataFrame(plain).to_latex(index=False, escape=True, column_format=sides))

    def text(self) -> str:
        """The readable table for a terminal; few wide rows stand beside each other."""
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
        """A table from plain data; ``where`` names it in an error.

        Raises
        ------
        InputError
            If the data are no table.
        """
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

    Parameters
    ----------
    rows : iterable or DataFrame
        NumPy scalars become plain numbers, numbers that are not finite None.
    **columns : Column or str
        What columns mean; a text is ``unit:digits:label``, for example ``"mm:.2f"``, of which what
        follows may be missing. Named columns come first, in this order.

    Raises
    ------
    InputError
        If a named column, or one that belongs to it, does not exist although there are rows.
    """
    plain = _plain_rows(rows)
    names = list(dict.fromkeys(name for row in plain for name in row))
    about = {name: _column(spec) for name, spec in columns.items()}
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
    """Tables below each other; a first column says where each row comes from.

    Parameters
    ----------
    tables : mapping
        Value of the first column -> table.
    key : str
        Its name.
    """
    names = list(dict.fromkeys(name for part in tables.values() for name in part.values))
    columns = dict(ChainMap(*(dict(part.columns) for part in tables.values())))
    rows = [{key: label, **row} for label, part in tables.items() for row in part.rows]
    return Table({name: [row.get(name) for row in rows] for name in [key, *names]}, columns)


def _column(spec: Column | str) -> Column:
    if isinstance(spec, Column):
        return spec
    unit, digits, label = [*spec.split(":", 2), "", ""][:3]
    return Column(unit, digits, label=label)


def _plain_rows(rows: Iterable[Any] | DataFrame) -> list[dict[str, Any]]:
    given: Iterable[Any] = rows.to_dict("records") if hasattr(rows, "to_dict") else rows
    found = []
    for row in given:
        values = asdict(row) if is_dataclass(row) and not isinstance(row, type) else row
        found.append({str(name): _plain(value) for name, value in values.items()})
    return found


def _plain(value: Any) -> Any:
    value = value.item() if hasattr(value, "item") else value
    if type(value).__name__ == "NAType" or (isinstance(value, float) and not math.isfinite(value)):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
