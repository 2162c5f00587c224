"""Cached closed states from which closures of one valve begin if none is nearer.

Most of the time of a closure from the open valve goes into the way to first contact, which is much
the same for all moduli. So closed states and their derivatives are cached at the points of a
lattice in coordinates in which closed states change evenly: the logarithms of the parameters. Each
is made once, from the open valve, by the first process that needs it. The point at which a closure
begins follows from its parameters alone, so its result does not depend on what was closed before,
nor on whether the state was cached. The closed state is the one that would be found from the open
valve as long as there is only one, which the gate (:mod:`mvest.closure.robustness`) examines.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvest.cache import Entry
from mvest.errors import InputError
from mvest.mechanics.parameters import Parameter, is_positive
from mvest.mechanics.settings import MechanicsSettings
from mvest.reading.npz import read_npz
from mvest.typing import BoolArray, FloatArray

STIFFENED = 0.5
"""Factor on log(1 + stiffening): with five steps of 0.2 a tissue that hardly stiffens becomes one
that is nearly all exponential, and a leaflet moves by no more than with its modulus."""

SPACING = 0.4
"""Spacing of the lattice, in the logarithm of each parameter (of a coefficient of a field: times
its standard deviation of log E_f)."""

DIGITS = 32
"""Length of a file's name."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosedState:
    """A closed valve from which further closures may be continued.

    Attributes
    ----------
    at : (p,)
        Its parameters.
    positions : (n, 3) mm
        Of the mesh's nodes.
    guide : ClosedState or None
        That of the model's guide.
    slopes : (p, n, 3) mm or None
        Derivatives of the positions by the parameters, if they are known.
    """

    at: FloatArray
    positions: FloatArray
    guide: ClosedState | None = None
    slopes: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """Logarithms of positive parameters; coefficients of a field times its deviation of log E_f.

    A stiffening alpha counts as a share of log(1 + alpha): from no stiffening it is a short way.

    Attributes
    ----------
    units : (p,)
        Change of log E_f by a coefficient of a field; factor on a logarithm.
    offsets : (p,)
        Added to a parameter before its logarithm is taken; NaN if it has none.
    """

    units: FloatArray
    offsets: FloatArray

    @classmethod
    def of(cls, names: tuple[str, ...], settings: MechanicsSettings) -> Coordinates:
        """Those of the named parameters under the settings of a model."""
        units, offsets = [], []
        for name in names:
            parameter = Parameter(name, 0.0)
            stiffens, positive = parameter.kind == "stiffening", is_positive(name)
            field = 1.0 if positive else settings.fields[parameter.region].std_log
            units.append(STIFFENED if stiffens else field)
            offsets.append(np.nan if not positive else 1.0 if stiffens else 0.0)
        return cls(np.array(units), np.array(offsets))

    @property
    def _positive(self) -> BoolArray:
        return ~np.isnan(self.offsets)

    def __call__(self, m: FloatArray) -> FloatArray | None:
        """Coordinates ``(p,)`` of parameters ``(p,)``; None where one has no logarithm."""
        shifted = np.where(self._positive, m + self.offsets, 1.0)
        if np.any(shifted <= 0):
            return None
        return self.units * np.where(self._positive, np.log(shifted), m)

    def parameters(self, at: FloatArray) -> FloatArray:
        """Parameters ``(p,)`` with the coordinates ``at (p,)``."""
        own = at / self.units
        return np.where(
            self._positive, np.exp(np.where(self._positive, own, 0.0)) - self.offsets, own
        )

    def distance(self, start: FloatArray, end: FloatArray) -> float:
        """Largest change of a coordinate between two sets of parameters; infinite without one."""
        one, other = self(start), self(end)
        return np.inf if one is None or other is None else float(np.abs(other - one).max())

    def between(self, start: FloatArray, end: FloatArray, largest: float) -> list[FloatArray]:
        """Parameters on the way between two sets, no coordinate changing by more than a step."""
        one, other = self(start), self(end)
        if one is None or other is None:
            return []
        n = int(np.ceil(float(np.abs(other - one).max()) / largest))
        return [self.parameters(one + (other - one) * k / n) for k in range(1, n)]

    def expected_move(self, closed: ClosedState, m: FloatArray) -> FloatArray | None:
        """First-order move ``(n, 3)`` mm of a closed state to ``m``; None if it is not known."""
        start, end = self(closed.at), self(m)
        if closed.slopes is None or start is None or end is None:
            return None
        # Derivatives of the parameters by their coordinates.
        rates = np.where(self._positive, closed.at + self.offsets, 1.0) / self.units
        return np.tensordot(rates * (end - start), closed.slopes, 1)


def cached_state(
    folder: Path,
    key: str,
    point: FloatArray,
    at: FloatArray,
    make: Callable[[], ClosedState | None],
) -> ClosedState | None:
    """The closed state at a point of the lattice; None if the valve does not close there.

    Parameters
    ----------
    folder : Path
        Of the cache; several processes may share it.
    key : str
        Digest of all that decides the state but its parameters.
    point : (p,)
        Whole numbers, the coordinates over `SPACING`.
    at : (p,)
        Parameters at the point.
    make : callable
        Closes the valve. If several processes need the state, one makes it and the others wait.
    """
    name = f"{key} {','.join(f'{k:.0f}' for k in point)}"
    file = folder / f"closed-{hashlib.sha256(name.encode()).hexdigest()[:DIGITS]}.npz"

    def read(path: Path) -> ClosedState:
        positions, slopes = read_npz(path, ["positions", "slopes"]).values()
        return ClosedState(at, positions, slopes=slopes)

    def write(path: Path, made: ClosedState) -> None:
        assert made.slopes is not None
        np.savez(path, positions=made.positions, slopes=made.slopes)

    # A valve that does not close is cached without positions.
    none = ClosedState(at, np.zeros((0, 3)), slopes=np.zeros((0, 0, 3)))
    state = Entry(file, read).get_or_make(lambda: make() or none, write)
    return state if len(state.positions) else None


def content_digest(*values: Any) -> str:
    """SHA-256 of the content of arrays, dataclasses, mappings, sequences, numbers and texts.

    Raises
    ------
    InputError
        If something is none of these.
    """
    digest = hashlib.sha256()
    for value in values:
        _feed(digest, value)
    return digest.hexdigest()


def _feed(digest: hashlib._Hash, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype.str} {value.shape} ".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif is_dataclass(value) and not isinstance(value, type):
        digest.update(f"{type(value).__name__}(".encode())
        for each in fields(value):
            digest.update(f"{each.name}=".encode())
            _feed(digest, getattr(value, each.name))
        digest.update(b")")
    elif isinstance(value, Mapping):
        _feed(digest, sorted(value.items()))
    elif isinstance(value, tuple | list):
        digest.update(f"sequence {len(value)} ".encode())
        for item in value:
            _feed(digest, item)
    elif value is None or isinstance(value, str | bool | int | float | np.generic):
        plain = value.item() if isinstance(value, np.generic) else value
        digest.update(f"{plain!r};".encode())
    else:
        raise InputError(f"no digest of a {type(value).__name__}")
