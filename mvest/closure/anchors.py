"""Closed states that are kept: where closures of one valve begin that have none nearer.

They lie on a lattice in coordinates in which closed states change evenly with the parameters:
their logarithms.

Most of a closure from the open valve is the way to its first contact, and it is much the same for
all moduli. So the closed state, with its derivatives, is kept at the points of a lattice of the
parameters' logarithms, made once by whoever comes first, from the open valve. Which point a closure
begins at follows from its own parameters and from nothing else: what it gives does not depend on
what was closed before, by itself or by others, nor on whether the state was there or had to be
made. The closed state is the one that would have been found from the open valve, as far as there is
one only, which the gate (:mod:`mvest.closure.robustness`) examines.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvest.cache import Entry, prune
from mvest.errors import InputError
from mvest.mechanics.parameters import Parameter, is_positive
from mvest.mechanics.settings import MechanicsSettings
from mvest.reading.npz import read_npz
from mvest.typing import BoolArray, FloatArray

STIFFENED = 0.5
"""What log(1 + stiffening) is multiplied by: with five steps of 0.2 a tissue that hardly stiffens
becomes one that is nearly all exponential, and a leaflet moves by no more than with its modulus."""


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """Logarithms of positive parameters; a field's coefficients times its deviation of log E_f.

    Of a stiffening alpha it is a share of log(1 + alpha): from none at all it is a short way.

    Attributes
    ----------
    units : (p,)
        What a coefficient of a field changes log E_f by, what a logarithm is multiplied by.
    offsets : (p,)
        What is added to a parameter before its logarithm is taken; NaN where it is not.
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

    def change(self, start: FloatArray, end: FloatArray) -> FloatArray | None:
        """Difference ``(p,)`` of the coordinates of two sets of parameters; None as above."""
        one, other = self(start), self(end)
        return None if one is None or other is None else other - one

    def rates(self, m: FloatArray) -> FloatArray:
        """Derivative ``(p,)`` of each parameter by its coordinate."""
        return np.where(self._positive, m + self.offsets, 1.0) / self.units


DIGITS = 32
"""Of a name."""


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """A closed state; without positions one that was not found.

    Attributes
    ----------
    positions : (n, 3) mm
        Of the mesh's nodes.
    slopes : (p, n, 3) mm
        Derivatives by the parameters.
    """

    positions: FloatArray
    slopes: FloatArray


NOT_FOUND = Kept(np.zeros((0, 3)), np.zeros((0, 0, 3)))
"""What is kept of a valve that does not close."""


@dataclass(frozen=True, slots=True)
class Anchors:
    """A folder of closed states, and the lattice of their parameters.

    Attributes
    ----------
    folder : Path
        Made when something is kept. Several processes may share it.
    spacing : float
        Of the lattice, in the logarithm of each parameter (of a field's coefficient: times its
        standard deviation of log E_f).
    largest_mb : float
        Size of the folder, 10^6 bytes, beyond which the states that were not used for longest are
        removed. One takes 0.2 MB on the default mesh with two parameters.
    """

    folder: Path
    spacing: float = 0.4
    largest_mb: float = 1000.0

    def __post_init__(self) -> None:
        if not self.spacing > 0:
            raise InputError(f"spacing of the anchors = {self.spacing}, expected > 0")
        if not self.largest_mb > 0:
            raise InputError(f"largest_mb of the anchors = {self.largest_mb}, expected > 0")

    def get_or_make(self, key: str, place: FloatArray, make: Callable[[], Kept]) -> Kept:
        """The state that is kept at a point of the lattice, or is made and kept now.

        Parameters
        ----------
        key : str
            Of all that decides the state but its parameters, by :func:`content_digest`, and of the
            code, by :func:`mvest.cache.source_key`.
        place : (p,)
            Whole numbers, the point over the spacing.
        make : callable
            Of several processes that need the state, one makes it and the others wait.
        """
        at = ",".join(f"{k:.0f}" for k in place)
        about = f"{key} {self.spacing!r} {at}"
        name = hashlib.sha256(about.encode()).hexdigest()[:DIGITS]
        entry = Entry(self.folder / f"closed-{name}.npz", _read)
        kept = entry.get_or_make(make, _write)
        if entry.counts.misses:
            prune(self.folder, "closed-*.npz", self.largest_mb)
        return kept


def content_digest(*values: Any) -> str:
    """SHA-256 of what values say: arrays, dataclasses, mappings, sequences, numbers and texts.

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


def _write(path: Path, kept: Kept) -> None:
    np.savez(path, positions=kept.positions, slopes=kept.slopes)


def _read(path: Path) -> Kept:
    positions, slopes = read_npz(path, ["positions", "slopes"]).values()
    return Kept(positions, slopes)
