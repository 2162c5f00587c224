"""The configured anatomy, the template's or that of a case folder, and the model of its closure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import numpy as np

from experiments.common.schema import NOT_HASHED, Values, build, contents
from mvest.closure.model import ClosureModel
from mvest.closure.robustness import REFERENCE, GateCase, vary
from mvest.errors import ConfigurationError
from mvest.mechanics.settings import MechanicsSettings
from mvest.provenance import config_hash
from mvest.quantities import Share
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Motion, Valve, band_grid
from mvest.valve.mesh.solid_mesh import SolidMesh
from mvest.valve.mesh.structured import structured_mesh

if TYPE_CHECKING:
    from mvest.valve.mesh.given import GivenValve

Anatomy: TypeAlias = "Template | GivenValve"

# Cells around and along the leaflets of the coarsest mesh on which a closure is followed.
COARSEST = (24, 3)
# Vertices of the surface that an unstructured mesh fills, whatever is observed.
UNSTRUCTURED_SURFACE = (112, 29)


@dataclass(frozen=True, kw_only=True)
class ValveSettings(TemplateParameters):
    """The template's parameters, or a case whose anatomy replaces the template."""

    folder: Annotated[str | None, NOT_HASHED] = None  # with case.yaml
    folder_sha256: str | None = "${valve_folder:}"  # of its files
    # Shortening of the anteroposterior diameter while the valve closes, for a case without a
    # closed frame; the papillary tips stay.
    annulus_contraction: Share = 0.0


def folder_hash(folder: str | None) -> str | None:
    """SHA-256 over the files of a case folder; None if there is no case."""
    if not folder:
        return None
    from mvest.cases.schema import files_of_case

    files = contents(files_of_case(Path(folder)))
    return config_hash(files) if files else None


def anatomy_of(config: Values) -> Anatomy:
    """The configured anatomy; raises an `MvestError` if it is inadmissible."""
    given = config["valve"]
    if given.get("folder") is None:
        return template_of(config)
    if not given["folder"]:
        raise ConfigurationError(
            "valve.folder is not given; expected valve.folder=FOLDER, a folder with case.yaml"
        )
    if build(TemplateParameters, given) != TemplateParameters():
        raise ConfigurationError(
            f"valve.folder = {given['folder']} and parameters of the template; expected one of them"
        )
    return _of_folder(given["folder"], given["folder_sha256"], given["annulus_contraction"])


def template_of(config: Values) -> Template:
    """The template; raises a `ConfigurationError` if the anatomy is that of a folder."""
    if config["valve"].get("folder") is not None:
        raise ConfigurationError(
            f"{config['name']} varies the template's parameters, which the anatomy of a folder has "
            "not; expected another valve than valve=folder"
        )
    return Template(build(TemplateParameters, config["valve"]))


@cache
def _of_folder(folder: str, _sha256: str | None, contraction: float) -> GivenValve:
    """The anatomy of a case; read once while its files do not change."""
    # The reader of cases is as large as everything that Table 1 needs of the valve.
    from mvest.cases.folder import read_case
    from mvest.scenarios.scenario import narrowed, plane_of
    from mvest.valve.mesh.given import GivenValve

    case = read_case(folder)
    valve = case.valve
    if not 0 <= contraction < 0.5:
        raise ConfigurationError(f"valve.annulus_contraction = {contraction}, expected [0, 0.5)")
    if contraction and case.closed is not None:
        raise ConfigurationError(
            f"valve.annulus_contraction = {contraction}, but {folder} has a closed frame, whose "
            "annulus is known; expected 0"
        )
    if contraction:
        ring = valve.motion.annulus[0]
        ends = [ring, narrowed(ring, plane_of(valve, ring), 1.0 - contraction)]
        valve = replace(valve, motion=replace(valve.motion, annulus=np.stack(ends)))
    return GivenValve(upright(valve))


def upright(valve: Valve) -> Valve:
    """A valve in the axes of the template: annulus about z = 0, first leaflet at y > 0, tips below.

    Figures and errors of an observation use these axes.
    """
    from mvest.scenarios.scenario import plane_of

    plane = plane_of(valve, valve.surface.vertices[valve.annulus])
    axes = np.stack([plane.lateral, plane.anterior, -plane.normal], axis=1)

    def turned(points: FloatArray) -> FloatArray:
        return np.asarray((points - plane.origin) @ axes)

    surface, motion = valve.surface, valve.motion
    fibre = np.asarray(surface.fibre @ axes)
    return replace(
        valve,
        surface=replace(surface, vertices=turned(surface.vertices), fibre=fibre),
        papillary_tips=turned(valve.papillary_tips),
        chordae=replace(
            valve.chordae,
            insertion=turned(valve.chordae.insertion),
            junction=turned(valve.chordae.junction),
        ),
        motion=Motion(motion.phase, turned(motion.annulus), turned(motion.papillary_tips)),
    )


def guide_of(model: ClosureModel, anatomy: Anatomy, mesh: Values) -> ClosureModel | None:
    """The model on a mesh of half as many cells each way, with its own guide; None at the coarsest.

    Guides have solid-shells, whatever the element and source of the model's mesh.
    """
    if mesh["columns"] <= COARSEST[0]:
        return None
    cells = COARSEST
    if mesh["columns"] > 2.5 * COARSEST[0]:
        half = _varied(mesh, 0.5, len(anatomy.sections))
        cells = (half["columns"], max(mesh["rows"] // 2, COARSEST[1]))
    coarse = replace(model, mesh=structured_mesh(anatomy, "hex18", *cells), guide=None)
    coarse.guide = guide_of(coarse, anatomy, {"columns": cells[0], "rows": cells[1]})
    return coarse


def build_mesh(anatomy: Anatomy, mesh: Values, element: str, store: Path) -> SolidMesh:
    """The mesh of an anatomy; an unstructured one is made once and cached in ``store``."""
    if mesh["source"] == "structured":
        cells = mesh["columns"], mesh["rows"], mesh["layers"]
        if isinstance(anatomy, Template):
            return structured_mesh(anatomy, element, *cells)
        return anatomy.layers(element, *cells)
    if element not in ("tet4", "tet10"):
        raise ConfigurationError(
            f"mechanics.element = {element!r}: an unstructured mesh needs tet10 or tet4"
        )
    from mvest.valve.mesh.given import tetrahedral_leaflets

    if not isinstance(anatomy, Template):
        surface, normals = anatomy.given.surface, None
    else:
        surface = anatomy.valve(*UNSTRUCTURED_SURFACE).surface
        normals = anatomy.normal(*band_grid(*UNSTRUCTURED_SURFACE)[:2])
    return tetrahedral_leaflets(surface, mesh["edge_length"], element, store, normals)


def closure_model(config: Values, variation: GateCase = REFERENCE) -> ClosureModel:
    """The configured model of the closure, with one variation of the gate.

    It closes the open valve anew for all parameters, unless the caller sets a continuation.
    """
    anatomy, settings = anatomy_of(config), mechanics_of(config)
    observed, points = config["observation"], config["mechanics"]["contact_points"]
    leaflets = len(anatomy.sections)
    mesh = dict(config["mesh"]) | _varied(config["mesh"], variation.mesh, leaflets)
    model = ClosureModel(
        anatomy.valve(observed["columns"], observed["rows"]),
        anatomy.valve(**_varied(points, variation.sampling, leaflets)),
        build_mesh(anatomy, mesh, config["mechanics"]["element"], mesh_store(config)),
        settings,
        tuple(config["parameters"]),
        dict(config["fixed"]),
    )
    if variation is REFERENCE:
        return model
    model.guide = guide_of(model, anatomy, mesh) if variation.guided else None
    return vary(model, replace(variation, mesh=1.0, sampling=1.0))


def mechanics_of(config: Values) -> MechanicsSettings:
    """The configured mechanics."""
    return build(MechanicsSettings, config["mechanics"])


def _varied(grid: Values, factor: float, leaflets: int) -> dict[str, int]:
    """Columns (a multiple of the leaflets) and rows multiplied by a factor."""
    columns, rows = grid["columns"], grid["rows"]
    if factor == 1.0:
        return {"columns": columns, "rows": rows}
    return {"columns": leaflets * round(columns * factor / leaflets), "rows": round(rows * factor)}


def mesh_store(config: Values) -> Path:
    """Folder of cached unstructured meshes."""
    return Path(config["paths"]["outputs"]) / "meshes"
