"""What an Abaqus input deck states of a mesh, its tissue and one step; a deck has no units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mvest.errors import InputError
from mvest.reading.text import one_line
from mvest.typing import FloatArray, IntArray
from mvest.valve.io.abaqus.keywords import Block

T = TypeVar("T")

SHELLS = {"S4": 4, "S4R": 4, "S4RS": 4, "S4RSW": 4, "S3": 3, "S3R": 3, "S3RS": 3}
TRUSSES = {"T3D2": 2, "CONN3D2": 2}


@dataclass(frozen=True, slots=True, eq=False)
class Amplitude:
    """A share that runs in time: constant outside, smooth steps or straight lines between points.

    Attributes
    ----------
    times, values : ndarray
        ``(n,)`` s, increasing, and the share there.
    smooth : bool
        Whether it is made of Abaqus' smooth steps, ``10 u^3 - 15 u^4 + 6 u^5`` between two points.
    """

    times: FloatArray
    values: FloatArray
    smooth: bool

    def __call__(self, t: FloatArray) -> FloatArray:
        """Share at times ``(k,)`` s."""
        if not self.smooth:
            return np.interp(t, self.times, self.values)
        i = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2)
        u = np.clip((t - self.times[i]) / (self.times[i + 1] - self.times[i]), 0.0, 1.0)
        rise = u**3 * (10 - 15 * u + 6 * u**2)
        return self.values[i] + rise * (self.values[i + 1] - self.values[i])


@dataclass(frozen=True, slots=True, eq=False)
class Elements:
    """Elements of one type.

    Attributes
    ----------
    kind : str
        As the deck has it, ``S4R`` say.
    first : int
        Number of the first of them in the deck.
    nodes : ndarray
        ``(m, k)`` numbers of nodes.
    """

    kind: str
    first: int
    nodes: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class ElementSection:
    """What elements are made of.

    Attributes
    ----------
    elements : ndarray
        Their numbers.
    material : str
    size : float or None
        Thickness of a shell (mm), cross section of a truss (mm^2); None where it says none.
    """

    elements: IntArray
    material: str
    size: float | None


@dataclass(frozen=True, slots=True, eq=False)
class FaceLoad:
    """Pressure on elements.

    Attributes
    ----------
    elements : ndarray
        Their numbers.
    value : float
        At a share of 1; positive where it pushes against the elements' normals.
    amplitude : str
        Name; empty where there is none.
    """

    elements: IntArray
    value: float
    amplitude: str


@dataclass(frozen=True, slots=True, eq=False)
class Deck:
    """What a deck states; nodes and elements of all instances count from 0 in its order.

    Attributes
    ----------
    nodes : ndarray
        ``(n, 3)``.
    elements : tuple of Elements
    node_sets, element_sets : mapping
        ``INSTANCE.SET`` or ``SET``, in capitals -> numbers, increasing.
    sections : tuple of ElementSection
    materials : mapping
        Name -> its elastic and hyperelastic blocks by keyword.
    amplitudes : mapping
    displacement : ndarray
        ``(n, 3)`` prescribed at a share of 1; NaN where a coordinate is free.
    paced_by : ndarray
        ``(n, 3)`` number of the amplitude in ``pace_names``.
    pace_names : tuple of str
    pressures : tuple of FaceLoad
    period : float
        s, of the step.
    """

    nodes: FloatArray
    elements: tuple[Elements, ...]
    node_sets: Mapping[str, IntArray]
    element_sets: Mapping[str, IntArray]
    sections: tuple[ElementSection, ...]
    materials: Mapping[str, Mapping[str, Block]]
    amplitudes: Mapping[str, Amplitude]
    displacement: FloatArray
    paced_by: IntArray
    pace_names: tuple[str, ...]
    pressures: tuple[FaceLoad, ...]
    period: float

    def node_set(self, name: str) -> IntArray:
        """Numbers of the nodes of a set, whose instance may be left out where one alone has it.

        Raises
        ------
        InputError
            If there is no such set, or several.
        """
        return lookup(self.node_sets, name, "node set")

    def element_set(self, name: str) -> IntArray:
        """Numbers of the elements of a set; as `node_set`."""
        return lookup(self.element_sets, name, "element set")

    def share(self, amplitude: str, times: FloatArray) -> FloatArray:
        """Share of a prescribed quantity at times ``(k,)`` s.

        Raises
        ------
        InputError
            If there is no such amplitude.
        """
        if amplitude not in self.amplitudes:
            name = f"amplitude {amplitude!r}" if amplitude else "a quantity without an amplitude"
            raise InputError(f"{one_line(name, 60)}, expected one of {some(self.amplitudes)}")
        return self.amplitudes[amplitude](times)

    def moved(self, nodes: IntArray, times: FloatArray) -> FloatArray:
        """Displacement ``(k, n, 3)`` of constrained nodes at times ``(k,)`` s.

        Raises
        ------
        InputError
            If a node is free, or moves without an amplitude.
        """
        end = self.displacement[nodes]
        if np.isnan(end).any():
            free = int(nodes[np.isnan(end).any(axis=1)][0])
            raise InputError(f"node {free + 1} of the mesh is free, expected it prescribed")
        result = np.zeros((len(times), len(nodes), 3))
        for k in np.unique(self.paced_by[nodes][end != 0]):
            share = self.share(self.pace_names[k], times)
            here = np.where(self.paced_by[nodes] == k, end, 0.0)
            result += share[:, None, None] * here
        return result


def lookup(sets: Mapping[str, T], name: str, what: str) -> T:
    """What has a name, whose instance may be left out where one alone has it.

    Raises
    ------
    InputError
        If nothing has it, or several have.
    """
    wanted = name.upper()
    found = [key for key in sets if key == wanted or key.endswith(f".{wanted}")]
    if wanted not in found and len(found) != 1:
        raise InputError(
            f"{len(found) or 'no'} {what}s {one_line(name, 60)!r}; there are {some(sets)}"
        )
    return sets[wanted if wanted in found else found[0]]


def some(names: Iterable[str]) -> str:
    """Names for a message, shortened where they are many."""
    return one_line(", ".join(names), 160) or "none"
