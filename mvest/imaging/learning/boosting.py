"""Gradient-boosted trees (LightGBM), several outputs side by side, kept as plain text.

The text is checked before LightGBM reads it, because LightGBM trusts it: a child or a feature that
does not exist is read from memory that is not the trees' own, and a number that is none ends the
process. The format is that of ``Booster.model_to_string`` (LightGBM 4, "version=v4").
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.quantities import Count, Processes, Share
from mvest.typing import FloatArray


@dataclass(frozen=True, slots=True)
class BoostSettings:
    """How trees are grown.

    Attributes
    ----------
    trees, leaves : int
    rate : float
        Share of each tree's answer that is taken.
    min_leaf_samples : int
        Samples that a leaf holds at least.
    share_features, share_rows : float
        Of what there is, drawn anew for every tree.
    threads : int
    """

    trees: Count = 80
    leaves: Count = 24
    rate: Share = 0.12
    min_leaf_samples: Count = 40
    share_features: Share = 0.25
    share_rows: Share = 0.7
    threads: Processes = 1

    def parameters(self, objective: str, seed: int) -> dict[str, Any]:
        """LightGBM's names for them."""
        return {
            "objective": objective,
            "num_leaves": self.leaves,
            "learning_rate": self.rate,
            "min_data_in_leaf": self.min_leaf_samples,
            "feature_fraction": self.share_features,
            "bagging_fraction": self.share_rows,
            "bagging_freq": 1,
            "max_bin": 63,
            "num_threads": self.threads,
            "seed": seed,
            "deterministic": True,
            "force_row_wise": True,
            "verbosity": -1,
        }


class Boosters:
    """Trees for each of several outputs of the same features.

    Parameters
    ----------
    texts : tuple of str
        As LightGBM writes trees, one for each output.
    source : str
        Named in errors.

    Raises
    ------
    InputError
        If there is no text, one is malformed, or they look at different features.
    """

    def __init__(self, texts: tuple[str, ...], source: str = "model") -> None:
        checked = [checked_trees(text, source) for text in texts]
        counts = {features for _, features in checked}
        if len(counts) != 1:
            raise InputError(f"{source}: trees of {sorted(counts)} features, expected one number")
        self._begin(tuple(text for text, _ in checked), counts.pop(), source)

    def _begin(self, texts: tuple[str, ...], features: int, source: str) -> None:
        import lightgbm  # here, as it takes a second that studies without images need not wait

        self.texts, self.features, self._source = texts, features, source
        try:
            self._boosters = [lightgbm.Booster(model_str=text) for text in self.texts]
        except lightgbm.basic.LightGBMError as fault:
            raise InputError(f"{source}: no trees that LightGBM reads ({fault})") from fault

    def __reduce__(self) -> tuple[Callable[..., Boosters], tuple[tuple[str, ...], int, str]]:
        # Between processes of one program: what was checked once is not checked again.
        return _as_checked, (self.texts, self.features, self._source)

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return len(self.texts)

    def __call__(self, x: NDArray[np.float32]) -> FloatArray:
        """Outputs ``(P, outputs)`` for features ``(P, F)``."""
        if x.shape[1] != self.features:
            raise InputError(
                f"{self._source}: trees look at {self.features} features, found {x.shape[1]}; the "
                "model is of another version"
            )
        if not len(x):
            return np.zeros((0, self.outputs))
        answers = [np.asarray(b.predict(x, num_threads=1)) for b in self._boosters]
        return np.stack(answers, axis=1)


@lru_cache(maxsize=64)
def _as_checked(texts: tuple[str, ...], features: int, source: str) -> Boosters:
    """Trees that another process sent: those of one call after another are read once."""
    made = Boosters.__new__(Boosters)
    made._begin(texts, features, source)
    return made


def train_boosters(
    x: NDArray[np.float32],
    y: FloatArray,
    settings: BoostSettings,
    seed: int,
    objective: str = "regression",
    weight: FloatArray | None = None,
) -> Boosters:
    """Grow trees for every column of ``y (P, outputs)``.

    Parameters
    ----------
    objective : str
        ``regression`` (least squares), or ``cross_entropy`` (probability; labels from 0 to 1).
    """
    import lightgbm

    data = lightgbm.Dataset(
        x,
        label=np.ascontiguousarray(y[:, 0]),
        weight=weight,
        free_raw_data=False,
        params={"max_bin": 63, "verbosity": -1},
    )
    texts = []
    for k in range(y.shape[1]):
        data.set_label(np.ascontiguousarray(y[:, k]))
        booster = lightgbm.train(
            settings.parameters(objective, seed + k), data, num_boost_round=settings.trees
        )
        texts.append(booster.model_to_string())
    return Boosters(tuple(texts))


END: Final = "end of trees\n"
OBJECTIVES: Final = ("regression", "binary sigmoid:1", "cross_entropy")
FIXED: Final = {
    "version": "v4",
    "num_class": "1",
    "num_tree_per_iteration": "1",
    "label_index": "0",
}
HEAD: Final = {
    *FIXED, "max_feature_idx", "objective", "feature_names", "feature_infos", "tree_sizes",
}  # fmt: skip
INNER: Final = (
    "split_feature", "split_gain", "threshold", "decision_type", "left_child", "right_child",
    "internal_value", "internal_weight", "internal_count",
)  # fmt: skip
LEAF: Final = ("leaf_value", "leaf_weight", "leaf_count")
TREE: Final = {"Tree", "num_leaves", "num_cat", "is_linear", "shrinkage", *INNER, *LEAF}

_NUMBER = r"-?[0-9]+(?:\.[0-9]*)?(?:e[+-]?[0-9]+)?"
_NUMBERS = re.compile(rf"(?:{_NUMBER}(?: {_NUMBER})*)?")
_WHOLE = re.compile(r"-?[0-9]{1,9}")
_RANGE = re.compile(rf"none|\[{_NUMBER}:{_NUMBER}\]")


def checked_trees(text: str, source: str) -> tuple[str, int]:
    """The text up to its last tree, and how many features the trees look at.

    Parameters
    ----------
    text : str
        As ``Booster.model_to_string`` gives it, or what this function returned.
    source : str
        Named in errors.

    Raises
    ------
    InputError
        If it is no such text, is cut off, or a tree refers to what is not there.
    """
    body, end, _ = text.partition(END)
    starts = [match.start() for match in re.finditer(r"^Tree=", body, flags=re.MULTILINE)]
    try:
        if not end or not starts:
            raise ValueError("cut off or empty")
        blocks = [body[a:b] for a, b in zip(starts, [*starts[1:], len(body)], strict=True)]
        features = _head(body[: starts[0]], [len(block) for block in blocks])
        for number, block in enumerate(blocks):
            _tree(block, number, features)
    except (ValueError, KeyError) as fault:
        raise InputError(f"{source}: no trees that LightGBM wrote ({fault})") from fault
    return body + END, features


def _fields(lines: list[str], expected: set[str]) -> dict[str, str]:
    pairs = [line.partition("=") for line in lines if line]
    fields = {key: value for key, _, value in pairs}
    if set(fields) != expected or len(fields) != len(pairs):
        odd = ", ".join(sorted(set(fields) ^ expected)) or "one more than once"
        raise ValueError(f"fields missing or unknown: {odd[:80]}")
    return fields


def _head(text: str, sizes: list[int]) -> int:
    first, *lines = text.split("\n")
    fields = _fields(lines, set(HEAD))
    count = _whole(fields["max_feature_idx"]) + 1
    right = (
        text.isascii()
        and first == "tree"
        and all(fields[key] == value for key, value in FIXED.items())
        and fields["objective"] in OBJECTIVES
        and count > 0
        and len(fields["feature_names"].split(" ")) == count
        and len(infos := fields["feature_infos"].split(" ")) == count
        and all(_RANGE.fullmatch(info) for info in infos)
        and fields["tree_sizes"] == " ".join(map(str, sizes))
    )
    if not right:
        raise ValueError("header")
    return count


def _tree(text: str, number: int, features: int) -> None:
    fields = _fields(text.split("\n"), TREE)
    leaves = _whole(fields["num_leaves"])
    split = [_whole(v) for v in fields["split_feature"].split()]
    kind = [_whole(v) for v in fields["decision_type"].split()]
    left = [_whole(v) for v in fields["left_child"].split()]
    right = [_whole(v) for v in fields["right_child"].split()]
    for key in (*INNER, *LEAF, "shrinkage"):
        if not _NUMBERS.fullmatch(fields[key]):
            raise ValueError(f"tree {number}, {key}: not numbers")
    single = leaves == 1
    for key in INNER:
        if len(fields[key].split()) != leaves - 1:
            raise ValueError(f"tree {number}, {key}: not {leaves - 1} values")
    for key in LEAF:
        # A tree of a single leaf comes without its weight.
        if len(fields[key].split()) not in ((0, 1) if single else (leaves,)):
            raise ValueError(f"tree {number}, {key}: not {leaves} values")
    # Every inner node but the first and every leaf is some earlier node's child, once.
    children = sorted(left + right)
    every = list(range(-leaves, 0)) + list(range(1, leaves - 1))
    sound = (
        fields["Tree"] == str(number)
        and leaves >= 1
        and fields["leaf_value"] != ""
        and fields["num_cat"] == fields["is_linear"] == "0"
        and all(0 <= feature < features for feature in split)
        and all(0 <= value <= 10 and value % 2 == 0 for value in kind)
        and (single or children == every)
        and all(child < 0 or child > k for side in (left, right) for k, child in enumerate(side))
    )
    if not sound:
        raise ValueError(f"tree {number}: refers to what is not there")


def _whole(text: str) -> int:
    if not _WHOLE.fullmatch(text):
        raise ValueError(f"{text[:20]!r} is no whole number")
    return int(text)
