"""Files of kinds that people have: read as the reference library reads them.

The files lie beside the checkout and are no part of it. Others of each kind are among those that
other programs' libraries make (`tests.exchange.variants`).
"""

from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest

from experiments import cli
from mvest.cases.case import Role
from mvest.cases.folder import read_case
from mvest.exchange.abaqus.deck import Deck
from mvest.exchange.volumes import read_labels
from tests.places import field_input

TIPS = "tips=[-16,-0.24,-25,16,-0.24,-25]"


def test_a_deck_has_a_heading_in_latin_1() -> None:
    assert list(Deck(field_input("latin1.inp")).sets["ELSET"]) == ["ALL"]


@pytest.mark.parametrize(
    "name", ["sparse4d_ms.nii.gz", "mvseg_posterior1_anterior2.nii.gz", "child_cropped.nii.gz"]
)
def test_labels_are_as_nibabel_reads_them(name: str) -> None:
    image = nibabel.load(field_input(name))
    values = np.asarray(image.dataobj).reshape(*image.shape[:3], -1)
    matrix = np.diag([-1, -1, 1, 1]) @ image.affine
    found = read_labels(field_input(name))
    np.testing.assert_array_equal(found.frames, np.moveaxis(values, 3, 0))
    np.testing.assert_allclose(found.direction * found.spacing, matrix[:3, :3], atol=1e-6)
    np.testing.assert_allclose(found.origin, matrix[:3, 3], atol=1e-6)


@pytest.mark.slow
def test_leaflets_are_those_that_were_drawn(tmp_path: Path) -> None:
    name = "overlapping_empty_layer.seg.nrrd"
    folder = tmp_path / "case"
    assert cli.main(["import", "leaflets", str(field_input(name)), str(folder), TIPS]) == 0
    case = read_case(folder)
    values, header = nrrd.read(str(field_input(name)))
    assert header["space"] == "left-posterior-superior"
    steps, origin = header["space directions"][-3:], header["space origin"]
    layers = {"anterior": values[0], "posterior": values[1]}
    drawn = {k: np.argwhere(x == 1) @ steps + origin for k, x in layers.items()}
    frame = case.frame(Role.REFERENCE)
    centres = frame.vertices[frame.triangles].mean(axis=1)
    for number, leaflet in enumerate(case.surface.region_names):
        own = centres[frame.region == number].mean(axis=0)
        away = {other: np.linalg.norm(own - x.mean(axis=0)) for other, x in drawn.items()}
        assert min(away, key=away.__getitem__) == leaflet, away
