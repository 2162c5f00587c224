"""Headers with random bytes changed: an `InputError` in one line, or a sound volume."""

from collections.abc import Callable
from pathlib import Path

import nibabel
import numpy as np
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
    test_metaimage.write(path)
    return path.read_bytes().index(b"LOCAL\n") + 6


def nrrd(path: Path) -> int:
    v.write_nrrd(path, v.nrrd_fields())
    return len(v.nrrd_text(v.nrrd_fields()))


def philips(path: Path) -> int:
    test_philips.save(path, test_philips.dataset(), preamble=True)
    return path.stat().st_size - int(np.prod(v.SHAPE))


MAKERS: list[tuple[str, Callable[[Path], int]]] = [
    ("a.nrrd", nrrd),
    ("a.mha", metaimage),
    ("a.nii", nifti),
    ("a.dcm", philips),
]
TRIALS = 60


@pytest.mark.parametrize(("name", "make"), MAKERS, ids=[name for name, _ in MAKERS])
def test_random_damage(tmp_path: Path, name: str, make: Callable[[Path], int]) -> None:
    path = tmp_path / name
    header = make(path)
    whole = path.read_bytes()
    draw = np.random.default_rng(11)
    refused = 0
    for _ in range(TRIALS):
        content = bytearray(whole)
        for place in draw.integers(0, header, size=3):
            content[place] = draw.integers(0, 256)
        path.write_bytes(content)
        found, message = attempt(path)
        assert "\n" not in message
        assert len(message) < 900
        if found is None:
            refused += 1
            continue
        assert found.frames.shape[0] == len(found.times)
        assert np.isfinite(found.world(np.zeros(3))).all()
        gram = found.direction.T @ found.direction
        np.testing.assert_allclose(gram, np.eye(3), atol=1e-12)
    assert refused > TRIALS / 10


def attempt(path: Path) -> tuple[VolumeSequence | None, str]:
    """The volume, or why it was refused."""
    # MetaImage knows no unit of time.
    unit = "s" if path.suffix == ".mha" else None
    try:
        return read_volume(path, modality=Modality.ULTRASOUND, time_unit=unit), ""
    except InputError as error:
        return None, str(error)
