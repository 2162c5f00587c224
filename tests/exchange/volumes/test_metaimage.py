import re
from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from mvest.errors import InputError
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volumes import volumes as v

TIMES = np.array([0.5, 0.54, 0.58])


def write(
    path: Path, dtype: str = "uint8", direction: np.ndarray = v.ROTATION, compress: bool = False
) -> VolumeSequence:
    """Let SimpleITK write the volume, with 40 ms between frames."""
    stored = np.ascontiguousarray(np.moveaxis(v.frames(dtype), [1, 2, 3], [3, 2, 1]))
    image = SimpleITK.GetImageFromArray(stored, isVector=False)
    whole = np.eye(4)
    whole[:3, :3] = direction
    image.SetDirection(whole.ravel())
    image.SetSpacing([*v.SPACING, 0.04])
    image.SetOrigin([*v.ORIGIN, TIMES[0]])
    SimpleITK.WriteImage(image, str(path), compress)
    return VolumeSequence(v.frames(dtype), v.SPACING, direction, v.ORIGIN, TIMES)


def read(path: Path, time_unit: str | None = "s") -> VolumeSequence:
    return read_volume(path, modality=Modality.ULTRASOUND, time_unit=time_unit)


@pytest.mark.parametrize("name", ["a.mha", "a.mhd"])
def test_a_left_handed_volume_stays_left_handed(tmp_path: Path, name: str) -> None:
    expected = write(tmp_path / name, direction=v.MIRRORED, compress=True)
    v.assert_same(read(tmp_path / name), expected)


def test_the_unit_of_time_is_asked_for(tmp_path: Path) -> None:
    write(tmp_path / "a.mha")
    with pytest.raises(InputError, match=r"a\.mha: ElementSpacing: times without a unit"):
        read(tmp_path / "a.mha", time_unit=None)


BAD = {
    "no spacing": (r"ElementSpacing = .*\n", "", "ElementSpacing"),
    "no direction": (r"TransformMatrix = .*\n", "", "TransformMatrix"),
    "no origin": (r"Offset = .*\n", "", "Offset"),
    "a spacing missing": (r"(ElementSpacing = \S+) .*", r"\1", "ElementSpacing"),
    "negative spacing": (r"ElementSpacing = ", "ElementSpacing = -", "ElementSpacing"),
    "absurd spacing": (r"ElementSpacing = \S+", "ElementSpacing = 11", "ElementSpacing"),
    "absurd extent": (r"ElementSpacing = \S+", "ElementSpacing = 0.5", "ElementSpacing"),
    "axes not at right angles": (
        r"TransformMatrix = \S+",
        "TransformMatrix = 2",
        "TransformMatrix",
    ),
    "space and time mixed": (r"(TransformMatrix = .*) 0 1\n", r"\1 0.5 1\n", "TransformMatrix"),
    "two axes": (r"NDims = 4", "NDims = 2", "NDims"),
    "five axes": (r"NDims = 4", "NDims = 5", "NDims"),
    "few voxels": (r"DimSize = \d+", "DimSize = 10", "DimSize"),
    "more voxels than bytes": (r"DimSize = 20", "DimSize = 21", "ElementDataFile"),
    "fewer voxels than bytes": (r"DimSize = 20", "DimSize = 19", "ElementDataFile"),
    "colour": (r"ElementType", "ElementNumberOfChannels = 3\nElementType", "ElementNumberOf"),
    "numbers as text": (r"BinaryData = True", "BinaryData = False", "damaged"),
    "offset of data": (r"ElementType", "HeaderSize = 12\nElementType", "HeaderSize"),
    "data elsewhere": (r"LOCAL", "../a.raw", "ElementDataFile"),
    "data at an absolute path": (r"LOCAL", "/etc/hostname", "ElementDataFile"),
    "data in several files": (r"LOCAL", "LIST", "ElementDataFile"),
    "stated twice": (r"Offset = ", "Offset = 1 2 3 4\nOffset = ", "Offset"),
    "1 s from frame to frame": (r"(ElementSpacing = .*) \S+\n", r"\1 1\n", "ElementSpacing"),
    "no field": (r"Offset = ", "Offset ", "Offset"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    pattern, replacement, field = BAD[what]
    path = tmp_path / "bad.mha"
    write(path)
    head, mark, voxels = path.read_bytes().partition(b"LOCAL\n")
    text, count = re.subn(pattern, replacement, (head + mark).decode(), count=1)
    assert count == 1
    path.write_bytes(text.encode() + voxels)
    v.assert_refused(path, field, modality=Modality.ULTRASOUND, time_unit="s")
