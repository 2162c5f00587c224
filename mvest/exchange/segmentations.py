"""Sequences and segmentations as 3D Slicer reads them (``.seq.nrrd``, ``.seg.nrrd``).

Leaflets are drawn as labelled voxels, for a look at them in the volume.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.exchange._images import MODALITY_KEY
from mvest.files import write_atomically
from mvest.imaging.volume import VolumeSequence
from mvest.typing import FloatArray, IntArray


def voxelise_leaflets(
    volume: VolumeSequence,
    vertices: FloatArray,
    triangles: IntArray,
    region: IntArray,
    thickness: FloatArray,
) -> IntArray:
    """Label the voxels whose centre lies within half the thickness of a midsurface.

    A leaflet thinner than the largest spacing between voxels is drawn that thick, so that no path
    over the faces of voxels leads through it (J. Huang et al., An accurate method for voxelizing
    polygon meshes, IEEE Symposium on Volume Visualization, 1998). Where leaflets touch, a voxel
    belongs to the one that it lies deeper in.

    Parameters
    ----------
    volume
        Gives the grid; its voxels are not looked at.
    vertices
        ``(n, 3)`` mm, LPS, in one frame.
    triangles
        ``(m, 3)``.
    region
        ``(m,)`` leaflet of each triangle, from 0.
    thickness
        ``(n,)`` mm.

    Returns
    -------
    labels
        ``(I, J, K)`` integers: 0 outside, else 1 + region.

    Raises
    ------
    InputError
        Arrays that do not fit together, vertices that are no numbers, negative thickness.
    """
    points = np.asarray(vertices, dtype=np.float64)
    _check(points, triangles, region, thickness)
    shape = np.array(volume.frames.shape[1:])
    # In mm along the axes of the volume, where a voxel's centre is its index times the spacing.
    local = (points - volume.origin) @ volume.direction
    reach = np.maximum(thickness, volume.spacing.max()) / 2
    depth = np.ones(shape)
    labels = np.zeros(shape, dtype=np.int64)
    for triangle, leaflet in zip(triangles, region, strict=True):
        corners, reaches = local[triangle], reach[triangle]
        low = np.ceil((corners.min(axis=0) - reaches.max()) / volume.spacing).astype(int)
        high = np.floor((corners.max(axis=0) + reaches.max()) / volume.spacing).astype(int) + 1
        low, high = np.maximum(low, 0), np.minimum(high, shape)
        if (low >= high).any():
            continue
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        centres = (
            np.stack(
                np.meshgrid(
                    *(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"
                ),
                axis=-1,
            )
            * volume.spacing
        )
        weights = _closest(centres.reshape(-1, 3), corners)
        gap = np.linalg.norm(centres.reshape(-1, 3) - weights @ corners, axis=1)
        ratio = (gap / (weights @ reaches)).reshape(centres.shape[:3])
        nearer = ratio < depth[box]
        depth[box][nearer] = ratio[nearer]
        labels[box][nearer] = 1 + leaflet
    return labels


def _check(
    points: FloatArray, triangles: IntArray, region: IntArray, thickness: FloatArray
) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(f"vertices: shape {points.shape}, expected (n, 3) finite numbers of mm")
    if np.shape(thickness) != points.shape[:1] or not (np.asarray(thickness) >= 0).all():
        raise InputError(
            f"thickness: shape {np.shape(thickness)}, expected {points.shape[:1]} numbers >= 0 mm"
        )
    if triangles.ndim != 2 or triangles.shape[1] != 3:
        raise InputError(f"triangles: shape {triangles.shape}, expected (m, 3)")
    if triangles.size and not (triangles.min() >= 0 and triangles.max() < len(points)):
        raise InputError(
            f"triangles: vertices to {triangles.max()}, expected 0 to {len(points) - 1}"
        )
    if np.shape(region) != triangles.shape[:1] or np.any(np.asarray(region) < 0):
        raise InputError(
            f"region: shape {np.shape(region)}, expected {triangles.shape[:1]} numbers from 0"
        )


def _closest(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Weights ``(p, 3)`` of a triangle's corners at its points closest to ``points`` ``(p, 3)``.

    In the triangle where the projection falls inside it, else on the closest of its edges.
    """
    best = np.empty((len(points), 3))
    distance = np.full(len(points), np.inf)
    for a in range(3):
        b = (a + 1) % 3
        edge = corners[b] - corners[a]
        length = edge @ edge
        along = (points - corners[a]) @ edge / length if length > 0 else np.zeros(len(points))
        along = np.clip(along, 0.0, 1.0)
        apart = np.linalg.norm(points - corners[a] - along[:, np.newaxis] * edge, axis=1)
        nearer = apart < distance
        distance[nearer] = apart[nearer]
        best[nearer] = 0.0
        best[nearer, a] = 1.0 - along[nearer]
        best[nearer, b] = along[nearer]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    square = normal @ normal
    if square > 0:
        weights = np.stack(
            [
                np.cross(corners[(a + 2) % 3] - corners[(a + 1) % 3], points - corners[(a + 1) % 3])
                @ normal
                / square
                for a in range(3)
            ],
            axis=1,
        )
        inside = (weights >= 0).all(axis=1)
        best[inside] = weights[inside]
    return best


TYPES = ("uint8", "int16", "float32")


TERMINOLOGY = "SlicerHeart segmentation category and type"
"""Name of SlicerHeart's table of codes, ``SlicerHeartSegmentationCategoryTypeModifier.json``."""
_CATEGORY = "SCT^91134007^Mitral Valve"


@dataclass(frozen=True, slots=True)
class SegmentCode:
    """What SlicerHeart calls a segment: its type in `TERMINOLOGY` and its colour."""

    type: str
    colour: tuple[float, float, float]

    @property
    def tags(self) -> str:
        """As Slicer writes the terminology of a segment: category, type, modifier; anatomy."""
        entry = f"{TERMINOLOGY}~{_CATEGORY}~{self.type}~^^~Anatomic codes - DICOM master list"
        return f"Segmentation.Status:completed|TerminologyEntry:{entry}~^^~^^|"


SEGMENTS = {
    "mitral_anterior_leaflet": SegmentCode(
        "SlicerHeart^sh-leaflet-mv-a^mitral anterior leaflet", (1.0, 18 / 255, 8 / 255)
    ),
    "mitral_posterior_leaflet": SegmentCode(
        "SlicerHeart^sh-leaflet-mv-p^mitral posterior leaflet", (42 / 255, 61 / 255, 244 / 255)
    ),
}
"""By the names of SlicerHeart's colour table ``HeartValves.ctbl``."""


def segment_name(region: str) -> str:
    """What the segment of a leaflet is called: SlicerHeart's name where it has one."""
    name = f"mitral_{region}_leaflet"
    return name if name in SEGMENTS else f"{region} leaflet"


COLOURS = (
    (0.9, 0.4, 0.3),
    (0.3, 0.6, 0.9),
    (0.5, 0.8, 0.4),
    (0.9, 0.8, 0.3),
    (0.7, 0.5, 0.8),
    (0.5, 0.5, 0.5),
)
"""Red, green and blue, in turn."""


def checked_path(path: Path | str, suffix: str) -> Path:
    """The path, which must end in `suffix`."""
    target = Path(path)
    if not target.name.endswith(suffix) or target.name == suffix:
        raise InputError(f"{target}: name {target.name!r}, expected one that ends in {suffix}")
    return target


def write_sequence_nrrd(
    path: Path | str, sequence: VolumeSequence, *, compressed: bool = True
) -> Path:
    """Write a volume over time with its times, evenly spaced or not, and its modality.

    The axis of frames comes first, as all versions of Slicer read it; times are s. `read_volume`
    gives the same sequence back, its source and hash aside.

    Parameters
    ----------
    path
        Ends in ``.seq.nrrd``.
    sequence
        Of uint8, int16 or float32.
    compressed
        With gzip; quick rather than small.

    Raises
    ------
    InputError
        Another name or type, or a file that cannot be written.
    """
    target = checked_path(path, ".seq.nrrd")
    if sequence.frames.dtype.name not in TYPES:
        raise InputError(
            f"{target}: frames of type {sequence.frames.dtype}, expected {', '.join(TYPES)}"
        )
    steps = (sequence.direction * sequence.spacing).T
    header: dict[str, Any] = {
        "space": "left-posterior-superior",
        "space directions": np.vstack([np.full(3, np.nan), steps]),
        "space origin": np.asarray(sequence.origin, dtype=np.float64),
        "kinds": ["list", "domain", "domain", "domain"],
        "labels": ["time", "", "", ""],
        "units": ["s", "", "", ""],
        "encoding": "gzip" if compressed else "raw",
        "DataNodeClassName": "vtkMRMLScalarVolumeNode",
        "axis 0 index type": "numeric",
        "axis 0 index values": " ".join(repr(float(time)) for time in sequence.times),
        MODALITY_KEY: sequence.modality.value,
    }
    _write_nrrd(target, sequence.frames, header)
    return target


def write_segmentation(
    path: Path | str, volume: VolumeSequence, labels: IntArray, names: Mapping[int, str]
) -> Path:
    """Write labelled voxels of one frame with the names of the labels.

    The fields are those of Slicer's developer guide, "Segmentations". A name of `SEGMENTS` brings
    its codes and colour. One without any voxel is written as an empty segment.

    Parameters
    ----------
    path
        Ends in ``.seg.nrrd``.
    volume
        Gives the grid.
    labels
        ``(I, J, K)`` integers, 0 outside.
    names
        Of every label from 1 to 255.

    Raises
    ------
    InputError
        Another extension or shape, labels without name, or a file that cannot be written.
    """
    target = checked_path(path, ".seg.nrrd")
    expected = volume.frames.shape[1:]
    if labels.shape != expected or labels.dtype.kind not in "iu":
        raise InputError(
            f"{target}: labels {labels.dtype} of shape {labels.shape}, expected integers {expected}"
        )
    used = {int(label) for label in np.unique(labels)} - {0}
    if not names or min(names) < 1 or max(names) > 255 or not used <= set(names):
        raise InputError(
            f"{target}: labels {sorted(used)} and names of {sorted(names)}, expected a name for "
            "every label from 1 to 255"
        )
    header: dict[str, Any] = {
        "space": "left-posterior-superior",
        "space directions": (volume.direction * volume.spacing).T,
        "space origin": np.asarray(volume.origin, dtype=np.float64),
        "kinds": ["domain", "domain", "domain"],
        "encoding": "gzip",
        "Segmentation_ContainedRepresentationNames": "Binary labelmap|",
        "Segmentation_SourceRepresentation": "Binary labelmap",
        # What the field was called before.
        "Segmentation_MasterRepresentation": "Binary labelmap",
        "Segmentation_ReferenceImageExtentOffset": "0 0 0",
    }
    for number, (label, name) in enumerate(sorted(names.items())):
        code = SEGMENTS.get(name)
        colour = COLOURS[number % len(COLOURS)] if code is None else code.colour
        prefix = f"Segment{number}_"
        header |= {
            prefix + "ID": f"Segment_{label}",
            prefix + "Name": _one_line(target, name),
            prefix + "NameAutoGenerated": "0",
            prefix + "Color": " ".join(f"{part:g}" for part in colour),
            prefix + "ColorAutoGenerated": "0",
            **({} if code is None else {prefix + "Tags": code.tags}),
            prefix + "LabelValue": str(label),
            prefix + "Layer": "0",
            prefix + "Extent": " ".join(map(str, _extent(labels == label))),
        }
    _write_nrrd(target, labels.astype(np.uint8), header)
    return target


def _one_line(path: Path, name: str) -> str:
    if not name.strip() or not name.isprintable():
        raise InputError(f"{path}: name {name!r}, expected words in one line")
    return name.strip()


def _extent(mask: np.ndarray) -> list[int]:
    """First and last index along i, j and k; 0 and -1, as in Slicer, where there is none."""
    if not mask.any():
        return [0, -1] * 3
    result: list[int] = []
    for axis in range(3):
        others = tuple(other for other in range(3) if other != axis)
        occupied = np.flatnonzero(mask.any(axis=others))
        result += [int(occupied[0]), int(occupied[-1])]
    return result


def _write_nrrd(path: Path, data: NDArray[np.generic], header: Mapping[str, Any]) -> None:
    """Write an array, first axis fastest, with pynrrd: the same bytes for the same content.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    content = io.BytesIO()
    nrrd.write(content, data, dict(header), compression_level=1)
    content.seek(0)
    lines: list[bytes] = []
    while (line := content.readline()) != b"\n":
        # pynrrd's comments hold the time of writing.
        if not line.startswith(b"#"):
            lines.append(line)
    write_atomically(path, b"".join([*lines, b"\n", content.read()]))
