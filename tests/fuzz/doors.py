"""All public doors for files that a user brings, by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.common.records.record import read_record, write_record
from experiments.runner.planning.plan import Plan
from mvest.cases.case import ErrorSamples
from mvest.cases.folder import read_case, write_error_samples
from mvest.estimation.prediction import Prediction
from mvest.exchange.exporting.febio import read_run
from mvest.exchange.external.contract import (
    RunRequest,
    read_answer,
    read_request,
    write_answer,
    write_request,
)
from mvest.exchange.febio.positions import read_positions
from mvest.exchange.markups import read_markups
from mvest.exchange.regions import read_regions
from mvest.exchange.volumes import read_labels, read_volume
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve
from mvest.imaging.volume import Modality
from mvest.problem.fields import read_case_fields
from mvest.provenance import write_json
from mvest.simulation.population import Population, load_population, save_population
from tests.cases import folders
from tests.exchange.variants import LABELS, MARKUPS, SURFACES, VOLUMES
from tests.experiments.studies.made_up import made_up, made_up_estimate
from tests.fuzz.trial import Door

__all__ = ["DOORS"]

Maker = Callable[[Path], Path]
REQUEST = RunRequest(("E", "nu, local"), ("MPa", ""), (1.5, 0.3), 2)


def of(*names: str) -> tuple[Maker, ...]:
    """Makers of variants by their names."""
    known = {str(variant): variant for variant in (*SURFACES, *VOLUMES, *LABELS, *MARKUPS)}

    def maker(name: str) -> Maker:
        def write(folder: Path) -> Path:
            known[name].write(folder / known[name].file)
            return folder / known[name].file

        return write

    return tuple(map(maker, names))


def beside(maker: Callable[[Path], object], *names: str) -> tuple[Maker, ...]:
    """Makers of the same folder, of which each file is damaged in turn."""

    def one(name: str) -> Maker:
        def write(folder: Path) -> Path:
            maker(folder)
            return folder / name

        return write

    return tuple(map(one, names))


def case(folder: Path) -> None:
    """A whole case: every reader of tables and arrays is behind it."""
    document = folders.plain_folder(folder)
    count = len(np.unique(folders.Template().valve(24, 8).surface.triangles))
    samples = np.random.default_rng(0).normal(0, 0.1, (4, 2, count, 3))
    errors = ErrorSamples(samples, samples[:, :, :2])
    write_error_samples(folder / "errors.npz", errors, ["open", "closed"])
    (folder / "pressure.csv").write_text("time,pressure\n0.0,0.0\n0.2,60\n0.35,120\n0.4,121.5\n")
    document |= {"pressure_curve": "pressure.csv", "description": "a valve, made up"}
    del document["frames"][1]["pressure"]
    document["observation"] = {
        "std_mm": 0.7, "correlation_length_mm": 10, "error_samples": "errors.npz"
    }  # fmt: skip
    folders.save(folder, document)


def population(folder: Path) -> None:
    layout = ValveLayout(8, 3)
    x = np.random.default_rng(0).normal(0, 10, (2, layout.size, 3))
    valve = MovingValve(
        "first", layout, np.array([0.0, 0.1]), x, x[:, :2], np.ones(layout.size),
        np.array([1.0]), np.ones(1), np.array([1]),
    )  # fmt: skip
    save_population(folder / "valves.npz", Population((valve,), {"leaks": 3}, "abc"))


def fields(folder: Path) -> None:
    valve = folders.Template().valve(24, 8)
    surface = valve.surface
    closed = folders.closing(surface.vertices)[None]
    np.savez_compressed(
        folder / "fields.npz", triangles=surface.triangles, region=surface.region,
        rest=surface.vertices, annulus=valve.annulus, free_edge=valve.free_edge,
        frames=np.array(["closed"]), seen=np.array([True]), tips=np.array([folders.TIPS] * 2),
        chord_tip=valve.chordae.tip, chord_insertion=np.zeros(len(valve.chordae), int),
        observed=closed, fitted=closed, distance_fitted=np.zeros((1, len(surface.vertices))),
    )  # fmt: skip


def record(folder: Path) -> None:
    write_record(folder / "result.json", made_up(estimates=(made_up_estimate(),)))


def plan(folder: Path) -> None:
    job = {
        "hash": "0" * 16, "folder": "job", "name": "k=1", "overrides": ["k=1"], "factors": {"k": 1},
        "row": "r", "repeats": 1, "config_hash": "0" * 64, "publish_as": None, "values": {},
        "without": [],
    }  # fmt: skip
    content = {
        "sweep": "a", "size": None, "sweep_id": "b", "created": "2020-01-01T00:00:00Z",
        "name": "a", "settings": {}, "publish": None, "directory": folder,
        "values": {"seed": 1, "force": False}, "jobs": [job],
    }  # fmt: skip
    write_json(folder / "plan.json", content)


def answer(folder: Path) -> None:
    y = np.arange(6) / 7
    write_answer(folder, Prediction(y, np.outer(y, [1.0, -1e-9])), REQUEST.names)


def positions(folder: Path) -> None:
    """As FEBio logs the positions of three nodes."""
    steps = [
        f"*Step  = {k}\n*Time  = {0.1 * k:.9g}\n*Data  = positions\n"
        + "".join(f"{n},{n - 1.5 * k},{0.25 * n},-3.5e-05\n" for n in (1, 2, 3))
        for k in range(3)
    ]
    (folder / "a.csv").write_text("".join(steps))


def estimated(folder: Path) -> None:
    """A run that estimated a case."""
    unknown = {"name": "E_f.anterior", "prior_mean": 6.23, "estimate": 7.5}
    tissue = {"anterior": {"ratio": 2.65, "nu": 0.488, "reading": "A"}}
    found = {"unknowns": [unknown], "settings": {"mechanics": {"tissue": tissue}}}
    write_json(folder / "result.json", {"findings": {"case": found}})
    write_json(folder / "config.json", {"case": "valve"})


def leaflets(path: Path) -> object:
    return read_regions(path, {1: "anterior", 2: "posterior"})


def one_region(path: Path) -> object:
    return read_regions(path, {0: "leaflets"})


def volume(path: Path) -> object:
    """Times that a format states without a unit are seconds."""
    unit = {"time_unit": "s"} if path.suffix in (".mha", ".mhd") else {}
    return read_volume(path, modality=Modality.ULTRASOUND, **unit)


DOORS: dict[str, Door] = {
    "case": Door(
        lambda path: read_case(path.parent),
        beside(case, "case.yaml", "chordae.csv", "pressure.csv", "errors.npz", "open.vtp"),
    ),
    "surface.vtp": Door(leaflets, of(
        "VTP: text, plain, UInt32, LittleEndian, Int64",
        "VTP: base64, zlib, UInt64, LittleEndian, Int64",
        "VTP: appended, LZMA, UInt32, BigEndian, Int32",
    )),
    "surface.vtu": Door(leaflets, of(
        "VTU: text, plain, UInt32, LittleEndian, Int64",
        "VTU: appended, zlib, UInt64, LittleEndian, Int32",
    )),
    "surface.vtk": Door(leaflets, of(
        "VTK: 4.2, text, int32, scalars", "VTK: 4.2, binary, uint8, a field",
        "VTK: 5.1, text, float64, a field", "VTK: 5.1, binary, int64, scalars",
        "VTK: triangle strips, 4.2, binary",
    )),
    "surface.stl": Door(one_region, of("STL: VTK text", "STL: VTK binary")),
    "surface.ply": Door(leaflets, of(
        "PLY: labels of points, ascii", "PLY: labels of faces, binary little endian"
    )),
    "surface.obj": Door(leaflets, of("OBJ: groups of an object", "OBJ: lines and comments")),
    "surface.glb": Door(leaflets, of("GLB: objects that nodes place")),
    "volume.nrrd": Door(volume, of(
        "NRRD by pynrrd: .seq.nrrd, frames first, raw, uint8", "NRRD: milliseconds",
        "NRRD by pynrrd: .nhdr, frames last, gzip, int16",
    )),
    "volume.metaimage": Door(volume, of(
        "MetaImage: .mha, 4D, int16, plain", "MetaImage: .mha, 4D, uint8, compressed",
        "MetaImage: .mhd, 4D, uint8, compressed",
    )),
    "volume.nifti": Door(volume, of(
        "NIfTI: NIfTI-1, int16, .nii", "NIfTI: NIfTI-1, uint8, .nii.gz",
        "NIfTI: NIfTI-2, float32, .nii",
    )),
    "volume.philips": Door(volume, of(
        "Philips Cartesian DICOM: explicit, preamble", "Philips Cartesian DICOM: implicit, bare"
    )),
    "labels": Door(read_labels, of(
        "Slicer segmentation: one layer", "NRRD labels: int16", "NIfTI labels: uint8",
    )),
    "markups": Door(read_markups, of("Markups: 1.0.3, LPS", "Markups: ClosedCurve")),
    "fcsv": Door(read_markups, of("fcsv: 4.10, 0", "fcsv: 5.0, LPS")),
    "population": Door(load_population, beside(population, "valves.npz")),
    "fields": Door(read_case_fields, beside(fields, "fields.npz")),
    "record": Door(read_record, beside(record, "result.json")),
    "plan": Door(lambda path: Plan.read(path.parent), beside(plan, "plan.json")),
    "answer": Door(
        lambda path: read_answer(path.parent, REQUEST),
        beside(answer, "response.json", "observation.csv", "jacobian.csv"),
    ),
    "request": Door(
        read_request, beside(lambda folder: write_request(folder, REQUEST), "request.json")
    ),
    "febio": Door(lambda path: read_positions(path, 3), beside(positions, "a.csv")),
    "estimates": Door(
        lambda path: read_run(path.parent), beside(estimated, "result.json", "config.json")
    ),
}  # fmt: skip
