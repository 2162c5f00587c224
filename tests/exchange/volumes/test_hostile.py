"""Damaged and hostile files: an `InputError` in one line, or a sound volume."""

import gzip
import zlib
from collections.abc import Callable
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest

from mvest.errors import InputError
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality, VolumeSequence
from tests.exchange.volumes import test_metaimage, test_nifti, test_philips
from tests.exchange.volumes import volumes as v


def nifti(path: Path) -> int:
    nibabel.save(test_nifti.image(v.frames()), path)
    return 352


def metaimage(path: Path) -> int:
    test_metaimage.write(path, compress="zip" in path.name)
    return path.read_bytes().index(b"LOCAL\n") + 6


def nrrd(path: Path) -> int:
    fields = v.nrrd_fields() | {"encoding": "gzip" if "zip" in path.name else "raw"}
    v.write_nrrd(path, fields)
    return len(v.nrrd_text(fields))


def philips(path: Path) -> int:
    test_philips.save(path, test_philips.dataset(), preamble=True)
    return path.stat().st_size - int(np.prod(v.SHAPE))


MAKERS: dict[str, Callable[[Path], int]] = {
    "a.nrrd": nrrd,
    "zip.nrrd": nrrd,
    "a.mha": metaimage,
    "zip.mha": metaimage,
    "a.nii": nifti,
    "a.nii.gz": nifti,
    "a.dcm": philips,
}
"""Each writes a file and returns the length of its header."""


def attempt(path: Path) -> tuple[VolumeSequence | None, str]:
    """The volume, or why it was refused: in one line that names the file."""
    unit = "s" if path.suffix == ".mha" else None  # MetaImage knows no unit of time
    try:
        return read_volume(path, modality=Modality.ULTRASOUND, time_unit=unit), ""
    except InputError as error:
        message = str(error)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 900
    return None, message


@pytest.mark.parametrize("name", [name for name in MAKERS if name[:2] == "a." and name[-1] != "z"])
def test_random_damage_of_a_header(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    header = MAKERS[name](path)
    whole = path.read_bytes()
    draw = np.random.default_rng(11)
    refused = 0
    for _ in range(40):
        content = bytearray(whole)
        for place in draw.integers(0, header, size=3):
            content[place] = draw.integers(0, 256)
        path.write_bytes(content)
        found, _message = attempt(path)
        refused += found is None
        if found is not None:
            assert found.frames.shape[0] == len(found.times)
            assert np.isfinite(found.world(np.zeros(3))).all()
            np.testing.assert_allclose(found.direction.T @ found.direction, np.eye(3), atol=1e-12)
    assert refused > 4


@pytest.mark.parametrize("name", MAKERS)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    header = min(MAKERS[name](path), path.stat().st_size)
    whole = path.read_bytes()
    # pynrrd reads a file whose last bytes, the end of its gzip, are missing: all voxels are there.
    places = [*(header * n // 4 for n in range(4)), *(len(whole) * n // 4 for n in range(1, 4))]
    for end in [*places, len(whole) - 100]:
        path.write_bytes(whole[:end])
        assert attempt(path)[0] is None


@pytest.mark.parametrize("name", ["zip.nrrd", "zip.mha", "a.nii.gz"])
def test_damaged_compression_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    MAKERS[name](path)
    content = bytearray(path.read_bytes())
    content[-2000] ^= 0xFF
    path.write_bytes(content)
    assert attempt(path)[0] is None


def huge(name: str, path: Path) -> None:
    """A header that declares 9000 x 9000 x 9000 voxels, before the voxels of a small volume."""
    MAKERS[name](path)
    content = path.read_bytes()
    if name == "a.nrrd":
        content = content.replace(b"sizes: 3 20 24 28", b"sizes: 3 9000 9000 9000")
    elif name == "a.mha":
        content = content.replace(b"DimSize = 20 24 28", b"DimSize = 9000 9000 9000")
    elif name == "a.nii":
        header = nibabel.Nifti1Header(content[:348])
        header.set_data_shape((9000, 9000, 9000, 3))
        content = header.binaryblock + content[348:]
    else:
        data = pydicom.dcmread(path)
        data.Rows = data.Columns = data[0x3001, 0x1001].value = 9000
        return pydicom.dcmwrite(path, data)
    path.write_bytes(content)
    return None


@pytest.mark.parametrize("name", ["a.nrrd", "a.mha", "a.nii", "a.dcm"])
def test_a_header_of_more_than_can_be_held(tmp_path: Path, name: str) -> None:
    huge(name, tmp_path / name)
    assert "expected at most 4 GiB" in attempt(tmp_path / name)[1]


def bomb(name: str, path: Path) -> None:
    """Data that inflate to 3 GiB, where the header declares 40 kB."""
    packer = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS | (0 if name == "zip.mha" else 16))
    # After a full flush the same bytes are packed in the same way again.
    first, again = (
        packer.compress(bytes(2**24)) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2)
    )
    packed = first + 191 * again
    MAKERS[name](path)
    if name == "a.nii.gz":
        # Members one after the other are one stream of gzip.
        path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes())) + packed)
    else:
        path.write_bytes(path.read_bytes()[: MAKERS[name](path)] + packed)


@pytest.mark.parametrize("name", ["zip.nrrd", "zip.mha", "a.nii.gz"])
def test_a_bomb_costs_no_more_than_the_limit(tmp_path: Path, name: str) -> None:
    """The limit is 1 GiB beside three times what the header declares."""
    bomb(name, tmp_path / name)
    assert "needs more than 1 GiB" in attempt(tmp_path / name)[1]
