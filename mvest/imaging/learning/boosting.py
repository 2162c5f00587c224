"""Gradient-boosted trees (LightGBM), several outputs side by side, kept as plain text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.imaging.learning.tree_text import checked_trees
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
