"""The program ``febio4``, where there is one, and what it says of a run.

It is no part of this project. The variable ``MVEST_FEBIO`` names it, or it is found on ``PATH``.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mvest.errors import ConfigurationError
from mvest.exchange.febio.document import NAMES, FebDocument, positions_file
from mvest.processes import run
from mvest.typing import FloatArray
from mvest.valve.mesh.solid_mesh import SolidMesh

VARIABLE = "MVEST_FEBIO"

UPRIGHT = {"hex18": "hex27", "wedge12": "wedge18"}
"""Elements that need extra nodes halfway through the thickness."""


@dataclass(frozen=True, slots=True, eq=False)
class FebRun:
    """The result of a run: times ``(s,)`` s and positions ``(s, n, 3)`` mm, CPU seconds.

    ``reason`` is the last complaint of the log of a run that did not converge.
    """

    converged: bool
    reason: str
    times: FloatArray
    frames: FloatArray
    steps: int
    iterations: int
    seconds: float
    version: str


def febio_program() -> Path:
    """The program, or a ConfigurationError."""
    given = os.environ.get(VARIABLE)
    found = given or shutil.which("febio4")
    if not found or not Path(found).is_file():
        raise ConfigurationError(
            f"no FEBio: {given or 'febio4'} is no program; expected one on PATH, or its place in "
            f"the variable {VARIABLE} (febio.org)"
        )
    return Path(found)


def febio_mesh(mesh: SolidMesh) -> SolidMesh:
    """The mesh of FEBio's elements; the nodes of ``mesh`` come first.

    Elements with two layers of nodes get a third one halfway between them.
    """
    if mesh.element_type in NAMES:
        return mesh
    half = mesh.reference.n_nodes // 2
    low, high = mesh.elements[:, :half], mesh.elements[:, half:]
    pairs, number = np.unique(
        np.stack([low, high], axis=-1).reshape(-1, 2), axis=0, return_inverse=True
    )
    fibre = mesh.fibre[:, :half] + mesh.fibre[:, half:]
    fibre /= np.linalg.norm(fibre, axis=2, keepdims=True)
    return replace(
        mesh,
        nodes=np.vstack([mesh.nodes, mesh.nodes[pairs].mean(axis=1)]),
        elements=np.hstack([low, len(mesh.nodes) + number.reshape(low.shape), high]),
        element_type=UPRIGHT[mesh.element_type],
        fibre=np.concatenate([mesh.fibre[:, :half], fibre, mesh.fibre[:, half:]], axis=1),
    )


def restored(mesh: SolidMesh, x: FloatArray) -> FloatArray:
    """Positions ``(..., n, 3)`` mm of the nodes of a mesh, from those of FEBio's mesh.

    The midpoints of the sides of wedge18, which FEBio lacks, follow from its interpolation.
    """
    own, x = febio_mesh(mesh), np.array(x)
    if own.element_type == "wedge18":
        e = own.elements
        for i, side in enumerate((9, 10, 11)):
            j = (i + 1) % 3
            corners = x[..., e[:, [i, j, 12 + i, 12 + j]], :].sum(axis=-2)
            middles = x[..., e[:, [3 + i, 15 + i, 6 + i, 6 + j]], :].sum(axis=-2)
            x[..., e[:, side], :] = 0.5 * middles - 0.25 * corners
    return x[..., : len(mesh.nodes), :]


def run_febio(
    document: FebDocument, mesh: SolidMesh, path: Path, *, time_limit_s: float = 3600.0
) -> FebRun:
    """Write the document of a mesh to a path and run FEBio on it, with one thread."""
    program = febio_program()
    document.write(path)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    command = [str(program), "-i", path.name, "-nosplash", "-silent"]
    before = os.times()
    reason = ""
    try:
        ended = run(
            command,
            timeout=time_limit_s,
            cwd=path.parent,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        code = ended.returncode
    except subprocess.TimeoutExpired:
        code, reason = 1, f"stopped after {time_limit_s:g} s"
    after = os.times()
    seconds = after.children_user + after.children_system
    seconds -= before.children_user + before.children_system
    log = path.with_suffix(".log")
    said = log.read_text(errors="replace") if log.is_file() else ""
    converged = code == 0 and "N O R M A L" in said
    if not (converged or reason):
        complaints = re.findall(r"^ *\*[^*\n]*[a-z][^*\n]*\* *$", said, re.MULTILINE)
        reason = complaints[-1].strip(" *") if complaints else f"exit status {code}"
    rest, logged = document.nodes, positions_file(path)
    times, frames = np.zeros(0), np.zeros((0, *rest.shape))
    if logged.is_file():
        times, frames = read_positions(logged, len(rest))
    frames = np.concatenate([rest[None], frames])
    counts = re.findall(r"Total number of equilibrium iterations[ .]*: (\d+)", said)
    version = re.search(r"version\s+(\d[\d.]*)", said)
    return FebRun(
        converged,
        reason,
        np.concatenate([[0.0], times]),
        restored(mesh, frames),
        len(times),
        int(counts[-1]) if counts else 0,
        seconds,
        version.group(1) if version else "",
    )


def read_positions(path: Path, n: int) -> tuple[FloatArray, FloatArray]:
    """Times ``(s,)`` and positions ``(s, n, 3)`` mm that FEBio has logged of n nodes.

    A last step that was not written in full is left out.
    """
    times, frames = [], []
    for part in re.split(r"^\*Step.*$", path.read_text(), flags=re.MULTILINE)[1:]:
        rows = [line.split(",") for line in part.splitlines() if line and line[0] != "*"]
        if len(rows) == n:
            values = np.array(rows, dtype=np.float64)
            assert np.array_equal(values[:, 0], np.arange(1, n + 1))
            times.append(float(re.findall(r"^\*Time\s*=\s*(\S+)", part, re.MULTILINE)[0]))
            frames.append(values[:, 1:])
    return np.array(times), np.array(frames).reshape(len(frames), n, 3)
