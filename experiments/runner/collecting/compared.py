"""What jobs are told apart by: the typed settings that differ, with a column for each value."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from experiments.common.config import is_hashed
from experiments.common.records.metrics import short_names

Values = Mapping[str, Any]

HANDFUL = (
    "study", "valve.folder_sha256", "mesh.source", "mechanics.element", "filter.mode",
    "truth.label", "observation.noise_mm", "seed",
)  # fmt: skip
"""Settings that every run shows, typed or not."""


def typed(overrides: Iterable[str]) -> list[str]:
    """Names of settings that were typed (``NAME=VALUE``), each once."""
    names = (word.lstrip("+~").partition("=")[0].replace("/", ".") for word in overrides)
    return list(dict.fromkeys(name for name in names if name != "name"))


def columns(config: Values, words: Iterable[str]) -> dict[str, Any]:
    """The settings of a run that were typed, and the handful: a column for each value.

    Parameters
    ----------
    config : mapping
        As it lies beside the result: without a name of a file, which must not reach a store.
    words : iterable of str
        Dotted names; of one that has settings below it all are meant.
    """
    chosen = tuple(f"{word}." for word in (*words, *HANDFUL))
    return {
        name: value
        for name, value in leaves(config, config["parameters"]).items()
        if f"{name}.".startswith(chosen) and is_hashed(name, config["study"])
    }


def leaves(value: Any, parameters: Sequence[str], name: str = "") -> dict[str, Any]:
    """Single values by dotted names; of a list by its parameters, of a matrix the diagonal."""
    if isinstance(value, list):
        names = short_names(parameters) if len(value) == len(parameters) else range(len(value))
        square = all(isinstance(item, list) and len(item) == len(value) for item in value)
        value = [row[k] for k, row in enumerate(value)] if square else value
        value = dict(zip(names, value, strict=True))
    if not isinstance(value, Mapping):
        return {} if value in (None, "") else {name: value}
    found: dict[str, Any] = {}
    for key, item in value.items():
        found |= leaves(item, parameters, f"{name}.{key}" if name else str(key))
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


def together(rows: Sequence[Values], words: Iterable[str]) -> dict[str, str]:
    """The values that typed settings have in a sweep, as they are typed: ``[5,3],[4,2]``."""
    found: dict[str, dict[str, None]] = {}
    for row in rows:
        for word in (*words, *HANDFUL):
            own = [
                text_of(value) for name, value in row.items() if f"{name}.".startswith(f"{word}.")
            ]
            if own:
                whole = own[0] if word in row else f"[{','.join(own)}]"
                found.setdefault(word, {})[whole] = None
    return {word: ",".join(texts) for word, texts in found.items()}


def text_of(value: Any) -> str:
    """A value as it is typed."""
    return f"{value:.12g}" if isinstance(value, float) else str(value)
