"""Virtual patients with a known truth: blind estimates, their verdicts and errors by group."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.common.cases import blind
from experiments.common.cases.own_case import PersonalSettings
from experiments.common.records.record import Record
from experiments.common.study import Result
from mvest.errors import InputError
from mvest.problem.record import EstimateRecord, Unknown
from mvest.problem.verdict import NONE
from mvest.reporting.skill import (
    VERDICTS,
    interval,
    interval_columns,
    moduli_figure,
    skill_table,
    trust_of,
)
from mvest.reporting.tables import Column, Table, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NOTHING = dict.fromkeys(("estimate", "std", "low", "high"))


def estimate_hidden(
    values: Mapping[str, Any], folder: Path, case: Path, sealed: Path, personal: PersonalSettings
) -> Result:
    """Estimate in a process that cannot see the truth; a failure has the priors of the moduli."""
    try:
        return blind.estimate_blindly(values, folder, case, sealed)
    except InputError as fault:
        believed = tuple(
            Unknown(name=name, unit="MPa", prior_mean=about.mean, prior_std=about.std)
            for name, about in personal.unknowns.items()
            if name.startswith("E_f.")
        )
        estimate = EstimateRecord(status="failed", reason=str(fault), unknowns=believed)
        return Result(status="failed", reason=str(fault), estimates=(estimate,))


@dataclass(frozen=True, slots=True)
class Groups:
    """Estimates by the name of their scenario, data or filter, with the verdicts that count."""

    members: Mapping[str, Sequence[tuple[EstimateRecord, str]]]

    @classmethod
    def of(cls, estimates: Iterable[tuple[str, EstimateRecord, EstimateRecord]]) -> Groups:
        """Groups from triples: name, estimate, and the estimate whose verdict counts for it."""
        groups: dict[str, list[tuple[EstimateRecord, str]]] = {}
        for name, estimate, own in estimates:
            groups.setdefault(name, []).append((estimate, trust_of(own)))
        return cls(groups)

    def unknowns(
        self, *, by_name: bool = False, nuisances: bool = False, stated: bool = True
    ) -> dict[str, list[Unknown]]:
        """The moduli of each group, with ``nuisances`` all its unknowns.

        ``by_name`` divides each group into ``GROUP, UNKNOWN``; ``stated`` leaves out numbers whose
        verdict is that there is no estimate.
        """
        found: dict[str, list[Unknown]] = {}
        for name, group in self.members.items():
            for estimate, trust in group:
                for own in estimate.parameters if nuisances else estimate.moduli:
                    known = own.model_copy(update=NOTHING) if stated and trust == NONE else own
                    found.setdefault(f"{name}, {own.name}" if by_name else name, []).append(known)
        return found

    def skill(self, by: str, *, stated: bool = True) -> Table:
        """Number of estimates by group and verdict, and the skill of their moduli.

        ``by`` names the first column; for ``stated`` see `unknowns`.
        """
        skill = skill_table(by, self.unknowns(stated=stated))
        trusts = {name: [trust for _, trust in group] for name, group in self.members.items()}
        rows = [row | {v: trusts[row[by]].count(v) for v in VERDICTS} for row in skill.rows]
        return table(rows, **skill.columns)

    def figure(self) -> Figure:
        """Moduli over their truths, a panel for each group and modulus."""
        return moduli_figure(
            {
                name: [(own, trust) for estimate, trust in group for own in estimate.moduli]
                for name, group in self.members.items()
            }
        )


def modulus_row(estimate: EstimateRecord, own: Unknown) -> dict[str, Any]:
    """A modulus with its interval and verdict, and its error even if no number may be stated."""
    error = own.relative_error
    return {
        "modulus": own.name,
        "truth": own.truth,
        "stated": own.estimate if estimate.is_stated else None,
        **interval("estimate", own),
        "verdict": trust_of(estimate),
        "error": None if error is None else 100.0 * error,
    }


MODULUS_COLUMNS: Mapping[str, Column] = {
    "modulus": Column(),
    "truth": Column("MPa"),
    **interval_columns("estimate", hidden=True),
    "stated": replace(interval_columns("estimate")["estimate"], label="estimate"),
    "verdict": Column(),
    "error": Column("%", "+.1f"),
}
"""Columns of `modulus_row`."""


def short(record: Record, *, nuisances: bool = False, details: Sequence[str] = ()) -> Record:
    """A record reduced to what tables and figures of estimates need."""

    def shortened(estimate: EstimateRecord) -> EstimateRecord:
        others = {name: shortened(other) for name, other in estimate.alternatives.items()}
        few = estimate.parameters if nuisances else estimate.moduli
        return estimate.model_copy(update={"unknowns": few, "alternatives": others})

    kept = tuple(shortened(estimate.without_details(*details)) for estimate in record.estimates)
    return record.model_copy(update={"estimates": kept})
