r"""Ties: stiff springs between pairs of material points, such as an edge-to-edge clip makes.

A pair with its points at :math:`x_1, x_2` is held at the distance :math:`L` by the energy
:math:`\tfrac{k}{2} (|d| - L)^2` of :math:`d = x_1 - x_2`. With :math:`n = d/|d|`

.. math::
    f = k (|d| - L) n, \qquad
    \partial f / \partial d = k \, [n n^T + (1 - L/|d|) (I - n n^T)] .

The points stay free to turn about each other. With :math:`L = 0` the spring is linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import Embedding, SolidMesh, embed


@dataclass(frozen=True, slots=True, eq=False)
class TiedPoints:
    """Pairs of material points and how they are tied, whatever the mesh.

    Attributes
    ----------
    first, second : ndarray
        ``(k, 3)`` mm, in the reference frame.
    length : float
        mm, distance at which a pair is held once the valve is closed.
    stiffness : float
        N/mm of each pair.
    """

    first: FloatArray
    second: FloatArray
    length: float
    stiffness: float

    def __post_init__(self) -> None:
        if self.first.shape != self.second.shape or self.first.shape[1:] != (3,):
            raise InputError(
                f"tied points of shapes {self.first.shape} and {self.second.shape}, expected "
                "(k, 3) twice"
            )
        for name in ("length", "stiffness"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} of ties = {value}, expected a finite number > 0")

    def within(self, mesh: SolidMesh) -> Ties:
        """The same as springs between points of a mesh."""
        first, second = embed(mesh, self.first), embed(mesh, self.second)
        return Ties(first, second, self.stiffness, self.length)


def differences(first: Embedding, second: Embedding) -> Embedding:
    """The vectors ``(k, 3)`` from the points of ``second`` to those of ``first``.

    As sums over nodes like any embedding, except that the weights of a row sum to zero.

    Raises
    ------
    InputError
        If there are not as many points in both.
    """
    if len(first) != len(second):
        raise InputError(f"ties join {len(first)} points to {len(second)}, expected equally many")
    return Embedding(
        np.concatenate([first.nodes, second.nodes], axis=1),
        np.concatenate([first.weights, -second.weights], axis=1),
        np.full(len(first), -1, dtype=np.int64),
    )


class Ties:
    """Springs between pairs of material points.

    Parameters
    ----------
    first, second : Embedding
        ``(k,)`` points that are tied, pair by pair.
    stiffness : float
        N/mm of each pair.
    closed_length : float
        mm, length without force in the closed valve; at any instant it is part of the loads.
    """

    def __init__(
        self, first: Embedding, second: Embedding, stiffness: float, closed_length: float = 0.0
    ) -> None:
        self.spans = differences(first, second)
        self.stiffness = stiffness
        self.closed_length = closed_length

    def lengths(self, x: FloatArray) -> FloatArray:
        """Distances ``(k,)`` mm of the tied points at nodal positions ``x (n, 3)``."""
        return np.asarray(np.linalg.norm(self.spans(x), axis=1))

    def forces(self, x: FloatArray, length: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Internal force on the first point of each pair, and its derivative by the span.

        Parameters
        ----------
        x : ndarray
            ``(n, 3)`` mm.
        length : ndarray
            ``(k,)`` mm at which the springs are without force.

        Returns
        -------
        force : ndarray
            ``(k, 3)`` N; the second point gets the opposite.
        stiffness : ndarray
            ``(k, 3, 3)`` N/mm.
        """
        d = self.spans(x)
        span = np.maximum(np.linalg.norm(d, axis=1), 1e-12)
        n = d / span[:, None]
        dyad = n[:, :, None] * n[:, None, :]
        across = (1 - length / span)[:, None, None]
        return (
            (self.stiffness * (span - length))[:, None] * n,
            self.stiffness * (dyad + across * (np.eye(3) - dyad)),
        )
