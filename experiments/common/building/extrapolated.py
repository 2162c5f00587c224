"""A truth without a mesh: closures on two meshes, carried on to cells of no size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.common.building.store import StoredModel
from mvest.estimation.prediction import Prediction
from mvest.kept import Counts
from mvest.typing import FloatArray

__all__ = ["Extrapolated"]


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

    @property
    def counts(self) -> Counts:
        """Of what was in the store."""
        return self.fine.counts

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
