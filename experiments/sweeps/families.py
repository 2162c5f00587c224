"""Which runs of a sweep belong together, and what that is called.

Sweeps name their factors freely within their kind: a covariance is varied by its value or by a
scale, a discrepancy is the label of a truth. Here that becomes groups that tables, figures and
conclusions share.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from experiments.sweeps.rows import Run, factor_label, factor_text
from experiments.sweeps.statistics import grouped

__all__ = [
    "NO_DISCREPANCY",
    "SEED",
    "Line",
    "NoiseGroup",
    "covariance_lines",
    "discrepancies",
    "filter_conditions",
    "is_own_model",
    "noise_groups",
    "setting_words",
    "settings_of",
    "varied_names",
]

SEED = "seed"
"""A factor of this name is a repetition, not a setting."""
COVARIANCES = ("P0", "Q", "R")
NO_DISCREPANCY = ("none", "same model")
"""Names of a truth that is the filter's own model."""
NOT_A_KIND_OF_NOISE = ("kind", "noise_mm", "correlated_mm", SEED)


@dataclass(frozen=True, slots=True)
class NoiseGroup:
    """Runs under one kind of noise at one level in mm, per coordinate."""

    kind: str
    level: float
    runs: list[Run]

    @property
    def label(self) -> str:
        """Kind and level in a few words."""
        return f"{self.kind}, {self.level:g} mm" if self.level else f"{self.kind}, no noise"


@dataclass(frozen=True, slots=True)
class Line:
    """Runs that differ in one covariance alone: value and runs of each point, in order."""

    mode: str
    quantity: str
    others: str
    points: list[tuple[float, list[Run]]]


def varied_names(runs: Sequence[Run]) -> list[str]:
    """Factors other than the seed that take more than one value."""
    names = list(dict.fromkeys(name for run in runs for name in run.factors))
    return [
        name
        for name in names
        if name != SEED and len({factor_text(run.factors.get(name)) for run in runs}) > 1
    ]


def settings_of(runs: Sequence[Run]) -> dict[tuple[Any, ...], list[Run]]:
    """Runs that agree in every factor but the seed."""
    names = list(dict.fromkeys(name for run in runs for name in run.factors if name != SEED))
    return grouped(runs, names)


def setting_words(run: Run, names: Sequence[str]) -> str:
    """A run's values of these factors: a text as it is, a number with its name and unit."""
    words = []
    for name in names:
        value = run.factors.get(name)
        if isinstance(value, str):
            words.append(value)
        elif value is not None:
            stem, _, unit = factor_label(name).partition(" [")
            # P0 and Q have the unit of the filter's coordinates, which is no word.
            unit = "" if unit.startswith("filter") else unit.rstrip("]")
            words.append(f"{stem} {factor_text(value)} {unit}".rstrip())
    return ", ".join(words) or "all runs"


def noise_groups(runs: Sequence[Run]) -> list[NoiseGroup]:
    """Groups of runs by kind of noise and level, in the order of the sweep.

    Independent and correlated errors add up in the level. Where runs of one kind and level differ
    in something else, what the filter assumes of the noise, say, that becomes part of the kind.
    """
    names = list(dict.fromkeys(name for run in runs for name in run.factors))
    groups = []
    for (kind,), group in grouped(runs, ["kind"]).items():
        by_level: dict[float, list[Run]] = {}
        for run in group:
            by_level.setdefault(_level(run.factors), []).append(run)
        parting = [
            name
            for name in names
            if name not in NOT_A_KIND_OF_NOISE
            and any(name in varied_names(level) for level in by_level.values())
        ]
        for values, part in grouped(group, parting).items():
            more = setting_words(part[0], parting) if values else ""
            label = f"{factor_text(kind)}, {more}" if more else factor_text(kind)
            levels: dict[float, list[Run]] = {}
            for run in part:
                levels.setdefault(_level(run.factors), []).append(run)
            groups += [NoiseGroup(label, level, levels[level]) for level in sorted(levels)]
    return groups


def _level(factors: Mapping[str, Any]) -> float:
    return math.hypot(float(factors["noise_mm"]), float(factors.get("correlated_mm") or 0.0))


def covariance_lines(runs: Sequence[Run]) -> list[Line]:
    """Lines through the sweep along each covariance, everything else kept.

    Given either by ``varied`` and ``scale`` or by values of P0, Q and R.
    """
    scaled = all("varied" in run.factors for run in runs)
    if scaled:
        quantities = list(dict.fromkeys(str(run.factors["varied"]) for run in runs))
    else:
        quantities = [name for name in COVARIANCES if name in varied_names(runs)]
    lines = []
    for quantity in quantities:
        key = "scale" if scaled else quantity
        chosen = [run for run in runs if not scaled or run.factors["varied"] == quantity]
        kept = [
            name
            for name in dict.fromkeys(n for run in runs for n in run.factors)
            if name not in (key, "varied", "filter", SEED)
        ]
        for values, group in grouped(chosen, ["filter", *kept]).items():
            found: dict[float, list[Run]] = {}
            for run in group:
                found.setdefault(float(run.factors[key]), []).append(run)
            others = setting_words(group[0], [n for n in kept if n in varied_names(runs)])
            points = [(value, found[value]) for value in sorted(found)]
            lines.append(Line(str(values[0]), quantity, "" if scaled else others, points))
    return lines


def discrepancies(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs by discrepancy, and by whatever else is varied besides."""
    groups = settings_of(runs)
    names = [name for name in varied_names(runs) if name not in ("discrepancy", "truth")]
    found: dict[str, list[Run]] = {}
    for group in groups.values():
        factors = group[0].factors
        label = factor_text(factors.get("discrepancy", factors.get("truth")))
        if names:
            label = f"{label}, {setting_words(group[0], names)}"
        found.setdefault(label, []).extend(group)
    return found


def is_own_model(runs: Sequence[Run]) -> bool:
    """Whether the truth of these runs is the filter's own model."""
    factors = runs[0].factors
    return factors.get("discrepancy", factors.get("truth")) in NO_DISCREPANCY


def filter_conditions(runs: Sequence[Run]) -> dict[str, dict[str, list[Run]]]:
    """Condition -> name of the filter -> runs: filters are compared under equal conditions.

    The filter's name holds its coordinates where these are varied; any other factor is a condition.
    """
    varied = varied_names(runs)
    own = ["filter", *(name for name in varied if name == "transform")]
    conditions = [name for name in varied if name not in own]
    found: dict[str, dict[str, list[Run]]] = {}
    for run in runs:
        condition = setting_words(run, conditions) if conditions else ""
        name = setting_words(run, own)
        found.setdefault(condition, {}).setdefault(name, []).append(run)
    return found
