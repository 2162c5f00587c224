"""What is estimated from what: data, their model, the filter, and what is known before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from mvest.errors import InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import NoiseCovariance
from mvest.estimation.prediction import ObservationModel
from mvest.estimation.run import Filter
from mvest.estimation.transform import Transform
from mvest.mechanics.settings import TissueSettings
from mvest.typing import FloatArray


class Observed(Protocol):
    """What an estimation needs of an observation, whatever its kind."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the observed frames, the closed one last."""
        ...

    @property
    def y(self) -> FloatArray:
        """The observation ``(k,)``."""
        ...

    @property
    def R(self) -> NoiseCovariance:
        """Covariance of ``y``."""
        ...

    def of(self, model: ObservationModel, /) -> ObservationModel:
        """What a model that predicts all frames, stacked, predicts of this observation.

        Its predictions have for ``aux`` the observed frames ``(f, n, 3)`` mm with all vertices.
        """
        ...

    def distance(self, fitted: FloatArray) -> FloatArray:
        """Distances (mm) of what was seen in the last frame to fitted ``(f, n, 3)``."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Everything an estimation needs besides the observation.

    Attributes
    ----------
    parameters : tuple of str, (p,)
        Names of the unknowns, for example ``E_f.anterior``.
    model : ObservationModel
        Predicts all frames, stacked.
    prior : Gaussian
        Of the parameters themselves.
    filter : Filter
    transform : Transform
    tissue : mapping
        Region -> the fixed ratios from which its other moduli follow.
    """

    parameters: tuple[str, ...]
    model: ObservationModel
    prior: Gaussian
    filter: Filter
    transform: Transform
    tissue: Mapping[str, TissueSettings]

    def __post_init__(self) -> None:
        if self.prior.size != len(self.parameters):
            raise InputError(
                f"the prior has {self.prior.size} parameters, the problem names "
                f"{len(self.parameters)}: {', '.join(self.parameters)}"
            )

    @property
    def start(self) -> FloatArray:
        """Parameters ``(p,)`` at which filters start: the prior's mean but for its last bit."""
        return self.transform.inverse(self.transform.forward(self.prior.mean))
