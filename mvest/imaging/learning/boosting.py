"""Gradient-boosted trees (LightGBM) for several outputs, stored as plain text.

LightGBM grows the trees and writes them (``Booster.model_to_string``, "version=v4"). Its own reader
trusts the text: a text that is cut off makes it print foreign memory and abort the process. Here
the text becomes plain arrays, checked once, whose outputs are the same bit for bit.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeAlias

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from mvest.errors import InputError
from mvest.quantities import Count, Share
from mvest.reading.text import one_line
from mvest.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class BoostSettings:
    """How trees are grown."""

    trees: Count = 80
    leaves: Count = 24
    rate: Share = 0.12  #: learning rate
    min_leaf_samples: Count = 40
    share_features: Share = 0.25  #: share of the features drawn for every tree


SHARE_ROWS = 0.7
"""Share of the samples drawn for every tree."""

END: Final = "end of trees\n"
HEAD: Final = {"version": "v4", "num_class": "1", "num_tree_per_iteration": "1"}
"""Required entries of the head."""

OF_NODES: Final = ("split_feature", "threshold", "left_child", "right_child", "decision_type")
"""Fields with one value for each node of a tree."""

FIELDS: Final = {
    **dict.fromkeys((*OF_NODES, "num_leaves", "num_cat", "is_linear"), np.int64),
    **dict.fromkeys(("threshold", "leaf_value"), np.float64),
}
"""Fields of every tree, and their types."""

IS_PROBABILITY: Final = {"regression": False, "cross_entropy": True}
"""Objective -> whether outputs are the logistic function of the sums of trees."""


class _Trees(NamedTuple):
    """Trees of one output: T trees with N nodes and L leaves in all."""

    roots: IntArray  #: (T,), node at which each tree begins
    feature: IntArray  #: (N,)
    threshold: FloatArray  #: (N,)
    children: IntArray  #: (N, 2), for features up to the threshold and above; leaf k is -1 - k
    values: FloatArray  #: (L,)


class Boosters:
    """Trees for each of several outputs of the same features, from the texts of LightGBM.

    Raises InputError, which names the ``source``, if there is no text, one is malformed, or their
    numbers of features differ.
    """

    def __init__(self, texts: tuple[str, ...], source: str = "model") -> None:
        # Without the lines after the last tree, which describe the training.
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

    def __call__(self, x: NDArray[np.float32]) -> FloatArray:
        """Outputs ``(P, outputs)`` for features ``(P, F)``."""
        if x.shape[1] != self.features:
            raise InputError(
                f"{self._source}: the trees expect {self.features} features, found {x.shape[1]}; "
                "the model is of another version"
            )
        answers = np.empty((len(x), len(self.texts)))
        for k, (trees, is_probability) in enumerate(self._trees):
            total = _sums(x, trees)
            answers[:, k] = expit(total) if is_probability else total
        return answers


Trees: TypeAlias = Mapping[str, Boosters]
"""Those of each stage by its name."""


@nb.njit(cache=True)
def _sums(x: NDArray[np.float32], trees: _Trees) -> FloatArray:  # pragma: no cover (compiled)
    """Sum over the trees ``(P,)``, in their order."""
    roots, feature, threshold, children, values = trees
    total = np.zeros(len(x))
    for p in range(len(x)):
        for root in roots:
            at = root
            while at >= 0:
                at = children[at, 0 if x[p, feature[at]] <= threshold[at] else 1]
            total[p] += values[-1 - at]
    return total


def _read(text: str) -> tuple[int, bool, _Trees]:
    """Number of features, whether outputs are probabilities, and the trees in a text.

    ValueError or LookupError if something is missing, or a node leads to anything but later nodes
    and leaves of its tree.
    """
    whole, end, _ = text.partition(END)
    head, _, body = whole.partition("\nTree=")
    about = dict(line.split("=", 1) for line in head.split("\n")[1:] if line)
    if not end or {key: about[key] for key in HEAD} != HEAD:
        raise ValueError("cut off, or of another version")
    trees = len(about["tree_sizes"].split())
    lines = {key: re.findall(f"^{key}=(.*)$", body, re.MULTILINE) for key in FIELDS}
    if not trees or {body.count("\nTree=") + 1, *map(len, lines.values())} != {trees}:
        raise ValueError(f"not all of {trees} trees")
    sizes = {key: np.array([len(line.split()) for line in lines[key]]) for key in FIELDS}
    nodes, leaves = sizes["threshold"], sizes["leaf_value"]
    read: dict[str, NDArray[Any]] = {
        key: np.array(" ".join(lines[key]).split(), dtype=FIELDS[key]) for key in FIELDS
    }
    children = np.stack([read["left_child"], read["right_child"]], axis=1)
    features = len(about["feature_names"].split())
    # Numbers within each tree become numbers among the nodes and leaves of all.
    first_node, first_leaf = np.cumsum(nodes) - nodes, np.cumsum(leaves) - leaves
    tree = np.repeat(np.arange(trees), nodes)[:, None]
    own = np.arange(nodes.sum())[:, None] - first_node[tree]
    inner = children >= 0
    sound = (
        all((sizes[key] == nodes).all() for key in OF_NODES)
        and (leaves == nodes + 1).all()
        and np.array_equal(read["num_leaves"], leaves)
        and not (read["num_cat"].any() or read["is_linear"].any())
        and np.isin(read["decision_type"], (0, 2)).all()  # a comparison, and no missing feature
        and np.isin(read["split_feature"], np.arange(features)).all()
        and np.isfinite(read["threshold"]).all()
        and np.isfinite(read["leaf_value"]).all()
        and ((children > own) & (children < nodes[tree]))[inner].all()
        and (children >= -leaves[tree])[~inner].all()
    )
    if not sound:
        raise ValueError("a tree refers to what is not there")
    children = children + np.where(inner, first_node[tree], -first_leaf[tree])
    roots = np.where(nodes > 0, first_node, -1 - first_leaf)
    arrays = roots, read["split_feature"], read["threshold"], children, read["leaf_value"]
    return features, IS_PROBABILITY[about["objective"]], _Trees(*arrays)


def train_boosters(
    x: NDArray[np.float32],
    y: FloatArray,
    settings: BoostSettings,
    seed: int,
    objective: str = "regression",
) -> Boosters:
    """Grow trees for every column of ``y (P, outputs)``.

    The objective is ``regression`` (least squares), or ``cross_entropy`` (probability; labels from
    0 to 1).
    """
    import lightgbm  # takes a second, and only training needs it

    binned = {"max_bin": 63, "verbosity": -1}
    parameters = {
        "objective": objective,
        "num_leaves": settings.leaves,
        "learning_rate": settings.rate,
        "min_data_in_leaf": settings.min_leaf_samples,
        "feature_fraction": settings.share_features,
        "bagging_fraction": SHARE_ROWS,
        "bagging_freq": 1,
        "num_threads": 1,
        "deterministic": True,
        "force_row_wise": True,
        **binned,
    }
    data = lightgbm.Dataset(x, free_raw_data=False, params=binned)
    texts = []
    for k in range(y.shape[1]):
        data.set_label(np.ascontiguousarray(y[:, k]))
        own = parameters | {"seed": seed + k}
        texts.append(lightgbm.train(own, data, settings.trees).model_to_string())
    return Boosters(tuple(texts))
