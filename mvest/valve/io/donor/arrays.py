"""The file of the donor valve: where it is, which arrays it must hold, and what they must be like.

One file, ``healthy.npz``, is an extraction of the Abaqus deck ``Healthy_QuasiStatic.inp`` of Texas
TriValve 1.1 and of its 21 ``.vtu`` frames, 0-based and in mm, with the arrays

======================== ================= =====================================================
``nodes_ref_mm``         (n, 3) real       leaflet nodes first, then chord nodes, frame 0
``quads_anterior`` ...   (m, 4) integer    also ``quads_septal``, ``quads_posterior``
``chordae_edges``        (k, 2) integer    truss elements of the chordae
``annulus_nodes``        (a,) integer      constrained rim
``free_edge_nodes``      (b,) integer
``bc_nodes``             (c,) integer      all constrained nodes: annulus and chord anchors
``bc_displacement_mm``   (c, 3) real       their displacement at the end
``chordae_anchor_nodes`` (d,) integer
``frames_xyz_mm``        (f, n, 3) real    recorded positions, frames equally spaced in time
======================== ================= =====================================================
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvest.errors import InputError
from mvest.reading.npz import check_array, read_npz
from mvest.typing import FloatArray, IntArray

__all__ = ["CITATION", "DATA_VARIABLE", "REGION_NAMES", "DonorArrays", "donor_file", "load_arrays"]

DATA_VARIABLE = "MVEST_TRIVALVE"
"""Environment variable that names the folder (or the file) with the donor's data."""
CITATION = (
    "Mathur et al. 2022, Engineering with Computers, doi 10.1007/s00366-022-01659-w; data: "
    "https://github.com/SoftTissueBiomechanicsLab/Texas_TriValve_1.1, licence CC BY 4.0"
)
REGION_NAMES = ("anterior", "septal", "posterior")
_FILE = "healthy.npz"
_ORIGIN = (
    "The donor valve is not part of this package. Download Texas TriValve 1.1 "
    f"({CITATION}), extract its healthy case to {_FILE} (arrays listed in "
    "mvest/valve/io/donor/arrays.py) and name the folder as data_dir or in the environment "
    f"variable {DATA_VARIABLE}"
)


@dataclass(frozen=True, slots=True, eq=False)
class DonorArrays:
    """The checked arrays of the file; shapes as in the module's table."""

    nodes: FloatArray
    quads: IntArray
    quad_region: IntArray
    chord_edges: IntArray
    chord_anchors: IntArray
    annulus: IntArray
    free_edge: IntArray
    constrained: IntArray
    displacement: FloatArray
    frames: FloatArray


_FORMS: dict[str, tuple[str, tuple[int | None, ...]]] = {
    "nodes_ref_mm": ("f", (None, 3)),
    "bc_displacement_mm": ("f", (None, 3)),
    "frames_xyz_mm": ("f", (None, None, 3)),
    **{f"quads_{name}": ("i", (None, 4)) for name in REGION_NAMES},
    "chordae_edges": ("i", (None, 2)),
    "annulus_nodes": ("i", (None,)),
    "free_edge_nodes": ("i", (None,)),
    "bc_nodes": ("i", (None,)),
    "chordae_anchor_nodes": ("i", (None,)),
}
"""Kind and shape of each array, none of them empty."""


def donor_file(data_dir: str | Path | None = None) -> Path:
    """The donor's file in ``data_dir`` or where the environment variable ``MVEST_TRIVALVE`` says.

    Raises
    ------
    InputError
        If neither names an existing file; the message says where to get it.
    """
    given = data_dir if data_dir is not None else os.environ.get(DATA_VARIABLE)
    if given is None or not str(given):
        raise InputError(f"no folder given for the donor valve. {_ORIGIN}")
    path = Path(given)
    path = path if path.suffix == ".npz" else path / _FILE
    if not path.is_file():
        raise InputError(f"donor valve: there is no file {path}. {_ORIGIN}")
    return path


def load_arrays(path: Path) -> DonorArrays:
    """Read the file and check every array for kind, shape, finiteness and index range.

    Raises
    ------
    InputError
        If the file is unreadable, lacks an array, or its arrays contradict each other.
    """
    stored = read_npz(path, list(_FORMS))
    raw: dict[str, Any] = {
        name: check_array(stored[name], f"{path}: {name}", kind, shape)
        for name, (kind, shape) in _FORMS.items()
    }
    n = len(raw["nodes_ref_mm"])
    for name, array in raw.items():
        if not array.size:
            raise InputError(f"{path}: {name} is {array.dtype} of shape {array.shape}")
        if _FORMS[name][0] == "i" and not 0 <= array.min() <= array.max() < n:
            raise InputError(f"{path}: {name} refers to nodes outside 0 to {n - 1}")
    if raw["frames_xyz_mm"].shape[1] != n or len(raw["frames_xyz_mm"]) < 2:
        raise InputError(
            f"{path}: frames_xyz_mm has shape {raw['frames_xyz_mm'].shape}, expected "
            f"(2 or more, {n}, 3)"
        )
    if len(raw["bc_nodes"]) != len(raw["bc_displacement_mm"]):
        raise InputError(
            f"{path}: {len(raw['bc_displacement_mm'])} rows of bc_displacement_mm for "
            f"{len(raw['bc_nodes'])} bc_nodes"
        )
    quads = [raw[f"quads_{name}"] for name in REGION_NAMES]
    return DonorArrays(
        nodes=raw["nodes_ref_mm"],
        quads=np.vstack(quads),
        quad_region=np.repeat(np.arange(len(quads)), [len(q) for q in quads]),
        chord_edges=raw["chordae_edges"],
        chord_anchors=raw["chordae_anchor_nodes"],
        annulus=raw["annulus_nodes"],
        free_edge=raw["free_edge_nodes"],
        constrained=raw["bc_nodes"],
        displacement=raw["bc_displacement_mm"],
        frames=raw["frames_xyz_mm"],
    )
