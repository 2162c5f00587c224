"""What studies make on their way and share: simulations, cycles, virtual patients, samples.

All of it is kept by one rule. An entry is named by what it was made from and by the code that made
it (:mod:`mvest.cache`), is made once, and appears whole or not at all.
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


class Store:
    """Entries in a folder.

    Parameters
    ----------
    folder : Path
        Made when something is cached.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)

    def entry(
        self,
        kind: str,
        described: Mapping[str, Any],
        made_by: tuple[Any, ...],
        read: Callable[[Path], T],
        name: str = "{key}.npz",
    ) -> Entry[T]:
        """The entry of what is made from ``described`` by ``made_by``.

        Parameters
        ----------
        kind : str
            Folder within the store's.
        described : mapping
            Plain values: all that decides what is made, but the code.
        made_by : tuple
            Modules, functions or classes that make it and write it; what they import counts too.
        read : callable
            Reads a path, or refuses it.
        name : str
            Of the file or folder, with ``{key}``.
        """
        path = self.folder / kind / name.format(key=key_of(described, made_by))
        return Entry(path, read)

    def model(
        self,
        kind: str,
        model: ObservationModel,
        described: Mapping[str, Any],
        made_by: tuple[Any, ...],
    ) -> StoredModel:
        """A model whose predictions are entries: see `entry` and :class:`StoredModel`."""
        return StoredModel(model, self.folder / kind, key_of(described, made_by))


@dataclass(frozen=True, slots=True)
class StoredModel:
    """A model whose converged predictions are kept on disk, without their derivatives.

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
            If the store cannot be written.
        """

        def read(path: Path) -> Prediction:
            y = read_npz(path, ["y"])["y"]
            return Prediction(y, np.zeros((len(y), len(m))))

        about = {"key": self.key, "m": [float(v).hex() for v in m]}
        path = self.folder / f"{config_hash(about)[:DIGITS]}.npz"
        return Entry(path, read).get_or_make(
            lambda: predict(self.model, m),
            lambda file, prediction: np.savez(file, y=prediction.y),
            lambda made: made.converged,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Extrapolated:
    """Predictions that are linear in the size of the cells, at cells of no size.

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
