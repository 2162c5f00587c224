"""FEBio beside this project: ``python -m tests.verification.febio [PART ...]`` writes the tables.

The same bodies and the same valve in both, from one mesh: a cube pulled, a sheet inflated, a strip
bent, a valve under a pressure at which its leaflets do not meet, and a valve that closes. What the
two differ by is taken apart by computing here with FEBio's law, and with FEBio's element, as well.
It needs the program (`tests.exchange.febio.program`). Parts are laws, bodies and the contacts of
the valve: none, potential; all by default. Rows of other contacts stay as they are.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mvest.closure.model import ClosureModel
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.transform import Log
from mvest.exchange.exporting.febio import (
    CONTACTS,
    FebioOptions,
    valve_document,
)
from mvest.exchange.febio.document import LAWS, NAMES, FebDocument, febio_law
from mvest.files import write_atomically
from mvest.mechanics.body import box, outer_faces, simulate_body
from mvest.mechanics.integrate import simulate
from mvest.mechanics.law import Law
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.settings import (
    ClosureProtocol,
    ContactSettings,
    MechanicsSettings,
    TissueSettings,
)
from mvest.mechanics.steps import NewtonSettings, Simulation
from mvest.mechanics.valve_system import boundary_loading
from mvest.observation.vertices import FRAMES, Observation
from mvest.problem.estimate import Problem, estimate
from mvest.typing import BoolArray, FloatArray
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.solid_mesh import SolidMesh
from mvest.valve.mesh.structured import structured_mesh
from tests.exchange.febio.program import FebRun, febio_mesh, run_febio
from tests.mechanics.bodies import SaintVenantKirchhoff
from tests.places import ROOT
from tests.tables import markdown, write_text
from tests.verification.strip import MATERIALS

RESULTS = ROOT / "results"
CUBE_STRAINS = (-0.1, 0.05, 0.1, 0.2)
"""Linear strains of the pulled cube: its stress over Young's modulus."""
PULLED = {"along": (0,), "across": (1,), "both": (0, 1)}
ELEMENTS = ("tet4", "tet10", "hex18", "hex27", "wedge12", "wedge18")
STEPS = 6
GENERIC = np.array([6.23, 2.09])
PARAMETERS = ("E_f.anterior", "E_f.posterior")
MMHG = {"none": 8.0, "potential": 120.0}
"""Pressures at which the leaflets do not meet, and at which they close."""
GAP_MM, REACH_MM = 1.0, 1.65
"""Of the atrial faces under the reference pressure, and where contact begins."""
VALVES = (
    FebioOptions(law="orthotropic", contact="none", dynamic=False),
    FebioOptions(contact_gap_mm=GAP_MM, contact_reach_mm=REACH_MM),
)
"""Closing, the orthotropic law lets elements turn over where the leaflets fold at a commissure."""

Where = Callable[[FloatArray], BoolArray]
Closed = tuple[Simulation, float]


def block(element: str, cells: tuple[int, ...], size: tuple[float, ...], on: Where) -> SolidMesh:
    """A block whose fibres run along x, pressed on the faces whose nodes are all ``on``."""
    nodes, elements = box(element, cells, size)
    faces = outer_faces(elements, element)
    fibre = np.tile([1.0, 0.0, 0.0], (len(nodes), 1))
    region = np.zeros(len(elements), dtype=np.int64)
    pressed = faces[np.all(on(nodes)[faces], axis=1)]
    return SolidMesh(nodes, elements, element, region, ("tissue",), fibre, pressed)


def here(mesh: SolidMesh, held: Where, pressure: float, law: Law) -> Simulation:
    """Equilibria under equal steps of a pressure (MPa), coordinates ``(n, 3)`` being held."""
    return simulate_body(
        mesh.nodes,
        mesh.elements,
        mesh.element_type,
        material=law,
        fibre=mesh.fibre,
        fixed_components=held(mesh.nodes),
        pressure_faces=mesh.pressure_faces,
        pressure=[(0.0, 0.0), (1.0, pressure)],
        times=np.arange(1, STEPS + 1) / STEPS,
        static=True,
        newton=NewtonSettings(tolerance=1e-10),
    )


def there(
    mesh: SolidMesh, held: Where, pressure: float, material: TransverselyIsotropic, kind: str
) -> FebRun:
    """The same in FEBio."""
    own = febio_mesh(mesh)
    fixed = held(own.nodes)
    curve = np.array([[0.0, 0.0], [1.0, 1.0]])
    document = FebDocument(own, [febio_law(material, kind)], 1.0, 1 / STEPS, 1e-9)
    for k, axis in enumerate("xyz"):
        if len(nodes := np.flatnonzero(fixed[:, k])):
            document.prescribe(f"held_{axis}", nodes, np.zeros((len(nodes), 3)), curve, axis)
    document.press(own.pressure_faces, curve * [1.0, pressure])
    with tempfile.TemporaryDirectory() as folder:
        return run_febio(document, mesh, Path(folder) / "body.feb")


def last(run: Simulation | FebRun) -> FloatArray:
    """Positions in the end; not known where there is none."""
    return run.frames[-1] if run.converged else np.full_like(run.frames[-1], np.nan)


def largest(move: FloatArray) -> float:
    """Length of the largest displacement, mm."""
    return float(np.linalg.norm(move, axis=1).max())


def laws() -> pd.DataFrame:
    """Strains of a cube pulled along, across and both ways: here, and with two laws of FEBio."""
    rows = []
    for reading, pulled, strain in (
        (r, p, s) for r in ("A", "C") for p in PULLED for s in CUBE_STRAINS
    ):
        material, axes = MATERIALS[reading], list(PULLED[pulled])
        stress = strain * (material.E_f if pulled == "along" else material.E_p)

        def ends(x: FloatArray, axes: list[int] = axes) -> BoolArray:
            return np.any(x[:, axes] == 1, axis=1)

        mesh = block("tet10", (1, 1, 1), (1.0, 1.0, 1.0), ends)
        corner = np.flatnonzero(np.all(mesh.nodes == 1, axis=1))[0]
        body = (mesh, lambda x: x == 0, -stress)
        runs = {
            "here": here(*body, material),
            "here_orthotropic": here(*body, SaintVenantKirchhoff([material])),
        } | {kind.replace("-", "_"): there(*body, material, kind) for kind in LAWS}
        strains = {name: last(run)[corner, axes[0]] - 1 for name, run in runs.items()}
        rows.append({"reading": reading, "pulled": pulled, "stress_mpa": stress, "linear": strain}
                    | strains)  # fmt: skip
    return pd.DataFrame(rows)


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """Its value, and seconds of the processor."""
    start = time.process_time()
    return function(), time.process_time() - start


def bodies() -> pd.DataFrame:
    """A sheet clamped at its rim and a strip at one end, of each element in both readings."""
    rows = []
    for problem, cells, size, pressure in (
        ("sheet", (6, 6, 1), (20.0, 20.0, 1.3), 0.016),
        ("strip", (6, 4, 1), (13.0, 10.0, 1.26), 4.1e-3),
    ):
        ends = size[:2] if problem == "sheet" else (np.nan, np.nan)
        axes = slice(0, 2) if problem == "sheet" else slice(0, 1)

        def held(x: FloatArray, ends: Any = ends, axes: slice = axes) -> BoolArray:
            edge = np.any((x[:, axes] == 0) | (x[:, axes] == ends[axes]), axis=1)
            return np.repeat(edge[:, None], 3, axis=1)

        for element, reading in ((e, r) for e in ELEMENTS for r in ("A", "C")):
            material = MATERIALS[reading]
            body = (block(element, cells, size, lambda x: x[:, 2] == 0), held, pressure)
            rest = body[0].nodes
            own, seconds = timed(partial(here, *body, material))
            law, run = (
                here(*body, SaintVenantKirchhoff([material])),
                there(*body, material, "orthotropic"),
            )
            rows.append({
                "problem": problem, "element": element, "reading": reading,
                "febio_element": NAMES[febio_mesh(body[0]).element_type][0],
                "here_mm": largest(last(own) - rest), "febio_mm": largest(last(run) - rest),
                "by_law_mm": largest(last(law) - last(own)),
                "by_rest_mm": largest(last(run) - last(law)),
                "here_s": seconds, "febio_s": run.seconds,
                "febio": run.version, "reason": run.reason,
            })  # fmt: skip
    return pd.DataFrame(rows)


def valve_model(contact: str, *, alike: bool = False) -> ClosureModel:
    """The default valve on a coarse mesh, with FEBio's gaps if ``alike``."""
    template = Template()
    settings = ContactSettings(active=contact != "none")
    if alike:  # there, gaps are from face to face
        thickness = float(template.valve(144, 32).surface.thickness.mean())
        settings = ContactSettings(
            reference_distance=1 + GAP_MM / thickness, activation_distance=1 + REACH_MM / thickness
        )
    tissue = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
    protocol = ClosureProtocol(pressure_mmHg=MMHG[contact])
    return ClosureModel(
        template.valve(72, 16),
        template.valve(144, 32),
        structured_mesh(template, "hex18", 24, 4),
        MechanicsSettings(tissue, protocol, contact=settings),
        PARAMETERS,
    )


def with_febios_element(model: ClosureModel) -> ClosureModel:
    """The same on FEBio's element, with one direction of the fibre in each."""
    mesh = febio_mesh(model.mesh)
    reference = mesh.reference
    centre = np.einsum("a,mai->mi", reference.shape(reference.centre)[0], mesh.fibre)
    fibre = np.repeat(centre[:, None], mesh.fibre.shape[1], axis=1)
    return replace(model, mesh=replace(mesh, fibre=fibre))


def closed(model: ClosureModel, law: bool = False) -> Closed:
    """The closed valve with the generic moduli, by FEBio's law if wanted, and seconds."""
    system, _ = model.tuned(GENERIC)
    if law:
        tissue = [model.settings.tissue[name] for name in model.mesh.region_names]
        system.solid.law = SaintVenantKirchhoff(
            [one.material(value) for one, value in zip(tissue, GENERIC, strict=True)]
        )
        system.solid.reset()
    return timed(
        lambda: simulate(
            system,
            boundary_loading(system, model.valve, model.contact_valve, model.settings),
            model.settings.protocol.steps(),
            damping=model.settings.damping,
            newton=model.settings.newton,
            final_only=True,
            solver=model.solver,
        )
    )


def valve(settings: FebioOptions) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """A valve in both, step by step from one to the other, and moduli from FEBio's closed frame."""
    contact, orthotropic = settings.contact, settings.law == "orthotropic"
    model = valve_model(contact)
    with tempfile.TemporaryDirectory() as folder:
        own = replace(model, mesh=febio_mesh(model.mesh))
        document = valve_document(own, GENERIC, settings)
        run = run_febio(document, model.mesh, Path(folder) / "valve.feb", time_limit_s=1800.0)
    seen = model.observed(run.frames[-1])
    system, _ = valve_model("potential").tuned(GENERIC)
    through = system.contact.intersects(system.contact.points(run.frames[-1]))
    chain = [("as it is", model, False), ("FEBio's element", with_febios_element(model), False)]
    if orthotropic:
        chain.insert(1, ("FEBio's law", model, True))
        chain.append(("FEBio's law and element", with_febios_element(model), True))
    if contact == "potential":
        chain.append(("FEBio's gaps", valve_model(contact, alike=True), False))
    about = {"contact": contact, "law": settings.law}
    rows = []
    for words, own, law in chain:
        result, seconds = closed(own, law)
        distance = np.linalg.norm(own.observed(result.frames[-1]) - seen, axis=1)
        if not (result.converged and run.converged):
            distance = np.full(1, np.nan)
        rows.append(about | {
            "here": words, "here_converged": result.converged, "febio_converged": run.converged,
            "reason": run.reason, "reached_s": run.times[-1], "through": through,
            "mean_mm": distance.mean(), "max_mm": distance.max(),
            "here_iterations": result.iterations, "here_s": seconds, "febio_steps": run.steps,
            "febio_iterations": run.iterations, "febio_s": run.seconds, "febio": run.version,
        })  # fmt: skip
    chosen = [one for one in chain if one[0] in ("as it is", "FEBio's gaps")]
    return rows, [about | {"here": w} | moduli(m, seen) for w, m, _ in chosen if run.converged]


def moduli(model: ClosureModel, seen: FloatArray) -> dict[str, Any]:
    """What the filter estimates from a closed frame ``(n, 3)`` mm, 0.1 mm SD being assumed."""
    prior = Gaussian.from_variance(GENERIC * [0.7, 1.4], (0.5 * GENERIC) ** 2)
    model, how = replace(model, continuation=True), (IteratedFilter(1e-3), Log((True, True)))
    problem = Problem(PARAMETERS, model, prior, *how, model.settings.tissue)
    result = estimate(problem, Observation((FRAMES[-1],), seen[None], np.array([0.1**2])))
    found = np.full(2, np.nan) if result.estimate is None else result.estimate
    error = 100 * (found / GENERIC - 1)
    return {
        "converged": result.converged, "reason": result.reason,
        "anterior_mpa": found[0], "posterior_mpa": found[1],
        "anterior_percent": error[0], "posterior_percent": error[1],
        "residual_mm": np.nan if result.distance is None else float(np.nanmean(result.distance)),
        "seconds": result.seconds,
    }  # fmt: skip


def shown(name: str, **columns: str) -> str:
    """Columns of a stored table, each with its format; a dash where there is no result."""
    table = pd.read_csv(RESULTS / f"febio_{name}.csv", keep_default_na=False, na_values=[""])
    return markdown(
        pd.DataFrame(
            {c: ["–" if pd.isna(v) else f"{v:{of}}" for v in table[c]] for c, of in columns.items()}
        )
    )


def text() -> tuple[str, ...]:
    """What the stored tables say."""
    return (
        "Written by `python -m tests.verification.febio`.",
        "**Laws.** Strain of a cube of anterior tissue under a Cauchy stress of Young's modulus "
        "times the linear strain, in both readings of the Poisson ratio: here, here with a law "
        "like FEBio's `orthotropic elastic`, with that, and with `neo-Hookean transiso`.",
        shown("laws", reading="", pulled="", linear=".2%", here=".2%", here_orthotropic=".2%",
              orthotropic=".2%", neo_hookean=".2%"),
        "**Elements.** A sheet of 20 x 20 x 1.3 mm under 16 kPa, clamped at its rim (6 x 6 cells), "
        "and a strip of 13 x 10 x 1.26 mm under 4.1 kPa, clamped at one end (6 x 4 cells): the "
        "largest displacement here and in FEBio; by how much FEBio's law (`orthotropic elastic`), "
        "used here, moves the body; and the largest distance of FEBio from that. Processor time "
        "of six load steps.",
        shown("bodies", problem="", element="", febio_element="", reading="", here_mm=".3f",
              febio_mm=".3f", by_law_mm=".3f", by_rest_mm=".3g", here_s=".2f", febio_s=".2f",
              febio=""),
        "**A valve.** The default valve on 24 x 4 cells (`hex18`; `hex27` in FEBio), generic "
        "moduli, reading A: the distance of the leaflets' vertices between FEBio and here, as it "
        "is here or with what of FEBio's is named, and whether FEBio's leaflets pass through each "
        "other. Without contact the pressure is 8 mmHg, at which leaflets do not meet, otherwise "
        "120.",
        shown("valves", contact="", law="", here="", mean_mm=".3f", max_mm=".2f",
              here_iterations="", here_s=".1f", febio_steps="", febio_iterations="", febio_s=".0f",
              reason="", through=""),
        "**Moduli from FEBio's frames.** What the filter here estimates from FEBio's frame, in "
        "which E_f is 6.23 MPa (anterior) and 2.09 MPa (posterior), starting 30 % below and 40 % "
        "above, with 0.1 mm SD assumed of a coordinate.",
        shown("moduli", contact="", law="", here="", anterior_mpa=".2f", anterior_percent=".1f",
              posterior_mpa=".2f", posterior_percent=".1f", residual_mm=".3f"),
    )  # fmt: skip


def main(parts: list[str]) -> None:
    """Compute the named parts, and write every table that has them."""
    runs = [valve(one) for one in VALVES if one.contact in parts]
    tables = {name: make() for name, make in (("laws", laws), ("bodies", bodies)) if name in parts}
    for name, rows in (("valves", [r for a, _ in runs for r in a]),
                       ("moduli", [r for _, b in runs for r in b])):  # fmt: skip
        old = pd.read_csv(RESULTS / f"febio_{name}.csv", keep_default_na=False, na_values=[""])
        tables[name] = pd.concat([old[~old["contact"].isin(parts)], pd.DataFrame(rows)])
    for name, table in tables.items():
        content = table.to_csv(index=False, float_format="%.9g")
        write_atomically(RESULTS / f"febio_{name}.csv", content)
    write_text(RESULTS / "febio.md", *text())


if __name__ == "__main__":
    main(sys.argv[1:] or ["laws", "bodies", *CONTACTS])
