"""A small volume over time, and files that hold it, written without the code under test."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import VolumeSequence
from tests.exchange.volume_variants import DIRECTION as ROTATION
from tests.exchange.volume_variants import MIRRORED, ORIGIN, SHAPE, SPACING, frames

__all__ = ["MIRRORED", "ORIGIN", "ROTATION", "SHAPE", "SPACING", "frames"]

TIMES = np.array([0.0, 0.03, 0.08])


def sequence(dtype: str = "uint8", direction: NDArray[np.float64] = ROTATION) -> VolumeSequence:
    return VolumeSequence(frames(dtype), SPACING, direction, ORIGIN, TIMES, source="made up")


def vector(values: NDArray[np.float64]) -> str:
    return "(" + ",".join(repr(float(value)) for value in values) + ")"


def nrrd_fields(axis: int = 0, direction: NDArray[np.float64] = ROTATION) -> dict[str, str]:
    """Header of `frames` with the axis of frames at `axis`; keys end in '='."""
    order = [1, 2, 3]
    order.insert(axis, 0)
    steps = (direction * SPACING).T
    words = ["none" if a == 0 else vector(steps[a - 1]) for a in order]
    return {
        "type": "uint8",
        "dimension": "4",
        "space": "left-posterior-superior",
        "sizes": " ".join(str(SHAPE[a]) for a in order),
        "space directions": " ".join(words),
        "kinds": " ".join("list" if a == 0 else "domain" for a in order),
        "labels": " ".join('"time"' if a == 0 else '""' for a in order),
        "units": " ".join('"s"' if a == 0 else '""' for a in order),
        "endian": "little",
        "encoding": "raw",
        "space origin": vector(ORIGIN),
        f"axis {axis} index type=": "numeric",
        f"axis {axis} index values=": " ".join(repr(float(t)) for t in TIMES),
    }


def nrrd_text(fields: dict[str, str], extra: str = "") -> bytes:
    lines = [
        f"{name}:={value}".replace("=:=", ":=") if name.endswith("=") else f"{name}: {value}"
        for name, value in fields.items()
    ]
    return ("\n".join(["NRRD0005", "# by hand", *lines]) + "\n" + extra + "\n").encode()


def nrrd_voxels(axis: int = 0, dtype: str = "uint8") -> bytes:
    """First axis fastest, the frames along `axis`."""
    return np.moveaxis(frames(dtype), 0, axis).tobytes(order="F")


def write_nrrd(
    path: Path, fields: dict[str, str], voxels: bytes | None = None, extra: str = ""
) -> Path:
    content = nrrd_voxels() if voxels is None else voxels
    if fields.get("encoding") == "gzip":
        content = gzip.compress(content, 1)
    path.write_bytes(nrrd_text(fields, extra) + content)
    return path


def assert_same(found: VolumeSequence, expected: VolumeSequence) -> None:
    """Same voxels at the same places and times."""
    np.testing.assert_array_equal(found.frames, expected.frames)
    np.testing.assert_allclose(found.times, expected.times, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.spacing, expected.spacing, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.direction, expected.direction, rtol=0, atol=1e-6)
    corner = np.array(found.frames.shape[1:]) - 1.0
    np.testing.assert_allclose(found.world(corner), expected.world(corner), rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.index(found.world(corner)), corner, rtol=0, atol=1e-9)


def assert_refused(path: Path, field: str, expected: str = "", **given: Any) -> None:
    """In one line that names the file, the field, and what was expected of it."""
    with pytest.raises(InputError) as caught:
        read_volume(path, **given)
    message = str(caught.value)
    assert message.startswith(f"{path}: {field}")
    assert expected in message.partition(", expected ")[2]
    assert "\n" not in message
    assert len(message) < 700
