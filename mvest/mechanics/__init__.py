"""The physics: laws, elements, loads, contact, time integration, sensitivities.

Axes. One convention holds for every array here: the element (or face, point, cable) axis first,
then the quadrature point, then the components; nodal arrays have the node axis first and xyz last.
Element kernels take and return element arrays; only :mod:`~mvest.mechanics.assembly` knows global
unknowns. Symmetric tensors are six-vectors 11, 22, 33, 23, 13, 12 in the fibre frame (strains with
engineering shear). Lengths are mm, times s, masses tonne, forces N, stresses MPa.

Modules, in the order of the data flow:

* ``parameters``: parameters of the derivatives; ``law``: transversely isotropic moduli, the law in
  Biot strain, an exponential one, one between both, and the law of leaflets with varying and
  prestretched tissue; ``solid``: strains, forces and tangents of all elements of a mesh;
* ``forces``: pressure, chordae, annular hinge, ties, contact;
* ``assembly``, ``system``: residual, tangent and partial derivatives of everything together;
* ``solver``: sparse direct solvers; ``steps``, ``integrate``: settings and results, time steps,
  Newton's method, sensitivities;
* ``body``: bodies without a valve, and boxes of cells.

A body from plain arrays (a sheet of tetrahedra, six per cell, clamped at its rim):

>>> import itertools, numpy as np
>>> from mvest.mechanics import TransverselyIsotropic, outer_faces, simulate_body
>>> nodes = np.indices((9, 9, 3)).reshape(3, -1).T * [2.5, 2.5, 0.65]
>>> number, axes = np.arange(243).reshape(9, 9, 3), np.eye(3, dtype=int)
>>> paths = [np.cumsum([0 * axes[0], *axes[list(p)]], 0) for p in itertools.permutations(range(3))]
>>> tetrahedra = np.array([number[tuple((c + p).T)] for c in np.ndindex(8, 8, 2) for p in paths])
>>> volume = np.linalg.det(np.diff(nodes[tetrahedra], axis=1))
>>> tetrahedra[volume < 0] = tetrahedra[volume < 0][:, [0, 1, 3, 2]]
>>> under = [f for f in outer_faces(tetrahedra, "tet4") if np.all(nodes[f, 2] == 0)]
>>> rim = np.flatnonzero((nodes[:, :2].min(axis=1) == 0) | (nodes[:, :2].max(axis=1) == 20))
>>> sheet = simulate_body(nodes, tetrahedra, "tet4", fixed_nodes=rim, pressure_faces=under,
...     material=TransverselyIsotropic.isotropic(E=2.0, nu=0.45), pressure=0.016,
...     times=[0.01, 0.02, 0.05, 0.1])
>>> sheet.reason.value, sheet.frames.shape
('completed', (5, 243, 3))
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
