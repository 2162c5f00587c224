"""FEBio beside this project: ``python -m experiments.febio``.

The same bodies and the same valve in both, from one mesh: a cube pulled, a sheet inflated, a strip
bent, a valve under a pressure at which its leaflets do not meet, and a valve that closes. What the
two differ by is taken apart by computing here with FEBio's law, and with FEBio's element, as well.
It needs the program (`mvest.febio.program`); what was published before stays without it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.verification import MATERIALS
from mvest.closure.model import ClosureModel
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.transform import Log
from mvest.febio.document import Control, FebDocument, Prescribed, Pressure
from mvest.febio.laws import LAWS as KINDS
from mvest.febio.laws import febio_law
from mvest.febio.mesh import febio_mesh
from mvest.febio.program import FebRun, run_febio
from mvest.febio.valve import CONTACTS, FebSettings, differences, valve_document
from mvest.files import write_atomically
from mvest.mechanics.blocks import box, outer_faces
from mvest.mechanics.body import simulate_body
from mvest.mechanics.integrate import simulate
from mvest.mechanics.law.biot import TransverselyIsotropic
from mvest.mechanics.law.linear import LinearLaw
from mvest.mechanics.settings import (
    ClosureProtocol,
    ContactSettings,
    MechanicsSettings,
    TissueSettings,
)
from mvest.mechanics.solid import Law
from mvest.mechanics.steps import NewtonSettings, Simulation
from mvest.mechanics.valve_system import boundary_loading
from mvest.observation.vertices import FRAMES, Observation
from mvest.problem.estimate import StudyResult, estimate
from mvest.problem.problem import Problem
from mvest.typing import BoolArray, FloatArray
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.solid_mesh import SolidMesh
from mvest.valve.mesh.structured import structured_mesh

__all__ = ["main"]

CUBE_STRAINS = (-0.1, 0.05, 0.1, 0.2)
"""Linear strains of the pulled cube: its stress over Young's modulus."""
PULLED = {"along": ("x",), "across": ("y",), "both": ("x", "y")}
SHEET = ((6, 6, 1), (20.0, 20.0, 1.3), 0.016)
STRIP = ((6, 4, 1), (13.0, 10.0, 1.26), 4.1e-3)
"""Cells, size (mm) and pressure (MPa): a sheet clamped at its rim, a strip clamped at one end whose
tip turns by about 75 degrees."""
LOAD_STEPS = 6
ELEMENTS = ("tet4", "tet10", "hex18", "hex27", "wedge12", "wedge18")
CELLS = (24, 4)
"""Of the valve, around it and along the leaflets."""
GENERIC = np.array([6.23, 2.09])
NAMES = ("E_f.anterior", "E_f.posterior")
APART_MMHG, CLOSED_MMHG = 8.0, 120.0
"""Pressures at which the leaflets do not meet, and at which they close."""
GAP_MM, REACH_MM = 1.0, 1.65
"""Of the atrial faces under the reference pressure, and where contact begins."""
STD_MM = 0.1
"""Assumed of a coordinate of the closed frame that is estimated from."""
TIME_LIMIT_S = 1800.0
"""Of one run of FEBio."""
STATIC = Control(1.0, 1 / LOAD_STEPS, 1e-4, 1 / LOAD_STEPS, displacement=1e-9, energy=1e-18)


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A body under pressure, the same in both.

    Attributes
    ----------
    mesh : SolidMesh
    held : callable
        Nodes ``(n, 3)`` mm -> which of their coordinates ``(n, 3)`` stay.
    pressure : float
        MPa.
    """

    mesh: SolidMesh
    held: Callable[[FloatArray], BoolArray]
    pressure: float

    def here(self, law: TransverselyIsotropic | Law) -> Simulation:
        """Equilibria under equal steps of the load."""
        mesh = self.mesh
        return simulate_body(
            mesh.nodes,
            mesh.elements,
            mesh.element_type,
            material=law,
            fibre=mesh.fibre,
            fixed_components=self.held(mesh.nodes),
            pressure_faces=mesh.pressure_faces,
            pressure=[(0.0, 0.0), (1.0, self.pressure)],
            times=np.arange(1, LOAD_STEPS + 1) / LOAD_STEPS,
            static=True,
            newton=NewtonSettings(tolerance=1e-10),
        )

    def there(self, material: TransverselyIsotropic, kind: str, folder: Path) -> FebRun:
        """The same in FEBio."""
        mesh = febio_mesh(self.mesh)
        held = self.held(mesh.solid.nodes)
        curve = np.array([[0.0, 0.0], [1.0, 1.0]])
        groups = []
        for k, axis in enumerate("xyz"):
            nodes = np.flatnonzero(held[:, k])
            if len(nodes):
                still = np.zeros((len(nodes), 3))
                groups.append(Prescribed(f"held_{axis}", nodes, still, curve, (axis,)))
        pressed = Pressure(mesh.solid.pressure_faces, curve * [1.0, self.pressure])
        laws = (febio_law(material, kind),)
        document = FebDocument(mesh, laws, STATIC, pressed, tuple(groups))
        return run_febio(document, folder / "body.feb")


def block(
    element: str,
    cells: tuple[int, int, int],
    size: tuple[float, float, float],
    pressed: Callable[[FloatArray], BoolArray],
) -> SolidMesh:
    """A block whose fibres run along x, with the outer faces whose nodes are ``pressed``."""
    nodes, elements = box(element, cells, size)
    faces = outer_faces(elements, element)
    chosen = faces[np.all(pressed(nodes)[faces], axis=1)]
    fibre = np.tile([1.0, 0.0, 0.0], (len(nodes), 1))
    region = np.zeros(len(elements), dtype=np.int64)
    return SolidMesh(nodes, elements, element, region, ("tissue",), fibre, chosen)


def law_table(folder: Path) -> pd.DataFrame:
    """Strains of a cube pulled along, across and both ways: here, and with two laws of FEBio."""

    def symmetric(x: FloatArray) -> BoolArray:
        return np.asarray(x == 0)

    rows = []
    for name in ("A", "C"):
        material = MATERIALS[name]
        for pulled, axes in PULLED.items():
            modulus = material.E_f if pulled == "along" else material.E_p
            for strain in CUBE_STRAINS:
                ends = ["xyz".index(axis) for axis in axes]

                def pressed(x: FloatArray, ends: Sequence[int] = ends) -> BoolArray:
                    return np.asarray(np.any(x[:, ends] == 1, axis=1))

                mesh = block("tet10", (1, 1, 1), (1.0, 1.0, 1.0), pressed)
                body = Body(mesh, symmetric, -strain * modulus)
                corner = np.flatnonzero(np.all(mesh.nodes == 1, axis=1))[0]
                here, same = body.here(material), body.here(LinearLaw.of([material]))
                row: dict[str, Any] = {
                    "reading": name, "pulled": pulled, "stress_mpa": strain * modulus,
                    "linear": strain,
                    "here": _strain(here.frames, here.converged, corner, ends[0]),
                    "here_orthotropic": _strain(same.frames, same.converged, corner, ends[0]),
                }  # fmt: skip
                for kind in KINDS:
                    there = body.there(material, kind, folder)
                    row[kind.replace("-", "_")] = _strain(
                        there.frames, there.converged, corner, ends[0]
                    )
                rows.append(row)
    return pd.DataFrame(rows)


def _strain(frames: FloatArray, converged: bool, corner: int, axis: int) -> float:
    return float(frames[-1, corner, axis] - 1) if converged else np.nan


def body_table(folder: Path) -> pd.DataFrame:
    """A sheet and a strip of each element in both readings."""

    def rim(x: FloatArray) -> BoolArray:
        edge = np.any((x[:, :2] == 0) | (x[:, :2] == SHEET[1][:2]), axis=1)
        return np.repeat(edge[:, None], 3, axis=1)

    def end(x: FloatArray) -> BoolArray:
        return np.repeat(x[:, :1] == 0, 3, axis=1)

    def below(x: FloatArray) -> BoolArray:
        return np.asarray(x[:, 2] == 0)

    rows = []
    for problem, (cells, size, pressure), held in (("sheet", SHEET, rim), ("strip", STRIP, end)):
        for element in ELEMENTS:
            body = Body(block(element, cells, size, below), held, pressure)
            for name in ("A", "C"):
                material = MATERIALS[name]
                here, own_s = _timed(partial(body.here, material))
                law = body.here(LinearLaw.of([material]))
                there = body.there(material, "orthotropic", folder)
                rest = body.mesh.nodes
                rows.append(
                    {
                        "problem": problem, "element": element, "reading": name,
                        "febio_element": febio_mesh(body.mesh).element,
                        "here_mm": _largest(here.frames[-1] - rest, here.converged),
                        "febio_mm": _largest(there.frames[-1] - rest, there.converged),
                        "by_law_mm": _largest(
                            law.frames[-1] - here.frames[-1], law.converged and here.converged
                        ),
                        "by_rest_mm": _largest(
                            there.frames[-1] - law.frames[-1], there.converged and law.converged
                        ),
                        "here_s": own_s, "febio_s": there.seconds,
                        "febio": there.version, "reason": there.reason,
                    }
                )  # fmt: skip
    return pd.DataFrame(rows)


def _largest(move: FloatArray, known: bool) -> float:
    return float(np.linalg.norm(move, axis=1).max()) if known else np.nan


def _timed(function: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    result = function()
    return result, time.process_time() - start


def valve_model(pressure_mmHg: float, contact: ContactSettings | None = None) -> ClosureModel:
    """The default valve on a coarse mesh, with the generic ratios."""
    template = Template()
    tissue = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
    settings = MechanicsSettings(
        tissue,
        ClosureProtocol(pressure_mmHg=pressure_mmHg),
        contact=contact or ContactSettings(active=False),
    )
    mesh = structured_mesh(template, "hex18", *CELLS)
    return ClosureModel(template.valve(72, 16), template.valve(144, 32), mesh, settings, NAMES)


def with_febios_element(model: ClosureModel) -> ClosureModel:
    """The same on FEBio's element, with one direction of the fibre in each."""
    mesh = febio_mesh(model.mesh).solid
    reference = mesh.reference
    centre = np.einsum("a,mai->mi", reference.shape(reference.centre)[0], mesh.fibre)
    fibre = np.repeat(centre[:, None], mesh.fibre.shape[1], axis=1)
    return replace(model, mesh=replace(mesh, fibre=fibre))


def closed(model: ClosureModel, law: bool = False) -> tuple[Simulation, float]:
    """The closed valve with the generic moduli, by FEBio's law if wanted, and seconds."""
    system, _ = model.tuned(GENERIC)
    if law:
        moduli = [
            model.settings.tissue[name].material(value)
            for name, value in zip(model.mesh.region_names, GENERIC, strict=True)
        ]
        system.solid.law = LinearLaw.of(moduli)
        system.solid.reset()
    loading = boundary_loading(system, model.valve, model.contact_valve, model.settings)
    return _timed(
        lambda: simulate(
            system,
            loading,
            model.settings.protocol.steps(),
            damping=model.settings.damping,
            newton=model.settings.newton,
            final_only=True,
            solver=model.solver,
        )
    )


Frames = dict[tuple[str, str], FloatArray]

FEBIO_RUNS = (
    FebSettings("orthotropic", "none", dynamic=False, quasi_newton=0, tolerance=1e-4),
    FebSettings("neo-hookean", "potential", GAP_MM, REACH_MM),
    FebSettings("neo-hookean", "sliding", 0.2, REACH_MM),
)
"""Closing, the orthotropic law lets elements turn over where the leaflets fold at a commissure."""


def contact_like_febio(model: ClosureModel) -> ContactSettings:
    """Contact here with the gaps of FEBio's, which are from face to face."""
    thickness = float(model.contact_valve.surface.thickness.mean())
    return ContactSettings(
        reference_distance=1 + GAP_MM / thickness, activation_distance=1 + REACH_MM / thickness
    )


def valve_table(
    folder: Path, contacts: Collection[str], time_limit_s: float
) -> tuple[pd.DataFrame, Frames]:
    """The valve in both, step by step from one to the other, and FEBio's closed frames."""
    rows, frames = [], {}
    for settings in FEBIO_RUNS:
        contact, orthotropic = settings.contact, settings.law == "orthotropic"
        if contact not in contacts:
            continue
        model = _own_model(contact)
        there = run_febio(
            valve_document(model, GENERIC, settings),
            folder / "valve.feb",
            time_limit_s=time_limit_s,
        )
        seen = model.observed(there.frames[-1])
        if there.converged:
            frames[contact, settings.law] = seen
        system, _ = _own_model("potential").tuned(GENERIC)
        assert system.contact is not None
        through = system.contact.intersects(system.contact.points(there.frames[-1]))
        chain = [("as it is", model, False)]
        if orthotropic:
            chain.append(("FEBio's law", model, True))
        chain.append(("FEBio's element", with_febios_element(model), False))
        if orthotropic:
            chain.append(("FEBio's law and element", with_febios_element(model), True))
        if contact == "potential":
            chain.append(("FEBio's gaps", _own_model(contact, alike=True), False))
        for words, own, law in chain:
            here, seconds = closed(own, law)
            distance = np.linalg.norm(own.observed(here.frames[-1]) - seen, axis=1)
            known = here.converged and there.converged
            rows.append(
                {
                    "contact": contact, "law": settings.law, "here": words,
                    "here_converged": here.converged, "febio_converged": there.converged,
                    "reason": there.reason, "reached_s": there.times[-1], "through": through,
                    "mean_mm": distance.mean() if known else np.nan,
                    "max_mm": distance.max() if known else np.nan,
                    "here_iterations": here.iterations, "here_s": seconds,
                    "febio_steps": there.steps, "febio_iterations": there.iterations,
                    "febio_s": there.seconds, "febio": there.version,
                }
            )  # fmt: skip
    return pd.DataFrame(rows), frames


def _own_model(contact: str, alike: bool = False) -> ClosureModel:
    """The valve here for what FEBio computes with a contact, with the same gaps if ``alike``."""
    if contact == "none":
        return valve_model(APART_MMHG)
    usual = valve_model(CLOSED_MMHG, ContactSettings())
    return valve_model(CLOSED_MMHG, contact_like_febio(usual)) if alike else usual


def moduli_table(frames: Frames) -> pd.DataFrame:
    """Moduli that are estimated here from FEBio's frames ``(n, 3)`` mm, by contact and law."""
    rows = []
    for (contact, law), seen in frames.items():
        chain = [("as it is", False)]
        if contact == "potential":
            chain.append(("FEBio's gaps", True))
        for words, alike in chain:
            model = replace(_own_model(contact, alike), continuation=True)
            result = _estimated(model, seen)
            estimated = result.estimate if result.estimate is not None else np.full(2, np.nan)
            error = 100 * (estimated / GENERIC - 1)
            distance = result.distance
            rows.append(
                {
                    "contact": contact, "law": law, "here": words, "converged": result.converged,
                    "reason": result.reason, "anterior_mpa": estimated[0],
                    "posterior_mpa": estimated[1], "anterior_percent": error[0],
                    "posterior_percent": error[1],
                    "residual_mm": np.nan if distance is None else float(np.nanmean(distance)),
                    "seconds": result.seconds,
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


def _estimated(model: ClosureModel, seen: FloatArray) -> StudyResult:
    prior = Gaussian.from_variance(GENERIC * [0.7, 1.4], (0.5 * GENERIC) ** 2)
    problem = Problem(
        NAMES, model, prior, IteratedFilter(1e-3), Log((True, True)), model.settings.tissue
    )
    observation = Observation((FRAMES[-1],), seen[None], np.array([STD_MM**2]))
    return estimate(problem, observation)


LAWS, BODIES, VALVES, MODULI = (f"febio_{n}.csv" for n in ("laws", "bodies", "valves", "moduli"))
NOT_REACHED = "–"


def markdown(folder: Path) -> str:
    """What the tables in the folder say."""
    lines = ["Written by `python -m experiments.febio`."]
    for file, words in ((LAWS, _laws), (BODIES, _bodies), (VALVES, _valves), (MODULI, _moduli)):
        if (folder / file).is_file():
            table = pd.read_csv(folder / file, keep_default_na=False, na_values=[""])
            lines += ["", *words(table)]
    lines += ["", *_differences()]
    return "\n".join(lines) + "\n"


def _laws(table: pd.DataFrame) -> list[str]:
    worst = float((table["here_orthotropic"] - table["orthotropic"]).abs().max())
    strains = ("linear", "here", "orthotropic", "neo_hookean")
    rows = [
        [row["reading"], row["pulled"], *(_number(100 * row[name], 2) for name in strains)]
        for row in table.to_dict("records")
    ]
    return [
        "**Laws.** Strain (%) of a cube of anterior tissue under a Cauchy stress of Young's",
        "modulus times the linear strain, in both readings of the Poisson ratio. FEBio's",
        f"`orthotropic elastic` as computed here is the same to {worst:.0e}.",
        "",
        *_rows(
            "reading, pulled, linear, here, FEBio's orthotropic elastic, "
            "FEBio's neo-Hookean transiso",
            rows,
        ),
    ]


def _bodies(table: pd.DataFrame) -> list[str]:
    rows = []
    for row in table.to_dict("records"):
        rest = row["by_rest_mm"]
        rows.append(
            [
                *(row[name] for name in ("problem", "element", "febio_element", "reading")),
                *(_number(row[name], 3) for name in ("here_mm", "febio_mm", "by_law_mm")),
                f"{rest:.0e}" if rest < 1e-6 else _number(rest, 3),
                *(_number(row[name], 2) for name in ("here_s", "febio_s")),
            ]
        )
    return [
        "**Elements.** A sheet of 20 x 20 x 1.3 mm under 16 kPa, clamped at its rim (6 x 6 cells),",
        "and a strip of 13 x 10 x 1.26 mm under 4.1 kPa, clamped at one end (6 x 4 cells): the",
        "largest displacement here and in FEBio; by how much FEBio's law (`orthotropic elastic`),",
        "used here, moves the body; and the largest distance of FEBio from that. Processor time of",
        f"six load steps. FEBio {table['febio'].iloc[0]}.",
        "",
        *_rows(
            "body, element, in FEBio, reading, here (mm), FEBio (mm), law (mm), the rest (mm), "
            "here (s), FEBio (s)",
            rows,
        ),
    ]


def _valves(table: pd.DataFrame) -> list[str]:
    rows = []
    for row in table.to_dict("records"):
        there = f"{row['febio_steps']}; {row['febio_iterations']}; {row['febio_s']:.0f}"
        if not row["febio_converged"]:
            there += f"; ended at {row['reached_s']:.3f} s: {row['reason']}"
        if str(row["through"]) == "True":
            there += "; leaflets pass through each other"
        rows.append(
            [
                row["contact"], row["law"], row["here"], _number(row["mean_mm"], 3),
                _number(row["max_mm"], 2), f"{row['here_iterations']}; {row['here_s']:.1f}", there,
            ]
        )  # fmt: skip
    return [
        f"**A valve.** The default valve on {CELLS[0]} x {CELLS[1]} cells (`hex18`; `hex27` in",
        "FEBio), generic moduli, reading A: the distance of the leaflets' vertices between FEBio",
        "and here, as it is here or with what of FEBio's is named. Without contact the pressure is",
        f"{APART_MMHG:g} mmHg, at which leaflets do not meet, otherwise {CLOSED_MMHG:g}.",
        "",
        *_rows(
            "FEBio's contact, its law, here, mean (mm), largest (mm), here: iterations; s, "
            "FEBio: steps; iterations; s",
            rows,
        ),
    ]


def _moduli(table: pd.DataFrame) -> list[str]:
    rows = [
        [
            row["contact"], row["law"], row["here"], _number(row["anterior_mpa"], 2),
            _number(row["anterior_percent"], 1), _number(row["posterior_mpa"], 2),
            _number(row["posterior_percent"], 1), _number(row["residual_mm"], 3),
        ]
        for row in table.to_dict("records")
    ]  # fmt: skip
    return [
        "**Moduli from FEBio's frames.** What the filter here estimates from FEBio's frame, in",
        "which E_f is 6.23 MPa (anterior) and 2.09 MPa (posterior), starting 30 % below and 40 %",
        f"above, with {STD_MM:g} mm SD assumed of a coordinate.",
        "",
        *_rows(
            "FEBio's contact, its law, here, E_f anterior (MPa), error (%), E_f posterior (MPa), "
            "error (%), residual (mm)",
            rows,
        ),
    ]


def _differences() -> list[str]:
    model = valve_model(CLOSED_MMHG, ContactSettings())
    settings = next(one for one in FEBIO_RUNS if one.contact == "potential")
    return [
        "**What is not the same** in the file of the closing valve, which says so at its head.",
        "",
        *_rows("what, here, in FEBio", differences(model, settings)),
    ]


def _rows(head: str, rows: Sequence[Sequence[str]]) -> list[str]:
    names = head.split(", ")
    lines = [names, ["---"] * len(names), *rows]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else NOT_REACHED


def main(arguments: Sequence[str] | None = None) -> int:
    """Write ``febio_*.csv`` and ``febio.md`` into the folder of the results.

    Arguments: the folder, and which of laws, bodies and the contacts (none, potential, sliding);
    by default all. Rows of other contacts stay as they are.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    folder = Path(given[0] if given else "results")
    parts = given[1:] or ["laws", "bodies", *CONTACTS]
    contacts = [part for part in parts if part in CONTACTS]
    with tempfile.TemporaryDirectory() as work:
        tables: dict[str, pd.DataFrame] = {}
        if "laws" in parts:
            tables[LAWS] = law_table(Path(work))
        if "bodies" in parts:
            tables[BODIES] = body_table(Path(work))
        if contacts:
            tables[VALVES], frames = valve_table(Path(work), contacts, TIME_LIMIT_S)
            tables[MODULI] = moduli_table(frames)
    for file, table in tables.items():
        if file in (VALVES, MODULI) and (folder / file).is_file():
            old = pd.read_csv(folder / file, keep_default_na=False, na_values=[""])
            table = pd.concat([old[~old["contact"].isin(contacts)], table])
        text = table.to_csv(index=False, float_format="%.9g")
        print(write_atomically(folder / file, text))
    print(write_atomically(folder / "febio.md", markdown(folder)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
