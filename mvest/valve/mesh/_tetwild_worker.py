"""Run fTetWild on one surface in a child process: it may crash without a Python exception.

Started by `mvest.valve.mesh.tetwild` as ``_tetwild_worker.py INPUT.npz OUTPUT.npz`` in a temporary
folder, because fTetWild writes files into the current one.
"""

import importlib.util
import sys
import types

import numpy as np


def main(source: str, target: str) -> None:
    """Read surface and settings from `source` (npz), write nodes and tetrahedra to `target`."""
    # Since version 0.4 the package imports pyvista, which is not needed here. An empty package with
    # the same path avoids that import.
    spec = importlib.util.find_spec("pytetwild")
    if spec is not None and spec.submodule_search_locations is not None:
        package = types.ModuleType("pytetwild")
        package.__path__ = list(spec.submodule_search_locations)
        sys.modules["pytetwild"] = package
    from pytetwild.pytetwild import tetrahedralize

    with np.load(source, allow_pickle=False) as data:
        nodes, tetrahedra = tetrahedralize(
            data["vertices"],
            data["triangles"].astype(np.int32),
            edge_length_fac=float(data["edge_length_fraction"]),
            epsilon=float(data["envelope_fraction"]),
            stop_energy=float(data["stop_energy"]),
            num_opt_iter=int(data["iterations"]),
            coarsen=bool(data["coarsen"]),
            num_threads=1,
            quiet=True,
        )
    np.savez(target, nodes=np.asarray(nodes, float), tetrahedra=np.asarray(tetrahedra, np.int64))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
