"""Label maps and segmentations, which are judged by other rules than images."""

from pathlib import Path
from typing import Any

import nrrd
import numpy as np
import pytest

from mvest.errors import InputError
from mvest.exchange._images import Segment
from mvest.exchange.volumes import LabelMap, read_labels, read_volume
from mvest.imaging.volume import Modality
from tests.exchange.volume_variants import philips
from tests.exchange.volumes import volumes as v

PLACE = {
    "space": "left-posterior-superior",
    "space directions": (v.MIRRORED * v.SPACING).T,
    "space origin": v.ORIGIN,
}


def labels(dtype: str = "uint8") -> np.ndarray:
    """Three frames, the second one empty."""
    result = np.zeros(v.SHAPE, dtype)
    result[0, 3:6, 4:9, 20] = 1
    result[2, 10, 4, 5:9] = 2
    return result


def write_layers(path: Path, voxels: np.ndarray, **keys: str) -> LabelMap:
    """A segmentation of overlapping segments as 3D Slicer writes it, read."""
    header: dict[str, Any] = PLACE | {
        "space directions": np.vstack([np.full(3, np.nan), PLACE["space directions"]]),
        "kinds": ["list", "domain", "domain", "domain"],
        "Segmentation_MasterRepresentation": "Binary labelmap",
        **keys,
    }
    nrrd.write(str(path), voxels, header)
    return read_labels(path)


def test_layers_of_a_segmentation(tmp_path: Path) -> None:
    found = write_layers(
        tmp_path / "a.seg.nrrd",
        labels(),
        Segment0_Tags="TerminologyEntry:x~y",
        Segment10_ID="Segment_7",
        Segment10_LabelValue="2",
        Segment10_Layer="2",
        Segment0_Name="Anterior Leaflet",
        Segment0_LabelValue="1",
        Segment0_Layer="0",
    )
    assert found.is_layers
    first = Segment("Anterior Leaflet", "TerminologyEntry:x~y", 1, 0)
    assert found.segments == (first, Segment("Segment_7", "", 2, 2))


@pytest.mark.parametrize(
    ("key", "value"), [("Segment0_Layer", "3"), ("Segment0_LabelValue", "1.5")]
)
def test_a_segment_that_cannot_be(tmp_path: Path, key: str, value: str) -> None:
    keys = {"Segment0_LabelValue": "1", "Segment0_Layer": "0", key: value}
    with pytest.raises(InputError, match=rf"a\.seg\.nrrd: {key}: '{value}', expected a number"):
        write_layers(tmp_path / "a.seg.nrrd", labels(), **keys)


def test_a_small_box(tmp_path: Path) -> None:
    path = tmp_path / "a.nrrd"
    voxels = np.ones((8, 40, 30), np.uint8)
    header = PLACE | {"space directions": 0.45 * np.eye(3)}
    nrrd.write(str(path), voxels, header)
    np.testing.assert_array_equal(read_labels(path).frames[0], voxels)
    with pytest.raises(InputError, match=r"sizes: 1 x 8 x 40 x 30 .*at least 16"):
        read_volume(path, modality=Modality.CT)


def test_what_is_no_label_map(tmp_path: Path) -> None:
    path = tmp_path / "a.nrrd"
    for voxels, words in (
        (np.zeros(v.SHAPE[1:], np.uint8), "data: all voxels are 0, expected labels"),
        (np.full(v.SHAPE[1:], 1.5), "expected whole numbers"),
    ):
        nrrd.write(str(path), voxels, PLACE)
        with pytest.raises(InputError, match=rf"a\.nrrd: .*{words}"):
            read_labels(path)
    del (unplaced := dict(PLACE))["space directions"]
    nrrd.write(str(path), labels()[0], unplaced)
    with pytest.raises(InputError, match=r"a\.nrrd: space directions: not stated"):
        read_labels(path)
    with pytest.raises(InputError, match=r"modality: ultrasound, expected a label map"):
        read_labels(philips(tmp_path / "a.dcm"))
