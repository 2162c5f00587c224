"""Caches of what studies share: simulations, cycles, virtual patients, samples.

A cache entry is named by the values that it was made from and by the code that made it
(:mod:`mvest.cache`), is made once, and appears whole or not at all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mvest.cache import Entry, source_key
from mvest.estimation.prediction import ObservationModel, Prediction, predict
from mvest.provenance import config_hash
from mvest.reading.npz import read_npz
from mvest.typing import FloatArray

T = TypeVar("T")

DIGITS = 32
"""Of a key."""


def key_of(described: Mapping[str, Any], made_by: tuple[Any, ...]) -> str:
    """Key of what is made from plain values by modules, functions or classes.

    Raises
    ------
    InputError
        If a value has no JSON form, or something is of another package.
    """
    return config_hash({"made_from": described, "source": source_key(*made_by)})[:DIGITS]


def entry_of(
    folder: Path,
    described: Mapping[str, Any],
    made_by: tuple[Any, ...],
    read: Callable[[Path], T],
    name: str = "{key}.npz",
) -> Entry[T]:
    """The cache entry of what is made from ``described`` by ``made_by``.

    Parameters
    ----------
    folder : Path
        Made when something is cached.
    described : mapping
        Plain values: all that decides what is made, but the code.
    made_by : tuple
        Modules, functions or classes that make it and write it; what they import counts too.
    read : callable
        Reads a path, or refuses it.
    name : str
        Of the file or folder, with ``{key}``.
    """
    return Entry(folder / name.format(key=key_of(described, made_by)), read)


@dataclass(frozen=True, slots=True)
class StoredModel:
    """A model whose converged predictions are cached on disk, without their derivatives.

    Attributes
    ----------
    model : ObservationModel
    folder : Path
    key : str
        See :func:`key_of`; the parameters are added to it.
    """

    model: ObservationModel
    folder: Path
    key: str

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Prediction at ``m (p,)``, read from disk if it is there; its Jacobian is then zero.

        Raises
        ------
        InputError
            If the cache cannot be written.
        """

        def read(path: Path) -> Prediction:
            y = read_npz(path, ["y"])["y"]
            return Prediction(y, np.zeros((len(y), len(m))))

        about = {"key": self.key, "m": [float(v).hex() for v in m]}
        return Entry(self.folder / f"{config_hash(about)[:DIGITS]}.npz", read).get_or_make(
            lambda: predict(self.model, m),
            lambda file, prediction: np.savez(file, y=prediction.y),
            lambda made: made.converged,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Extrapolated:
    """Predictions that are linear in the mesh size, extrapolated to zero mesh size.

    Closed valves of quadratic tetrahedra have nearly this order (Richardson 1911, Phil. Trans. R.
    Soc. A 210:307, with order one): leaflets bend sharply where they touch, and chordae and annulus
    pull at lines.

    Attributes
    ----------
    fine, coarse : StoredModel
    share : float
        Size of the finer mesh's cells over that of the coarser one's.
    """

    fine: StoredModel
    coarse: StoredModel
    share: float

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Prediction at ``m (p,)``, without derivatives."""
        fine, coarse = self.fine(m), self.coarse(m)
        if not (fine.converged and coarse.converged):
            return coarse if fine.converged else fine
        return Prediction(fine.y + self._correction(fine, coarse), fine.jacobian)

    def correction(self, m: FloatArray) -> FloatArray:
        """What the extrapolation adds to the finer mesh's prediction, ``(n,)`` mm."""
        return self._correction(self.fine(m), self.coarse(m))

    def _correction(self, fine: Prediction, coarse: Prediction) -> FloatArray:
        return np.asarray(self.share / (1 - self.share) * (fine.y - coarse.y))
