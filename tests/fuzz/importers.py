"""All public importers for files that a user brings, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from experiments.common.records.record import read_record, write_record
from mvest.cases.case import ErrorSamples
from mvest.cases.folder import read_case, write_error_samples
from mvest.errors import InputError
from mvest.estimation.prediction import Prediction
from mvest.exchange.abaqus.recording import read_recording
from mvest.exchange.external.contract import (
    RunRequest,
    read_answer,
    write_answer,
)
from mvest.exchange.importing.slicerheart import SlicerheartOptions, import_slicerheart
from mvest.exchange.markups import read_markups
from mvest.exchange.surfaces import read_regions
from mvest.exchange.volumes import read_labels, read_volume
from mvest.imaging.volume import Modality
from tests.cases import folders
from tests.exchange.surfaces import recorded
from tests.exchange.variants import LABELS, MARKUPS, SURFACES, VOLUMES
from tests.experiments.studies.made_up import made_up
from tests.fuzz.trial import Enter, Makers

REQUEST = RunRequest(
    parameters=[{"name": "E", "value": 1.5, "unit": "MPa"}, {"name": "nu, local", "value": 0.3}],
    points=2,
)


def of(*names: str) -> Makers:
    """Makers of variants by their names."""
    known = {str(variant): variant for variant in (*SURFACES, *VOLUMES, *LABELS, *MARKUPS)}

    def write(name: str, folder: Path) -> Path:
        known[name].write(folder / known[name].file)
        return folder / known[name].file

    return tuple(partial(write, name) for name in names)


def beside(maker: Callable[[Path], object], *names: str) -> Makers:
    """Makers of the same folder, of which each file is damaged in turn."""

    def write(name: str, folder: Path) -> Path:
        maker(folder)
        return folder / name

    return tuple(partial(write, name) for name in names)


def case(folder: Path) -> None:
    """A whole case: every reader of tables and arrays is behind it."""
    document = folders.plain_folder(folder)
    count = len(np.unique(folders.Template().valve(24, 8).surface.triangles))
    samples = np.random.default_rng(0).normal(0, 0.1, (4, 2, count, 3))
    errors = ErrorSamples(samples, samples[:, :, :2])
    write_error_samples(folder / "errors.npz", errors, ["open", "closed"])
    document["description"] = "a valve, made up"
    document["observation"] = {
        "std_mm": 0.7, "correlation_length_mm": 10, "error_samples": "errors.npz"
    }  # fmt: skip
    folders.save(folder, document)


def slicerheart(folder: Path) -> None:
    """One phase, whose annulus lies along the rim of the surface."""
    for side in ("anterior", "posterior"):
        (file,) = of("VTK: header of 3D Slicer, 4.2, text")
        file(folder).rename(folder / f"A_mitral_frame_1_MD_atrial_{side}_leaflet.vtk")
    points = [f"A,MD,1,mitral,-{5 * k},0.0,0.25,{'ALC' if k == 2 else ''}" for k in range(9)]
    head = ",".join(f"AnnulusContour{name}" for name in ("X", "Y", "Z", "Label"))
    text = "\n".join([f"Filename,Phase,FrameNumber,Valve,{head}", *points])
    (folder / "AnnulusContourPoints.csv").write_text(f"{text}\n")
    (folder / "ValveLandmarkPoints.csv").write_text(
        "Filename,Phase,Valve,FrameNumber,LandmarkLabel,LandmarkR,LandmarkA,LandmarkS\n"
        "A,MD,mitral,1,A,1.00,2.00,3.00\nA,MD,mitral,1,PMC,-1.50,2.00,3.00\n"
    )


def answer(folder: Path) -> None:
    y = np.arange(6) / 7
    write_answer(folder, Prediction(y, np.outer(y, [1.0, -1e-9])), REQUEST.names)


def surface(path: Path) -> object:
    labelled = path.suffix in (".vtp", ".vtu", ".vtk", ".glb")
    return read_regions(path, {1: "anterior", 2: "posterior"} if labelled else {0: "leaflets"})


def volume(path: Path) -> object:
    """Times that a format states without a unit are seconds."""
    unit = {"time_unit": "s"} if path.suffix in (".mha", ".mhd") else {}
    return read_volume(path, modality=Modality.ULTRASOUND, **unit)


def by_slicerheart(path: Path) -> object:
    """What is read is no valve, which is found out once all files are read."""
    options = SlicerheartOptions(tips=(0.0, 9.0, -20.0, 0.0, -9.0, -20.0))
    try:
        return import_slicerheart(path.parent, options)
    except InputError as fault:
        if "the annulus lies" not in str(fault):
            raise
        return fault


IMPORTERS: dict[str, tuple[Enter, Makers]] = {
    "case": (
        lambda path: read_case(path.parent),
        beside(case, "case.yaml", "chordae.csv", "errors.npz", "open.vtp"),
    ),
    "surface": (surface, of(
        "VTP: text, plain, UInt64, LittleEndian, Int64",
        "VTP: appended base64, LZMA, UInt32, LittleEndian, Int32",
        "VTU: text, LZMA, UInt64, LittleEndian, Int64",
        "VTU: base64, LZ4, UInt32, BigEndian, Int32",
        "VTK: 4.2, text, int32, scalars", "VTK: 5.1, binary, int64, a field",
        "VTK: 5.1, text, float64, a field", "VTK: quads, 4.2, binary",
        "STL: VTK text", "STL: VTK binary", "GLB: objects that nodes place",
        "PLY: VTK text", "PLY: VTK little endian", "OBJ: groups", "OBJ: texture and normals",
    )),
    "volume": (volume, of(
        "NRRD by pynrrd: .seq.nrrd, frames last, gzip, uint8", "NRRD: milliseconds",
        "NRRD by pynrrd: .nhdr, frames first, gzip, int16", "NRRD: slicerio",
        "MetaImage: .mha, 4D, uint8, compressed", "MetaImage: .mhd, 4D, int16, plain",
        "NIfTI: NIfTI-1, int16, .nii", "NIfTI: NIfTI-1, uint8, .nii.gz",
        "NIfTI: NIfTI-2, float32, .nii.gz",
        "Philips Cartesian DICOM: explicit, preamble", "Philips Cartesian DICOM: implicit, bare",
    )),
    "labels": (read_labels, of(
        "Slicer segmentation: one layer", "NRRD labels: int16", "NIfTI labels: uint8",
    )),
    "points": (read_markups, of(
        "Markups: 1.0.3, LPS", "Markups: ClosedCurve", "fcsv: 5.0, LPS"
    )),
    "recording": (lambda path: read_recording(path.parent, **recorded.NAMES), beside(
        lambda folder: recorded.write(folder, recorded.skirt()),
        "Skirt/Skirt.inp", "Skirt/Skirt_2.vtu",
    )),
    "slicerheart": (by_slicerheart, beside(
        slicerheart, "AnnulusContourPoints.csv", "ValveLandmarkPoints.csv"
    )),
    "record": (read_record, beside(
        lambda folder: write_record(folder / "result.json", made_up()), "result.json"
    )),
    "answer": (
        lambda path: read_answer(path.parent, REQUEST),
        beside(answer, "response.json", "observation.csv", "jacobian.csv"),
    ),
}  # fmt: skip
