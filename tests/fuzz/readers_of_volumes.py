"""Readers of volumes over time, and of points beside them; the examples come from other code."""

import gzip
from pathlib import Path

import nibabel
import numpy as np
import SimpleITK

from mvest.errors import GeometryError
from mvest.exchange.importing.leaflets import LeafletsOptions, import_leaflets
from mvest.exchange.markups import read_fcsv, read_markups
from mvest.exchange.volumes import read_labels, read_volume
from mvest.imaging.volume import Modality
from tests.exchange.volumes import test_nifti, test_philips
from tests.exchange.volumes import volumes as v
from tests.fuzz.trial import Reader

__all__ = ["READERS"]

SHAPE = (2, 16, 17, 21)


def any_volume(path: Path) -> object:
    return read_volume(path, modality=Modality.ULTRASOUND)


def any_volume_in_seconds(path: Path) -> object:
    """MetaImage knows no unit of time."""
    return read_volume(path, modality=Modality.ULTRASOUND, time_unit="s")


def nrrd_fields(axis: int) -> dict[str, str]:
    sizes = list(SHAPE[1:])
    sizes.insert(axis, SHAPE[0])
    return v.nrrd_fields(axis) | {
        "sizes": " ".join(map(str, sizes)),
        f"axis {axis} index values=": "0 0.04",
    }


def nrrd_voxels(axis: int) -> bytes:
    return np.moveaxis(v.frames(shape=SHAPE), 0, axis).tobytes(order="F")


def nrrd(folder: Path) -> Path:
    return v.write_nrrd(folder / "a.seq.nrrd", nrrd_fields(0), nrrd_voxels(0))


def nrrd_gzip(folder: Path) -> Path:
    fields = nrrd_fields(3) | {"encoding": "gzip"}
    return v.write_nrrd(folder / "a.nrrd", fields, nrrd_voxels(3))


def nrrd_detached(folder: Path) -> Path:
    fields = nrrd_fields(0) | {"data file": "a.raw", "byte skip": "3", "line skip": "1"}
    (folder / "a.raw").write_bytes(b"a line\nabc" + nrrd_voxels(0))
    (folder / "a.nhdr").write_bytes(v.nrrd_text(fields))
    return folder / "a.nhdr"


def nrrd_data_file(folder: Path) -> Path:
    """The compressed voxels beside a header."""
    fields = nrrd_fields(0) | {"data file": "a.raw.gz", "encoding": "gzip"}
    (folder / "a.nhdr").write_bytes(v.nrrd_text(fields))
    (folder / "a.raw.gz").write_bytes(gzip.compress(nrrd_voxels(0)))
    return folder / "a.raw.gz"


def metaimage(path: Path, compress: bool, dtype: str = "uint8") -> Path:
    stored = np.ascontiguousarray(np.moveaxis(v.frames(dtype, SHAPE), [1, 2, 3], [3, 2, 1]))
    image = SimpleITK.GetImageFromArray(stored, isVector=False)
    image.SetSpacing([*v.SPACING, 0.04])
    SimpleITK.WriteImage(image, str(path), compress)
    return path


def nifti(kind: type = nibabel.Nifti1Image) -> object:
    return test_nifti.image(v.frames("int16", SHAPE), kind)


def saved(image: object, path: Path) -> Path:
    nibabel.save(image, path)
    return path


def philips(path: Path, explicit: bool, preamble: bool) -> Path:
    return test_philips.save(path, test_philips.dataset(SHAPE), explicit, preamble)


def fcsv(folder: Path) -> Path:
    (folder / "a.fcsv").write_text(
        "# Markups fiducial file version = 5.0\n# CoordinateSystem = LPS\n"
        "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
        '1,1.5,-2.5e1,30,0,0,0,1,1,1,0,ALC,,\n2,3,4,5,0,0,0,1,1,1,0,"P, M",,\n'
    )
    return folder / "a.fcsv"


def markups(folder: Path) -> Path:
    """As 3D Slicer's own example has it."""
    point = (
        '{"id": "%d", "label": "F-%d", "position": [%r, -2.5e1, 3], "positionStatus": "defined"}'
    )
    points = ", ".join(point % (n, n, n / 7) for n in range(4))
    path = folder / "a.mrk.json"
    path.write_text(
        '{"@schema": "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/'
        'Markups/Resources/Schema/markups-schema-v1.0.3.json#", "markups": [{"type": "Fiducial", '
        '"name": "tips", "coordinateSystem": "LPS", "coordinateUnits": "mm", '
        f'"controlPoints": [{points}]}}, {{"type": "ClosedCurve", "coordinateSystem": "RAS", '
        f'"controlPoints": [{points}]}}]}}'
    )
    return path


def seg_nrrd(folder: Path) -> Path:
    """Two leaflets as 3D Slicer names its segments."""
    fields = nrrd_fields(0) | {
        "Segment0_Name=": "mitral_anterior_leaflet",
        "Segment0_LabelValue=": "1",
        "Segment0_Layer=": "0",
        "Segment0_Tags=": "TerminologyEntry:a~sh-leaflet-mv-a~b|",
        "Segment1_Name=": "mitral_posterior_leaflet",
        "Segment1_LabelValue=": "2",
    }
    return v.write_nrrd(folder / "a.seg.nrrd", fields, nrrd_voxels(0))


def segmentation(path: Path) -> object:
    return read_labels(path)


def label_map(path: Path) -> object:
    """Labels of leaflets: none of the made-up voxels is a valve, so that a map is refused."""
    try:
        return import_leaflets(path, LeafletsOptions(tips=(0.0, 9.0, -20.0, 0.0, -9.0, -20.0)))
    except GeometryError as fault:
        return fault


READERS = (
    Reader("volume.segmentation", segmentation, (seg_nrrd,)),
    Reader("import.labels", label_map, (seg_nrrd,)),
    Reader("volume.nrrd", any_volume, (nrrd, nrrd_gzip, nrrd_detached)),
    Reader("volume.nrrd-data", lambda path: any_volume(path.parent / "a.nhdr"), (nrrd_data_file,)),
    Reader(
        "volume.metaimage",
        any_volume_in_seconds,
        (
            lambda folder: metaimage(folder / "a.mha", False, "int16"),
            lambda folder: metaimage(folder / "a.mha", True),
            lambda folder: metaimage(folder / "a.mhd", True),
        ),
    ),
    Reader(
        "volume.nifti",
        any_volume,
        (
            lambda folder: saved(nifti(), folder / "a.nii"),
            lambda folder: saved(nifti(), folder / "a.nii.gz"),
            lambda folder: saved(nifti(nibabel.Nifti2Image), folder / "a.nii"),
        ),
    ),
    Reader(
        "volume.philips",
        any_volume,
        (
            lambda folder: philips(folder / "a.dcm", True, True),
            lambda folder: philips(folder / "a.dcm", False, False),
        ),
    ),
    Reader("fcsv", read_fcsv, (fcsv,)),
    Reader("markups", read_markups, (markups,)),
)
