"""Gradient-boosted trees (LightGBM), several outputs side by side, kept as plain text.

LightGBM grows trees and writes them (``Booster.model_to_string``, "version=v4"). It does not read
them again, because it trusts the text: a child or a feature that does not exist is read from memory
that is not the trees' own, and a number that is none ends the process. Trees are plain arrays here,
checked once, and their answers are the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeAlias

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from mvest.errors import InputError
from mvest.quantities import Count, Processes, Share
from mvest.reading.text import one_line
from mvest.typing import FloatArray, IntArray


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


END: Final = "end of trees\n"
WRITTEN: Final = {"version": "v4", "num_class": "1", "num_tree_per_iteration": "1"}
"""What the head of every text says."""

IS_PROBABILITY: Final = {"regression": False, "cross_entropy": True}
"""Whether answers are the logistic function of the sums of trees, by the objective."""


class _Trees(NamedTuple):
    """Trees of one output.

    Attributes
    ----------
    roots : (T,)
        Node at which each tree begins.
    feature, threshold : (N,)
        Of each node.
    children : (N, 2)
        Where it goes on if the feature is at most the threshold, and where otherwise: to a node, or
        to leaf k if the number is -1 - k.
    values : (L,)
        Of all leaves.
    """

    roots: IntArray
    feature: IntArray
    threshold: FloatArray
    children: IntArray
    values: FloatArray


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
        # Up to the last tree: what follows tells of the training.
        self.texts, self._source = tuple(text.partition(END)[0] + END for text in texts), source
        try:
            read = [_read(text) for text in texts]
        except (ValueError, LookupError, OverflowError) as fault:
            reason = one_line(fault, 80)
            raise InputError(f"{source}: no trees that LightGBM wrote ({reason})") from fault
        counts = {features for features, _, _ in read}
        if len(counts) != 1:
            raise InputError(f"{source}: trees of {sorted(counts)} features, expected one number")
        self.features = counts.pop()
        self._trees = [(trees, is_probability) for _, is_probability, trees in read]

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
        answers = np.empty((len(x), self.outputs))
        for k, (trees, is_probability) in enumerate(self._trees):
            total = _sums(x, *trees)
            answers[:, k] = expit(total) if is_probability else total
        return answers


Trees: TypeAlias = Mapping[str, Boosters]
"""Those of each stage by its name."""


@nb.njit(cache=True)
def _sums(
    x: NDArray[np.float32],
    roots: IntArray,
    feature: IntArray,
    threshold: FloatArray,
    children: IntArray,
    values: FloatArray,
) -> FloatArray:  # pragma: no cover (compiled)
    """Sum over the trees ``(P,)``, in their order."""
    total = np.zeros(len(x))
    for p in range(len(x)):
        for root in roots:
            at = root
            while at >= 0:
                at = children[at, 0 if x[p, feature[at]] <= threshold[at] else 1]
            total[p] += values[-1 - at]
    return total


def _read(text: str) -> tuple[int, bool, _Trees]:
    """Number of features, whether outputs are probabilities, and the trees in a text."""
    body, end, _ = text.partition(END)
    head, *blocks = body.split("\nTree=")
    about = dict(line.split("=", 1) for line in head.split("\n")[1:] if line)
    if not end or {key: about[key] for key in WRITTEN} != WRITTEN:
        raise ValueError("cut off, or of another version")
    if not blocks or len(about["tree_sizes"].split()) != len(blocks):
        raise ValueError(f"{len(blocks)} trees, which are not all")
    features = len(about["feature_names"].split())
    trees, nodes, leaves = [], 0, 0
    for number, block in enumerate(blocks):
        tree = _tree(block, number, features)
        inner = tree.children >= 0
        children = np.where(inner, tree.children + nodes, tree.children - leaves)
        root = tree.roots + (nodes if len(children) else -leaves)
        trees.append(tree._replace(roots=root, children=children))
        nodes, leaves = nodes + len(children), leaves + len(tree.values)
    joined = (np.concatenate(parts) for parts in zip(*trees, strict=True))
    return features, IS_PROBABILITY[about["objective"]], _Trees(*joined)


def _tree(block: str, number: int, features: int) -> _Trees:
    """One tree by itself, whose nodes lead to later ones and to leaves only."""
    fields = dict(line.split("=", 1) for line in block.split("\n")[1:] if line)
    feature, left, right, kind = (
        np.array(fields[key].split(), dtype=np.int64)
        for key in ("split_feature", "left_child", "right_child", "decision_type")
    )
    threshold, values = (
        np.array(fields[key].split(), dtype=np.float64) for key in ("threshold", "leaf_value")
    )
    count = len(threshold)
    sound = (
        {len(feature), len(left), len(right), len(kind), len(values) - 1} == {count}
        and fields["num_leaves"] == str(len(values))
        and fields["num_cat"] == fields["is_linear"] == "0"
        and np.isin(kind, (0, 2)).all()  # a comparison, where no feature is missing
        and np.isin(feature, np.arange(features)).all()
        and np.isfinite(threshold).all()
        and np.isfinite(values).all()
    )
    if not sound:
        raise ValueError(f"tree {number}: refers to what is not there")
    children = np.stack([left, right], axis=1)
    later = (children > np.arange(count)[:, None]) & (children < count)
    if not (later | ((children < 0) & (children >= -len(values)))).all():
        raise ValueError(f"tree {number}: refers to what is not there")
    return _Trees(np.array([0 if count else -1]), feature, threshold, children, values)


def train_boosters(
    x: NDArray[np.float32],
    y: FloatArray,
    settings: BoostSettings,
    seed: int,
    objective: str = "regression",
) -> Boosters:
    """Grow trees for every column of ``y (P, outputs)``.

    Parameters
    ----------
    objective : str
        ``regression`` (least squares), or ``cross_entropy`` (probability; labels from 0 to 1).
    """
    import lightgbm  # here, as it takes a second that what only uses trees need not wait

    data = lightgbm.Dataset(
        x,
        label=np.ascontiguousarray(y[:, 0]),
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
