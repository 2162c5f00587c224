r"""One thin sheet in two finite-element codes: a model of one's own for the filters, by example.

The sheet occupies ``[0, length] x [0, width] x [0, thickness]``. The sides x = 0, y = 0 and
y = width are clamped, the side x = length is free, as a leaflet hangs on its annulus and ends in a
free edge; it is pressed from below. Two regions, before and behind the middle of the length, have a
Young's modulus each. `OwnSheet` predicts it with this project's mechanics, `SecondSheet` with
scikit-fem. The two share nothing but the numbers in `Sheet`: element, strains, load, tangent and
derivatives are written twice, from different formulas. Run as a program, this file is the second
one, asked through files by the contract of `mvest.exchange.external`; without arguments it says
how far the codes are apart:

    python sheet.py REQUEST FOLDER
    python sheet.py

``experiment=models`` estimates the moduli with each of them from the data of each.

scikit-fem gives the mesh, the triquadratic shape functions, the quadrature, the numbering of the
unknowns, the loaded face and the evaluation at points; written here is what a user of any such
library writes: law, residual and tangent.

Total Lagrangian, unknown u with :math:`F = I + \nabla u`, :math:`C = F^T F`:

.. math::
    r(u) \cdot v = \int F S : \nabla v \, dV + p \int (\mathrm{cof} F \, N) \cdot v \, dA,

the pressure p pushing against the outward normal N of the loaded face, wherever that turns. Two
isotropic laws, with :math:`\lambda = E \nu / ((1 + \nu)(1 - 2 \nu))`,
:math:`\mu = E / (2 (1 + \nu))`:

* ``biot``, linear in :math:`U - I`, the law of this project's mechanics in the isotropic case.
  From :math:`W = \lambda/2 \, t^2 + \mu |U - I|^2`, :math:`t = \mathrm{tr}\, U - 3`, follows
  :math:`S = 2 \mu I + (\lambda t - 2 \mu) U^{-1}`;
* ``st_venant_kirchhoff``, linear in :math:`E = (C - I)/2`:
  :math:`S = \lambda \,\mathrm{tr} E\, I + 2 \mu E`.

They agree for small strains. Because S is linear in the modulus, the derivative of the residual by
a region's modulus is that region's internal force over the modulus, and direct differentiation
gives :math:`du/dE = -K^{-1} \, \partial r / \partial E` from the tangent K of the last iterate.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from mvest.errors import ConfigurationError, InputError, MvestError
from mvest.estimation.prediction import Prediction
from mvest.exchange.external.contract import read_request, write_answer
from mvest.mechanics.body import box, outer_faces, simulate_body
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.parameters import Parameter
from mvest.typing import FloatArray, IntArray
from mvest.units import mmhg_to_mpa
from mvest.valve.mesh.solid_mesh import SolidMesh, embed

__all__ = ["LAWS", "PARAMETERS", "OwnSheet", "SecondSheet", "Sheet", "main", "own", "second"]

PARAMETERS = ("E.annulus", "E.edge")
"""Young's moduli in MPa of the half beside the clamped side and of the half with the free edge."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """The sheet, its load, its mesh and where it is looked at.

    Attributes
    ----------
    length, width, thickness : float
        mm.
    poisson : float
        Of both regions.
    pressure_mmHg : float
        On the lower face, following it as it turns.
    cells : (int, int)
        Along length and width. The first is even, so that the regions meet between cells.
    layers : int
        Cells through the thickness.
    observed : (int, int)
        Observed points of the midsurface along length and width.
    load_steps : int
        Equal steps in which the pressure rises.
    """

    length: float = 24.0
    width: float = 16.0
    thickness: float = 1.0
    poisson: float = 0.45
    pressure_mmHg: float = 120.0
    cells: tuple[int, int] = (8, 6)
    layers: int = 1
    observed: tuple[int, int] = (8, 7)
    load_steps: int = 4

    def __post_init__(self) -> None:
        for name in ("length", "width", "thickness"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"sheet {name} = {value} mm, expected > 0")
        if not -1 < self.poisson < 0.5:
            raise InputError(f"sheet poisson = {self.poisson}, expected -1 < poisson < 0.5")
        if not np.isfinite(self.pressure_mmHg):
            raise InputError(f"sheet pressure_mmHg = {self.pressure_mmHg}, expected a number")
        if len(self.cells) != 2 or min(self.cells) < 1 or self.cells[0] % 2:
            raise InputError(f"sheet cells = {self.cells}, expected two > 0, the first even")
        if len(self.observed) != 2 or min(self.observed) < 1:
            raise InputError(f"sheet observed = {self.observed}, expected two > 0")
        for name in ("layers", "load_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"sheet {name} = {getattr(self, name)}, expected at least 1")

    @property
    def pressure(self) -> float:
        """MPa."""
        return mmhg_to_mpa(self.pressure_mmHg)

    @property
    def points(self) -> FloatArray:
        """Observed points of the midsurface ``(n, 3)`` mm, none of them on a clamped side."""
        x = np.linspace(0.0, self.length, self.observed[0] + 1)[1:]
        y = np.linspace(0.0, self.width, self.observed[1] + 2)[1:-1]
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        return np.column_stack([grid, np.full(len(grid), 0.5 * self.thickness)])


def inadmissible(moduli: FloatArray) -> Prediction | None:
    """The failed prediction for moduli that belong to no elastic solid; None where they may."""
    if moduli.shape != (2,):
        raise InputError(f"{moduli.size} moduli of the sheet, expected 2")
    if np.all(np.isfinite(moduli)) and np.all(moduli > 0):
        return None
    return Prediction.failed(
        ", ".join(f"{n} = {v:g} MPa" for n, v in zip(PARAMETERS, moduli, strict=True))
        + ": expected positive moduli"
    )


class OwnSheet:
    """Positions ``(3 n,)`` mm of the sheet's observed points from its two moduli (MPa).

    An observation model of the filters (`mvest.estimation.ObservationModel`): coordinates
    follow one another point by point, the Jacobian ``(3 n, 2)`` mm/MPa is exact.

    Parameters
    ----------
    sheet : Sheet
    element : str
        ``hex18``, the solid-shell of the valve, or ``hex27``, the triquadratic brick.
    """

    def __init__(self, sheet: Sheet, element: str = "hex18") -> None:
        self.sheet, self.element = sheet, element
        size = (sheet.length, sheet.width, sheet.thickness)
        self.nodes, self.elements = box(element, (*sheet.cells, sheet.layers), size)
        faces = outer_faces(self.elements, element)
        self._under = faces[np.all(np.isclose(self.nodes[faces][:, :, 2], 0.0), axis=1)]
        x, y = self.nodes[:, 0], self.nodes[:, 1]
        held = np.isclose(x, 0.0) | np.isclose(y, 0.0) | np.isclose(y, sheet.width)
        self._fixed = np.flatnonzero(held)
        centre = self.nodes[self.elements].mean(axis=1)
        self._region = (centre[:, 0] > 0.5 * sheet.length).astype(np.int64)
        fibre = np.tile([1.0, 0.0, 0.0], (len(self.nodes), 1))
        mesh = SolidMesh(
            self.nodes, self.elements, element, self._region, ("0", "1"), fibre, self._under
        )
        self._observe = embed(mesh, sheet.points)

    def __call__(self, moduli: FloatArray, /) -> Prediction:
        """Predict the observed positions and their derivatives."""
        refused = inadmissible(moduli)
        if refused is not None:
            return refused
        sheet = self.sheet
        loads = np.arange(1, sheet.load_steps + 1) / sheet.load_steps
        pressed = simulate_body(
            self.nodes,
            self.elements,
            self.element,
            material=[TransverselyIsotropic.isotropic(float(E), sheet.poisson) for E in moduli],
            region=self._region,
            fixed_nodes=self._fixed,
            pressure_faces=self._under,
            pressure=[(0.0, 0.0), (1.0, sheet.pressure)],
            times=loads,
            static=True,
            parameters=[Parameter(f"E_f.{k}", float(E)) for k, E in enumerate(moduli)],
        )
        if not pressed.converged:
            return Prediction.failed(f"own sheet: {pressed.reason.value}")
        y = self._observe(pressed.frames[-1]).ravel()
        derivatives = [self._observe(d).ravel() for d in pressed.sensitivities[-1]]
        return Prediction(y, np.column_stack(derivatives))


MAX_ITERATIONS = 30
TOLERANCE = 1e-10
"""Norm of the residual over that of the internal forces."""

ON_SIDE = 1e-9
"""mm, within which a node lies on a side."""

PERMUTATION = np.zeros((3, 3, 3))
PERMUTATION[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
PERMUTATION[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1.0


def biot(C: FloatArray, lame: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    r"""Stress S ``(..., 3, 3)`` and tangent dS/dE ``(..., 9, 9)``, MPa, of the Biot law.

    In the eigenbasis of U (eigenvalues l) with ``s = lame t - 2 mu``: ``S_i = 2 mu + s / l_i``;
    from ``dl_i = dE_ii / l_i`` the normal part is
    ``dS_i/dE_j = lame / (l_i l_j) - delta_ij s / l_i^3``, and the shear part
    ``(S_i - S_j) / (E_i - E_j) = -2 s / (l_i l_j (l_i + l_j))``, in which no difference of
    eigenvalues is left.

    Parameters
    ----------
    C : ndarray
        ``(..., 3, 3)`` right Cauchy-Green tensor.
    lame, mu : ndarray
        Broadcast to ``(...)``, MPa.
    """
    squared, Q = np.linalg.eigh(C)
    stretch = np.sqrt(np.maximum(squared, 1e-12))
    s = lame * (stretch.sum(axis=-1) - 3.0) - 2.0 * mu
    principal = 2.0 * mu[..., None] + s[..., None] / stretch
    S = (Q * principal[..., None, :]) @ np.swapaxes(Q, -1, -2)
    product = stretch[..., :, None] * stretch[..., None, :]
    total = stretch[..., :, None] + stretch[..., None, :]
    normal = lame[..., None, None] / product
    normal -= np.eye(3) * (s[..., None] / stretch**3)[..., None]
    shear = (1.0 - np.eye(3)) * -2.0 * s[..., None, None] / (product * total)
    # Dyads of eigenvectors a and b, as rows (a, b) of nine components.
    dyads = np.einsum("...ia,...jb->...abij", Q, Q).reshape(*C.shape[:-2], 9, 9)
    mirrored = 0.5 * (dyads + dyads[..., [0, 3, 6, 1, 4, 7, 2, 5, 8], :])
    weighted = shear.reshape(*C.shape[:-2], 9)[..., None] * mirrored
    own = dyads[..., ::4, :]
    D = np.swapaxes(dyads, -1, -2) @ weighted + np.swapaxes(own, -1, -2) @ normal @ own
    return S, D


def st_venant_kirchhoff(
    C: FloatArray, lame: FloatArray, mu: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """As `biot`, for the law that is linear in the Green-Lagrange strain."""
    identity = np.eye(3)
    green = 0.5 * (C - identity)
    trace = np.trace(green, axis1=-2, axis2=-1)
    S = (lame * trace)[..., None, None] * identity + 2.0 * mu[..., None, None] * green
    spread = np.einsum("ij,kl->ijkl", identity, identity).reshape(9, 9)
    same = np.einsum("ik,jl->ijkl", identity, identity)
    shear = (same + np.swapaxes(same, 2, 3)).reshape(9, 9)
    D = lame[..., None, None] * spread + mu[..., None, None] * shear
    return S, np.broadcast_to(D, (*C.shape[:-2], 9, 9))


LAWS: dict[str, Callable[..., tuple[FloatArray, FloatArray]]] = {
    "biot": biot,
    "st_venant_kirchhoff": st_venant_kirchhoff,
}
"""Name -> stress and tangent of a law."""


class SecondSheet:
    """Positions ``(3 n,)`` mm of the sheet's observed points from its two moduli (MPa).

    As `OwnSheet`, by scikit-fem. Arrays have the axes
    (element, quadrature point, ...), nodal ones ``(N, 3)``.

    Parameters
    ----------
    sheet : Sheet
    law : str
        One of `LAWS`.
    thickness_points : int
        Gauss points through each layer; 2 make the bricks those of this project's ``hex27``.

    Raises
    ------
    ConfigurationError
        If the law is unknown, or scikit-fem is not installed.
    """

    def __init__(self, sheet: Sheet, law: str = "biot", thickness_points: int = 3) -> None:
        if law not in LAWS:
            raise ConfigurationError(f"law = {law!r}, expected one of {', '.join(LAWS)}")
        try:
            import skfem
        except ImportError as error:
            raise ConfigurationError(
                "the second model needs scikit-fem: pip install mvest[second-model]"
            ) from error
        self.sheet, self.law = sheet, LAWS[law]
        size, cells = (sheet.length, sheet.width, sheet.thickness), (*sheet.cells, sheet.layers)
        lines = [np.linspace(0.0, s, n + 1) for s, n in zip(size, cells, strict=True)]
        mesh = skfem.MeshHex.init_tensor(*lines)
        element = skfem.ElementHex2()
        # Three points along and across: exact for the stiffness of an undistorted brick. The first
        # reference axis of such a mesh is its thickness.
        basis = skfem.Basis(mesh, element, quadrature=_gauss((thickness_points, 3, 3)))
        lower = mesh.facets_satisfying(lambda x: np.abs(x[2]) < ON_SIDE)
        face = skfem.FacetBasis(mesh, element, facets=lower, intorder=4)
        self.nodes = np.array(basis.doflocs.T)
        self._probe = basis.probes(sheet.points.T)
        self._dofs, self._face_dofs = basis.element_dofs.T, face.element_dofs.T
        self._gradient, self._dx = _gradients(basis), np.array(basis.dx)
        self._face_gradient, self._face_dx = _gradients(face), np.array(face.dx)
        values = np.array([np.array(field[0]) for field in face.basis])
        self._face_value = np.moveaxis(values, 0, -1)
        self._normal = np.moveaxis(np.array(face.normals), 0, -1)
        centre = mesh.p[0, mesh.t].mean(axis=0)
        self._region = (centre > 0.5 * sheet.length).astype(np.int64)
        x, y = self.nodes[:, 0], self.nodes[:, 1]
        clamped = (x < ON_SIDE) | (y < ON_SIDE) | (y > sheet.width - ON_SIDE)
        self._free = np.flatnonzero(np.repeat(~clamped, 3))

    def __call__(self, moduli: FloatArray, /) -> Prediction:
        """Predict the observed positions and their derivatives."""
        refused = inadmissible(moduli)
        if refused is not None:
            return refused
        u = np.zeros(self.nodes.size)
        steps = self.sheet.load_steps
        for step in range(1, steps + 1):
            pressure = self.sheet.pressure * step / steps
            for _ in range(MAX_ITERATIONS):
                internal, K = self._solid(u, moduli)
                external, load_K = self._load(u, pressure)
                force = internal.sum(axis=0)
                residual = (force + external)[self._free]
                scale = float(np.linalg.norm(force))
                if not np.isfinite(scale):
                    return Prediction.failed(f"scikit-fem: load step {step} of {steps} runs away")
                factor = splu((K + load_K)[self._free][:, self._free].tocsc())
                if scale > 0 and np.linalg.norm(residual) <= TOLERANCE * scale:
                    break
                u[self._free] -= factor.solve(residual)
            else:
                return Prediction.failed(
                    f"scikit-fem: no equilibrium within {MAX_ITERATIONS} iterations, load step "
                    f"{step} of {steps}"
                )
        derivatives = []
        for by_region, E in zip(internal, moduli, strict=True):
            du = np.zeros(u.size)
            du[self._free] = -factor.solve(by_region[self._free] / E)
            derivatives.append((self._probe @ du.reshape(-1, 3)).ravel())
        y = (self._probe @ (self.nodes + u.reshape(-1, 3))).ravel()
        return Prediction(y, np.column_stack(derivatives))

    def _solid(
        self, u: FloatArray, moduli: FloatArray
    ) -> tuple[FloatArray, sparse.csr_matrix[Any]]:
        """Internal forces by region ``(2, 3 N)`` N and their tangent ``(3 N, 3 N)`` N/mm."""
        G, dx, dofs = self._gradient, self._dx[..., None, None], self._dofs
        m, q, _, n = G.shape
        F = self._deformation(u, dofs, G)
        E, nu = moduli[self._region][:, None], self.sheet.poisson
        lame, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
        S, D = self.law(np.swapaxes(F, -1, -2) @ F, lame, mu)
        # dE = sym(F' grad v): nine rows (j, l), one column for each node and direction (a, i). The
        # symmetric S and D make the symmetric part of it themselves.
        B = np.einsum("eqij,eqla->eqjlai", F, G).reshape(m, q, 9, 3 * n)
        forces = np.einsum("eqsa,eqs->ea", B, S.reshape(m, q, 9) * dx[..., 0])
        internal = np.zeros((2, u.size))
        for k in range(2):
            mine = self._region == k
            np.add.at(internal[k], _unknowns(dofs[mine]), forces[mine])
        K = np.swapaxes(B.reshape(m, 9 * q, -1), 1, 2) @ ((D * dx) @ B).reshape(m, 9 * q, -1)
        spring = np.swapaxes(G.reshape(m, 3 * q, n), 1, 2) @ ((S * dx) @ G).reshape(m, 3 * q, n)
        for i in range(3):
            K[:, i::3, i::3] += spring
        return internal, self._matrix(dofs, K)

    def _load(self, u: FloatArray, pressure: float) -> tuple[FloatArray, sparse.csr_matrix[Any]]:
        """Minus the forces of the pressure ``(3 N,)`` N and their tangent ``(3 N, 3 N)`` N/mm."""
        G, dofs, weight = self._face_gradient, self._face_dofs, self._face_dx * pressure
        m, _, _, n = G.shape
        F = self._deformation(u, dofs, G)
        # cof F_ij = eps_imk eps_jpl F_mp F_kl / 2, so d(cof F N)_i = M_ikl dF_kl.
        twisted = np.einsum("jpl,eqj->eqpl", PERMUTATION, self._normal)
        M = np.einsum("imk,eqml->eqikl", PERMUTATION, F @ twisted)
        area = 0.5 * np.einsum("eqikl,eqkl->eqi", M, F)
        value = self._face_value * weight[..., None]
        forces = np.einsum("eqa,eqi->eai", value, area).reshape(m, -1)
        external = np.zeros(u.size)
        np.add.at(external, _unknowns(dofs), forces)
        change = np.einsum("eqikl,eqlb->eqibk", M, G)
        K = np.einsum("eqa,eqibk->eaibk", value, change).reshape(m, 3 * n, 3 * n)
        return external, self._matrix(dofs, K)

    def _deformation(self, u: FloatArray, dofs: IntArray, G: FloatArray) -> FloatArray:
        """Deformation gradient ``(e, q, 3, 3)``."""
        nodal = np.swapaxes(u.reshape(-1, 3)[dofs], 1, 2)[:, None]
        return np.eye(3) + nodal @ np.swapaxes(G, -1, -2)

    def _matrix(self, dofs: IntArray, K: FloatArray) -> sparse.csr_matrix[Any]:
        """Sparse ``(3 N, 3 N)`` of element matrices ``(e, 3 n, 3 n)``."""
        number = _unknowns(dofs)
        rows = np.broadcast_to(number[:, :, None], K.shape).ravel()
        columns = np.broadcast_to(number[:, None, :], K.shape).ravel()
        size = self.nodes.size
        return sparse.csr_matrix((K.ravel(), (rows, columns)), shape=(size, size))


def _gauss(points: tuple[int, int, int]) -> tuple[FloatArray, FloatArray]:
    """Points ``(3, q)`` and weights ``(q,)`` of the product rule on the unit cube."""
    rules = [np.polynomial.legendre.leggauss(n) for n in points]
    places = np.meshgrid(*[0.5 + 0.5 * x for x, _ in rules], indexing="ij")
    weights = np.einsum("i,j,k->ijk", *[0.5 * w for _, w in rules])
    return np.array([place.ravel() for place in places]), weights.ravel()


def _gradients(basis: Any) -> FloatArray:
    """Gradients ``(e, q, 3, n)`` of a scalar basis' shape functions, 1/mm."""
    gradients = np.array([np.array(field[0].grad) for field in basis.basis])
    return np.ascontiguousarray(np.moveaxis(gradients, (0, 1), (-1, -2)))


def _unknowns(dofs: IntArray) -> IntArray:
    """Numbers ``(e, 3 n)`` of the displacements at nodes ``(e, n)``, xyz last."""
    return np.asarray(3 * dofs[:, :, None] + np.arange(3)).reshape(len(dofs), -1)


def own(element: str = "hex18", **about: Any) -> OwnSheet:
    """The sheet in this project's mechanics, from plain settings."""
    return OwnSheet(_sheet(about), element)


def second(law: str = "biot", thickness_points: int = 3, **about: Any) -> SecondSheet:
    """The sheet in scikit-fem, from plain settings."""
    return SecondSheet(_sheet(about), law, thickness_points)


def _sheet(about: dict[str, Any]) -> Sheet:
    return Sheet(**{k: tuple(v) if isinstance(v, list | tuple) else v for k, v in about.items()})


def agreement(cells: tuple[int, int], layers: int) -> dict[str, tuple[float, float]]:
    """How far predictions are from those of scikit-fem with the Biot law on the same mesh.

    Returns the largest distance of a point (mm) and the relative difference of the derivatives, at
    4 and 1.5 MPa. The same elements are triquadratic bricks with the same quadrature.
    """
    sheet = Sheet(cells=cells, layers=layers, load_steps=2)
    at = np.array([4.0, 1.5])
    usual, alike = SecondSheet(sheet)(at), SecondSheet(sheet, thickness_points=2)(at)
    pairs = {
        "this project, the same elements": (OwnSheet(sheet, "hex27")(at), alike),
        "this project, solid-shells": (OwnSheet(sheet)(at), usual),
        "scikit-fem, St. Venant-Kirchhoff": (SecondSheet(sheet, "st_venant_kirchhoff")(at), usual),
    }
    return {
        name: (
            float(np.linalg.norm((one.y - other.y).reshape(-1, 3), axis=1).max()),
            float(np.linalg.norm(one.jacobian - other.jacobian) / np.linalg.norm(other.jacobian)),
        )
        for name, (one, other) in pairs.items()
    }


def main(arguments: list[str] | None = None) -> int:
    """Answer one request; the exit status.

    Its settings are those of `second`, and with ``derivatives`` false no derivatives are given.
    """
    given = sys.argv[1:] if arguments is None else arguments
    if not given:
        for cells, layers in (((4, 4), 1), ((6, 4), 2), ((8, 6), 2), ((8, 6), 3)):
            for name, (distance, slope) in agreement(cells, layers).items():
                print(f"{cells}, {layers} layers, {name}: {distance:.2g} mm, {100 * slope:.2g} %")
        return 0
    if len(given) != 2:
        sys.stderr.write("expected two arguments, the request and the folder of the answer\n")
        return 2
    try:
        request, folder = read_request(Path(given[0])), Path(given[1])
        settings = dict(request.settings)
        wanted = settings.pop("derivatives", True) and request.jacobian
        prediction = second(**settings)(np.array(request.values))
        write_answer(folder, prediction, request.names if wanted else None)
    except MvestError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
