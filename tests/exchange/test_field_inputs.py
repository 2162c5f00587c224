"""Files of kinds that people have: read as the reference library reads them.

The files lie beside the checkout and are no part of it. Others of each kind are among those that
other programs' libraries make (`tests.exchange.variants`).
"""

from collections.abc import Callable
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest

from experiments import cli
from mvest.cases.case import Role
from mvest.cases.folder import read_case
from mvest.exchange.abaqus.deck import Deck
from mvest.exchange.volumes import read_labels, read_volume
from mvest.imaging.volume import Modality
from tests.places import field_input

TIPS = "tips=[-16,-0.24,-25,16,-0.24,-25]"


def test_a_recording_lies_where_slicerheart_puts_it() -> None:
    dicom = read_volume(field_input("rec.dcm"))
    saved = read_volume(field_input("rec.seq.nrrd"), modality=Modality.ULTRASOUND)
    np.testing.assert_allclose(dicom.times, saved.times, atol=1e-9)
    here_and_there = np.array([[0.0, 0, 0], [5, 7, 9], [19, 23, 27]])
    for index in here_and_there:
        np.testing.assert_allclose(dicom.world(index), saved.world(index), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(dicom.frames, saved.frames)


def test_a_deck_has_a_heading_in_latin_1() -> None:
    assert list(Deck(field_input("latin1.inp")).sets["ELSET"]) == ["ALL"]


def by_nibabel(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Labels ``(F, I, J, K)`` and the matrix to LPS."""
    image = nibabel.load(path)
    values = np.asarray(image.dataobj).reshape(*image.shape[:3], -1)
    return np.moveaxis(values, 3, 0), np.diag([-1, -1, 1, 1]) @ image.affine


def by_pynrrd(path: Path) -> tuple[np.ndarray, np.ndarray]:
    values, header = nrrd.read(str(path))
    assert header["space"] == "left-posterior-superior"
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = header["space directions"][-3:].T, header["space origin"]
    return values.reshape(-1, *values.shape[-3:]), matrix


MAPS = (
    *("overlapping_empty_layer.seg.nrrd", "sparse4d_ms.nii.gz", "full4d_default_times.nii.gz"),
    *("mvseg_posterior1_anterior2.nii.gz", "child_cropped.nii.gz"),
    "scene_mitral_frame_3_MD_anterior_leaflet.nrrd",
)


@pytest.mark.parametrize("name", MAPS)
def test_labels_are_as_nibabel_and_pynrrd_read_them(name: str) -> None:
    read: Callable[[Path], tuple[np.ndarray, np.ndarray]]
    read = by_nibabel if name.endswith(".gz") else by_pynrrd
    values, matrix = read(field_input(name))
    found = read_labels(field_input(name))
    np.testing.assert_array_equal(found.frames, values)
    np.testing.assert_allclose(found.direction * found.spacing, matrix[:3, :3], atol=1e-6)
    np.testing.assert_allclose(found.origin, matrix[:3, 3], atol=1e-6)


@pytest.mark.slow
def test_leaflets_are_those_that_were_drawn(tmp_path: Path) -> None:
    name = "overlapping_empty_layer.seg.nrrd"
    folder = tmp_path / "case"
    assert cli.main(["import", "leaflets", str(field_input(name)), str(folder), TIPS]) == 0
    case = read_case(folder)
    values, matrix = by_pynrrd(field_input(name))
    layers = {"anterior": values[0], "posterior": values[1]}
    drawn = {k: np.argwhere(x == 1) @ matrix[:3, :3].T + matrix[:3, 3] for k, x in layers.items()}
    frame = case.frame(Role.REFERENCE)
    centres = frame.vertices[frame.triangles].mean(axis=1)
    for number, leaflet in enumerate(case.surface.region_names):
        own = centres[frame.region == number].mean(axis=0)
        away = {other: np.linalg.norm(own - x.mean(axis=0)) for other, x in drawn.items()}
        assert min(away, key=away.__getitem__) == leaflet, away
