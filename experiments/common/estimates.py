"""What records say of an estimate of p parameters; errors are signed parts of the truth."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.record import Status
from mvest.typing import FloatArray

__all__ = [
    "Confounded",
    "Data",
    "EstimatedModulus",
    "Identified",
    "Innovation",
    "Matrix",
    "Paper",
    "SeedRun",
    "Spread",
    "Vector",
    "matrix",
    "vector",
]

Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]


def vector(values: FloatArray) -> Vector:
    """Numbers ``(n,)`` as a record holds them."""
    return tuple(values.tolist())


def matrix(values: FloatArray) -> Matrix:
    """Rows ``(m, n)`` as a record holds them."""
    return tuple(map(tuple, values.tolist()))


@dataclass(frozen=True, slots=True)
class Data:
    """A recording, and the SHA-256 of its file."""

    citation: str | None
    sha256: str


@dataclass(frozen=True, slots=True)
class Paper:
    """What the paper reports for the same experiment; None where it says nothing.

    Attributes
    ----------
    table : str
    estimate : (p,) or None
        MPa.
    error_percent : (p,) or None
    moduli_error_percent, distance_mm : (2,) or None
        Mean and standard deviation, over all moduli and over all vertices.
    """

    table: str
    estimate: Vector | None = None
    error_percent: Vector | None = None
    moduli_error_percent: Vector | None = None
    distance_mm: Vector | None = None


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean, standard deviation and largest of some values."""

    mean: float
    std: float
    max: float


@dataclass(frozen=True, slots=True)
class EstimatedModulus:
    """One modulus of a leaflet, estimated or following from one that is, in MPa.

    Attributes
    ----------
    region, name : str
    estimate : float
    std, truth, relative_error : float or None
    """

    region: str
    name: str
    estimate: float
    std: float | None
    truth: float | None = None
    relative_error: float | None = None


@dataclass(frozen=True, slots=True)
class Innovation:
    """What of the observation the first prediction leaves over.

    Attributes
    ----------
    size : int
        Numbers of the observation.
    rms, max_abs : float
        In its unit.
    nis : float
        Normalised innovation squared.
    nis_band : (2,)
        Where 95 % of such values lie.
    """

    size: int
    rms: float
    max_abs: float
    nis: float
    nis_band: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Confounded:
    """Parameters that the data hardly tell apart, and a change of each that hardly shows.

    Attributes
    ----------
    parameters : tuple of str, (g,)
    changes, relative : (g,)
        In units of the parameters, and in parts of their scales.
    correlation : float
    """

    parameters: tuple[str, ...]
    changes: Vector
    relative: Vector
    correlation: float


@dataclass(frozen=True, slots=True)
class Identified:
    """What the data alone could tell at best.

    Attributes
    ----------
    cramer_rao_std : (p,)
        None where they determine a parameter not at all.
    condition_number : float or None
    flat : tuple of str
        Combinations that are known badly.
    confounded : tuple of Confounded
    """

    cramer_rao_std: tuple[float | None, ...]
    condition_number: float | None
    flat: tuple[str, ...]
    confounded: tuple[Confounded, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class SeedRun:
    """The estimate from the observation of one seed; None where a run did not get so far.

    Attributes
    ----------
    seed : int or None
        None where a job was lost that does not say which seeds it had.
    status : {"converged", "failed"}
    reason, detail : str
    estimate, std, relative_error : (p,) or None
    bound : (p,) or None
        Cramér-Rao standard deviations.
    distance_mm, distance_to_truth_mm : Spread or None
        Of the fitted vertices from the observed ones, and from the true ones.
    nis : float or None
        Normalised innovation squared.
    nis_band : (2,) or None
    iterations, forward_solves : int or None
    iterates, iterate_std : (i, p) or None
    seconds : float or None
    """

    seed: int | None
    status: Status
    reason: str
    detail: str = ""
    estimate: Vector | None = None
    std: Vector | None = None
    relative_error: Vector | None = None
    bound: tuple[float | None, ...] | None = None
    distance_mm: Spread | None = None
    distance_to_truth_mm: Spread | None = None
    nis: float | None = None
    nis_band: tuple[float, float] | None = None
    iterations: int | None = None
    forward_solves: int | None = None
    iterates: Matrix | None = None
    iterate_std: Matrix | None = None
    seconds: float | None = None

    @property
    def converged(self) -> bool:
        """Whether it has an estimate."""
        return self.status == "converged"
