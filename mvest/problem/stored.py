"""Disk caches shared by studies: simulations, cycles, virtual patients, samples.

The key of a cache entry combines its input values and the code that made it (:mod:`mvest.cache`).
"""

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
"""Length of a key."""


def key_of(described: Mapping[str, Any], *packages: str) -> str:
    """Key of plain input values and the code of `mvest`, and of ``packages``, that uses them.

    InputError if a value has no JSON form.
    """
    return config_hash({"made_from": described, "source": source_key(*packages)})[:DIGITS]


def entry_of(folder: Path, described: Mapping[str, Any], read: Callable[[Path], T]) -> Entry[T]:
    """The cache entry, an ``.npz`` file, of what `mvest` makes from ``described``.

    ``described`` holds plain values: everything that decides the content, except the code. ``read``
    reads a path or refuses it. The folder is created with the first entry.
    """
    return Entry(folder / f"{key_of(described)}.npz", read)


@dataclass(frozen=True, slots=True)
class StoredModel:
    """A model with a disk cache of its converged predictions, without derivatives."""

    model: ObservationModel
    folder: Path
    key: str  #: from :func:`key_of`; the parameters are added to it

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Prediction at ``m (p,)``; its Jacobian is zero if it was read from disk.

        InputError if the cache cannot be written.
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
    """Predictions extrapolated to zero mesh size, with an error of second order in the mesh size.

    Richardson 1911, Phil. Trans. R. Soc. A 210:307. Against `hex18` on 144 x 16 cells, which is
    within 1 % of its limit, closed valves of quadratic tetrahedra on 90 x 10 to 126 x 14 cells
    converge with the orders 1.8 (effect on the anterior modulus) and 2.4 (posterior).
    """

    fine: StoredModel
    coarse: StoredModel
    share: float  #: cell size of the fine mesh over that of the coarse one

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Prediction at ``m (p,)``, without derivatives."""
        fine, coarse = self.fine(m), self.coarse(m)
        if not (fine.converged and coarse.converged):
            return coarse if fine.converged else fine
        return Prediction(fine.y + self.correction(m), fine.jacobian)

    def correction(self, m: FloatArray) -> FloatArray:
        """Difference ``(n,)`` mm of the extrapolation from the fine mesh's prediction."""
        difference = self.fine(m).y - self.coarse(m).y
        return np.asarray(self.share**2 / (1 - self.share**2) * difference)
