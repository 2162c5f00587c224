"""The solid: strains, internal forces and tangents of all elements of a mesh.

One formulation serves all element shapes: tables come from :mod:`mvest.elements` and stresses from
a law. Kernels take and return element arrays (element axis first);
:mod:`mvest.mechanics.assembly` adds them up.

Kinematics. Shape-function gradients are stored in the fibre frame Q of each quadrature point,
``g_a = Q^T dN_a/dX``, so that ``F Q = sum_a x_a g_a^T`` and the Green-Lagrange strain is in the
fibre frame of the law.

Enhanced strains. Solid-shells add ``E = E(u) + M alpha`` with ``M = d p^T``: the strain
``d = (det J0 / det J) (G^3 x G^3)`` (G^3 the contravariant thickness vector at the centre) times
the element's polynomials p. The parameters alpha of an element solve ``int M^T S dV = 0``. They are
eliminated inside the element by Newton's method at every evaluation, so that its energy depends on
nodal positions only (the condensed tangent is the Schur complement). A step of this method keeps a
quarter of det C at every point. Without this bound, an element stretched to l > 1.5 across its
thickness would overshoot to a negative C33 = l^2 (3 - 2 l), which no step leads back from (the
uniaxial Biot law). The modes integrate to zero against constant stress: the patch test holds. With
the corotational law the strain is the linear one in a frame that rotates with the element and
replaces F.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mvest._compiling import announce_compilation
from mvest.elements import Element
from mvest.errors import InputError
from mvest.mechanics.element import (
    add_tangents,
    alpha_change,
    enhanced_strain,
    internal_forces,
    strain_derivative,
    strains,
    volume_change,
)
from mvest.mechanics.law import Law, Points
from mvest.mechanics.law.biot import BiotLaw
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh

announce_compilation()

PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""Tensor entries of the components of a six-vector."""
ENHANCED_ITERATIONS = 20
ENHANCED_TOLERANCE = 1e-11
"""Size of the last alpha correction (strain) at which the elimination stops."""
LARGEST_LOSS = 0.75
"""Largest share of det C that a point may lose in one step of the elimination."""
THINNEST = 1e-2
"""Smallest det C, over that without enhanced strain, at which an elimination may start."""
LINEAR = 1e-7
"""Alpha corrections below this size change the stress linearly and the tangent negligibly."""


@dataclass(slots=True, eq=False)
class SolidState:
    """State of the solid at given nodal positions."""

    green: FloatArray  #: (e, q, 6), Green-Lagrange strain, enhanced part included
    #: (e, q, 6) and (e, q, 6, 6) MPa
    stress: FloatArray
    tangent: FloatArray
    alpha: FloatArray  #: (e, n_modes), enhanced parameters
    deformation: FloatArray  #: (e, q, 3, 3), F in the fibre frame


class Solid:
    """A mesh with its law, ready to be evaluated.

    Parameters
    ----------
    mesh : SolidMesh
    law : Law
        With one entry per region of the mesh.
    density : float
        t/mm^3.
    enhanced : bool
        Whether solid-shells have their enhanced thickness strain.

    Attributes
    ----------
    enhanced_parameters : ndarray
        ``(e, n_modes)`` alpha from which the next evaluation starts.
    """

    def __init__(
        self, mesh: SolidMesh, law: Law, *, density: float = 1.04e-9, enhanced: bool = True
    ) -> None:
        if not density > 0:
            raise InputError(f"density {density} t/mm^3, expected > 0")
        self.mesh = mesh
        self.law = law
        reference = mesh.reference
        self.n_nodes = len(mesh.nodes)
        self.gradients, self.volumes = _fibre_gradients(mesh, reference)
        self.direction = _enhanced_direction(mesh, reference)
        polynomials = reference.enhanced(reference.points)
        self.polynomials = np.ascontiguousarray(polynomials if enhanced else polynomials[:, :0])
        self.n_modes = self.polynomials.shape[1]
        self.rotations = None
        if isinstance(law, BiotLaw) and law.corotational:
            at_rest = strains(mesh.nodes, mesh.elements, self.gradients)[1]
            self.rotations = EdgeRotations(mesh, at_rest)
        self.lumped_mass = density * _lumped_volume(mesh, reference, self.volumes)
        self.reset()

    def reset(self) -> None:
        """Set the enhanced parameters to zero."""
        self.enhanced_parameters = np.zeros((len(self.mesh.elements), self.n_modes))

    def initial_strain(self) -> FloatArray:
        """Strain measure of the reference state ``(e, q, 6)``: zero without prestretch."""
        return self.law.strain(np.zeros((*self.volumes.shape, 6)))

    def evaluate(self, x: FloatArray, previous: FloatArray, rate: float) -> SolidState:
        """Strain, stress and tangent at nodal positions ``x (n, 3)`` mm."""
        elements, region = self.mesh.elements, self.mesh.region
        green_u, f = strains(x, elements, self.gradients)
        if self.rotations is not None:
            green_u, f = self.rotations(x, f)
        if self.n_modes == 0:
            stress, tangent = self.law.response(Points(green_u, region, previous, rate))
            return SolidState(green_u, stress, tangent, self.enhanced_parameters, f)
        volume = volume_change(green_u, self.direction)
        alpha = self.enhanced_parameters
        # What another state has left may be inadmissible here; zero always is admissible.
        thin = self._share(alpha, volume).min(axis=1, keepdims=True) < THINNEST
        alpha = np.where(thin, 0.0, alpha)
        for _ in range(ENHANCED_ITERATIONS):
            green = enhanced_strain(green_u, self.direction, self.polynomials, alpha)
            stress, tangent = self.law.response(Points(green, region, previous, rate))
            step = self._alpha_change(stress, tangent)
            size = float(np.abs(step).max(initial=0.0))
            if not np.isfinite(size) or size < ENHANCED_TOLERANCE:
                break
            left = self._share(alpha, volume)
            loss = (1.0 - self._share(alpha + step, volume) / left).max(axis=1, keepdims=True)
            alpha = alpha + LARGEST_LOSS / np.maximum(loss, LARGEST_LOSS) * step
            if size < LINEAR:
                more = enhanced_strain(np.zeros_like(green), self.direction, self.polynomials, step)
                green += more
                stress += np.einsum("eqij,eqj->eqi", tangent, more)
                break
        else:
            # No equilibrium within some element: the line search rejects such positions.
            stress = np.full_like(stress, np.nan)
        if np.isfinite(alpha).all():
            self.enhanced_parameters = alpha
        return SolidState(green, stress, tangent, alpha, f)

    def _share(self, alpha: FloatArray, volume: FloatArray) -> FloatArray:
        """The det C ``(e, q)`` over that without enhanced strain, from `volume_change`."""
        return 1.0 + alpha @ self.polynomials.T * volume

    def forces(self, state: SolidState) -> FloatArray:
        """Internal forces ``(e, k, 3)`` N."""
        return self._forces(state, state.stress)

    def add_tangents(
        self, state: SolidState, positions: NDArray[np.int32], blocks: FloatArray
    ) -> None:
        """Add the condensed consistent tangents, N/mm, to block data ``(n_blocks, 3, 3)``.

        ``positions (e, k, k)`` are those of the pairs of nodes, negative in the lower triangle.
        """
        # The corotational tangent is taken at fixed rotations: it has no geometric part.
        turned = self.rotations is not None
        add_tangents(
            self.gradients,
            self.volumes,
            state.deformation,
            np.zeros_like(state.stress) if turned else state.stress,
            state.tangent,
            self.direction,
            self.polynomials,
            positions,
            blocks,
        )

    def _forces(self, state: SolidState, stress: FloatArray) -> FloatArray:
        return internal_forces(self.gradients, self.volumes, state.deformation, stress)

    def extrapolated(self, state: SolidState, dx: FloatArray) -> SolidState:
        """The state with strain and stress changed to first order by a move ``dx (n, 3)`` mm."""
        change = self.green_change(state, dx, np.zeros_like(state.stress))
        stress = state.stress + np.einsum("eqij,eqj->eqi", state.tangent, change)
        return replace(state, green=state.green + change, stress=stress)

    def condensed_forces(self, state: SolidState, d_stress: FloatArray) -> FloatArray:
        """Nodal forces ``(e, k, 3)`` of a change of stress ``(e, q, 6)`` at fixed strain.

        The enhanced strains are re-equilibrated.
        """
        if self.n_modes:
            change = self._enhanced_change(state, d_stress)
            d_stress = d_stress + np.einsum("eqij,eqj->eqi", state.tangent, change)
        return self._forces(state, d_stress)

    def green_change(self, state: SolidState, dx: FloatArray, d_stress: FloatArray) -> FloatArray:
        """Change ``(e, q, 6)`` of the Green-Lagrange strain by a move ``dx (n, 3)`` of the nodes.

        ``d_stress (e, q, 6)`` is a simultaneous change of the stress at fixed strain.
        """
        d_green = strain_derivative(dx, self.mesh.elements, self.gradients, state.deformation)
        if self.n_modes:
            total = d_stress + np.einsum("eqij,eqj->eqi", state.tangent, d_green)
            d_green = d_green + self._enhanced_change(state, total)
        return d_green

    def _enhanced_change(self, state: SolidState, d_stress: FloatArray) -> FloatArray:
        """Change of the enhanced strain ``(e, q, 6)`` that balances a change of the stress."""
        change = self._alpha_change(d_stress, state.tangent)
        return enhanced_strain(np.zeros_like(d_stress), self.direction, self.polynomials, change)

    def _alpha_change(self, stress: FloatArray, tangent: FloatArray) -> FloatArray:
        """Step ``(e, n_modes)`` of Newton's method for ``int M^T S dV = 0``."""
        return alpha_change(self.direction, self.polynomials, self.volumes, stress, tangent)


class EdgeRotations:
    """Frames of linear tetrahedra that rotate with their edges.

    With the edges from the first node, :math:`A = (x_1 - x_0, x_2 - x_0, x_3 - x_0)`, the rotation
    is the polar factor of A at x times the inverse of that at rest. This is the "polar" form of
    SOFA's tetrahedra, not the polar factor of the deformation gradient.

    InputError if the elements are not linear tetrahedra.

    ``frames``: ``(e, 1, 3, 3)`` fibre frames, columns as in :mod:`mvest.mechanics.solid`.
    """

    def __init__(self, mesh: SolidMesh, frames: FloatArray) -> None:
        if mesh.element_type != "tet4":
            raise InputError(
                f"the corotational law is that of linear tetrahedra (tet4), not {mesh.element_type}"
            )
        self._elements = mesh.elements
        self._start = _polar(self._edges(mesh.nodes))
        self._frames = frames

    def _edges(self, x: FloatArray) -> FloatArray:
        corners = x[self._elements]
        return np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)

    def __call__(self, x: FloatArray, deformation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Linear strain ``(e, 1, 6)`` in the rotated frames, and these frames ``(e, 1, 3, 3)``.

        At nodal positions ``x (n, 3)`` mm, with ``deformation (e, 1, 3, 3)``, F in the fibre frame.
        """
        rotation = _polar(self._edges(x)) @ np.swapaxes(self._start, 1, 2)
        frames = rotation[:, None] @ self._frames
        h = np.swapaxes(frames, 2, 3) @ deformation - np.eye(3)
        normal = [h[..., i, i] for i in range(3)]
        shear = [h[..., i, j] + h[..., j, i] for i, j in ((1, 2), (0, 2), (0, 1))]
        return np.stack(normal + shear, axis=-1), np.ascontiguousarray(frames)


def _polar(a: FloatArray) -> FloatArray:
    """The rotation ``(e, 3, 3)`` nearest to each matrix, also to an inverted one."""
    u, _, v = np.linalg.svd(a)
    u[..., 2] *= np.sign(np.linalg.det(u) * np.linalg.det(v))[:, None]
    return u @ v


def _fibre_gradients(mesh: SolidMesh, reference: Element) -> tuple[FloatArray, FloatArray]:
    """Gradients ``(e, q, k, 3)`` along the fibre frame and quadrature volumes ``(e, q)``."""
    x_e = mesh.nodes[mesh.elements]
    d = reference.gradient(reference.points)
    jacobian = np.matmul(x_e.transpose(0, 2, 1)[:, None], d)
    frame = _fibre_frames(mesh, reference, jacobian)
    gradients = d @ (np.linalg.inv(jacobian) @ frame)
    return np.ascontiguousarray(gradients), np.linalg.det(jacobian) * reference.weights


def _fibre_frames(mesh: SolidMesh, reference: Element, jacobian: FloatArray) -> FloatArray:
    """Orthonormal frames ``(e, q, 3, 3)``, columns: fibre, in the sheet across it, normal."""
    fibre = np.einsum("qa,eai->eqi", reference.shape(reference.points), mesh.fibre)
    if reference.layered:
        normal = np.cross(jacobian[..., 0], jacobian[..., 1])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        fibre = fibre - np.sum(fibre * normal, axis=-1, keepdims=True) * normal
    length = np.linalg.norm(fibre, axis=-1, keepdims=True)
    if np.any(length < 1e-6):
        bad = int(np.argwhere(length[..., 0] < 1e-6)[0, 0])
        raise InputError(f"the fibre of element {bad} has no direction within the leaflet")
    fibre = fibre / length
    if not reference.layered:
        axis = np.eye(3)[np.argmin(np.abs(fibre), axis=-1)]
        normal = np.cross(fibre, axis)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.stack([fibre, np.cross(normal, fibre), normal], axis=-1)


def _enhanced_direction(mesh: SolidMesh, reference: Element) -> FloatArray:
    """Strain ``d (e, q, 6)`` of all modes in the fibre frame, engineering shear."""
    x_e = mesh.nodes[mesh.elements]
    jacobian = np.einsum("eai,qaj->eqij", x_e, reference.gradient(reference.points))
    centre = np.einsum("eai,aj->eij", x_e, reference.gradient(reference.centre)[0])
    frame = _fibre_frames(mesh, reference, jacobian)
    thickness_vector = np.linalg.inv(centre)[:, 2, :]
    # Unit amplitude means unit thickness strain: scale by the length of G^3.
    thickness_vector /= np.linalg.norm(thickness_vector, axis=1, keepdims=True)
    g = np.einsum("ei,eqim->eqm", thickness_vector, frame)
    dyad = np.stack([(1 if i == j else 2) * g[..., i] * g[..., j] for i, j in PAIRS], axis=-1)
    ratio = np.linalg.det(centre)[:, None] / np.linalg.det(jacobian)
    return np.ascontiguousarray(ratio[:, :, None] * dyad)


def _lumped_volume(mesh: SolidMesh, reference: Element, volumes: FloatArray) -> FloatArray:
    """Nodal volumes ``(n,)`` mm^3 by diagonal scaling (Hinton, Rock and Zienkiewicz 1976).

    Row sums would give zero or negative masses to the corners of quadratic elements.
    """
    shape = reference.shape(reference.points)
    diagonal = np.einsum("qa,eq->ea", shape**2, volumes)
    share = diagonal / diagonal.sum(axis=1, keepdims=True) * volumes.sum(axis=1, keepdims=True)
    mass = np.bincount(mesh.elements.ravel(), share.ravel(), minlength=len(mesh.nodes))
    return np.asarray(mass, dtype=np.float64)
