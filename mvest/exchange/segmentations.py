"""Sequences and segmentations as 3D Slicer reads them (``.seq.nrrd``, ``.seg.nrrd``).

Leaflets are drawn as labelled voxels, for a look at them in the volume.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvest.errors import InputError
from mvest.exchange._nrrd import MODALITY_KEY
from mvest.files import write_atomically
from mvest.imaging.volume import VolumeSequence
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.proximity import closest_points


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
    polygon meshes, IEEE Symposium on Volume Visualization, 1998). A voxel that is
    within the reach of several leaflets belongs to the nearest one.

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
    """
    # In mm along the axes of the volume, where a voxel's centre is its index times the spacing.
    local = (np.asarray(vertices, dtype=np.float64) - volume.origin) @ volume.direction
    reach, spacing = np.maximum(thickness, volume.spacing.max()) / 2, volume.spacing
    labels = np.zeros(volume.frames.shape[1:], dtype=np.int64)
    low = np.ceil((local.min(axis=0) - reach.max()) / spacing).astype(int)
    high = np.floor((local.max(axis=0) + reach.max()) / spacing).astype(int) + 1
    low = np.maximum(low, 0)
    high = np.maximum(low, np.minimum(high, labels.shape))
    box = tuple(slice(first, end) for first, end in zip(low, high, strict=True))
    index = np.moveaxis(np.mgrid[box], 0, -1).reshape(-1, 3)
    corners = local[triangles]
    middle = corners.mean(axis=1)
    around = np.linalg.norm(corners - middle[:, np.newaxis], axis=2).max()
    bound = reach.max() + around
    gap, _ = cKDTree(middle).query(index * spacing, distance_upper_bound=bound)
    index = index[np.isfinite(gap)]
    found = closest_points(index * spacing, local, triangles)
    inside = found.distance < found.interpolate(reach, triangles)
    labels[tuple(index[inside].T)] = 1 + region[found.triangle[inside]]
    return labels


TYPES = ("uint8", "int16", "float32")

SEGMENTS = {
    "mitral_anterior_leaflet": ("sh-leaflet-mv-a^mitral anterior leaflet", "1 0.0705882 0.0313725"),
    "mitral_posterior_leaflet": (
        "sh-leaflet-mv-p^mitral posterior leaflet",
        "0.164706 0.239216 0.956863",
    ),
}
"""Names and colours of SlicerHeart's table ``HeartValves.ctbl``, and its codes of them."""
TAGS = (
    "Segmentation.Status:completed|TerminologyEntry:SlicerHeart segmentation category and type"
    "~SCT^91134007^Mitral Valve~SlicerHeart^{}~^^~Anatomic codes - DICOM master list~^^~^^|"
)
"""Slicer's terminology of a segment: category, type, modifier; anatomy. The codes are those of
SlicerHeart's ``SlicerHeartSegmentationCategoryTypeModifier.json``."""
COLOURS = ("0.9 0.4 0.3", "0.3 0.6 0.9", "0.5 0.8 0.4", "0.9 0.8 0.3", "0.7 0.5 0.8", "0.5 0.5 0.5")
"""Red, green and blue of other segments, in turn."""


def segment_name(region: str) -> str:
    """What the segment of a leaflet is called: SlicerHeart's name where it has one."""
    name = f"mitral_{region}_leaflet"
    return name if name in SEGMENTS else f"{region} leaflet"


def checked_path(path: Path | str, suffix: str) -> Path:
    """The path, which must end in `suffix`."""
    target = Path(path)
    if not target.name.endswith(suffix) or target.name == suffix:
        raise InputError(f"{target}: name {target.name!r}, expected one that ends in {suffix}")
    return target


def write_sequence_nrrd(path: Path | str, sequence: VolumeSequence) -> Path:
    """Write a volume over time with its times, evenly spaced or not, and its modality.

    The axis of frames comes first, as all versions of Slicer read it; times are s. `read_volume`
    gives the same sequence back, its source and hash aside.

    Parameters
    ----------
    path
        Ends in ``.seq.nrrd``.
    sequence
        Of uint8, int16 or float32.

    Raises
    ------
    InputError
        Another name or type, or a file that cannot be written.
    """
    target = checked_path(path, ".seq.nrrd")
    if (found := sequence.frames.dtype.name) not in TYPES:
        raise InputError(f"{target}: frames of type {found}, expected {', '.join(TYPES)}")
    fields = {
        "labels": ["time", "", "", ""],
        "units": ["s", "", "", ""],
        "encoding": "gzip",
        "DataNodeClassName": "vtkMRMLScalarVolumeNode",
        "axis 0 index type": "numeric",
        "axis 0 index values": " ".join(repr(float(time)) for time in sequence.times),
        MODALITY_KEY: sequence.modality.value,
    }
    return _write_nrrd(target, sequence.frames, sequence, fields)


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
        ``(I, J, K)`` integers, 0 outside and at most 255.
    names
        Of every label.

    Raises
    ------
    InputError
        Another extension, a name of several lines, or a file that cannot be written.
    """
    target = checked_path(path, ".seg.nrrd")
    fields = {
        "encoding": "gzip",
        "Segmentation_ContainedRepresentationNames": "Binary labelmap|",
        "Segmentation_SourceRepresentation": "Binary labelmap",
        # What the field was called before.
        "Segmentation_MasterRepresentation": "Binary labelmap",
        "Segmentation_ReferenceImageExtentOffset": "0 0 0",
    }
    for number, (label, name) in enumerate(sorted(names.items())):
        if not name.strip() or not name.isprintable():
            raise InputError(f"{target}: name {name!r}, expected words in one line")
        code, colour = SEGMENTS.get(name, ("", COLOURS[number % len(COLOURS)]))
        occupied = np.argwhere(labels == label)
        first, last = (occupied.min(0), occupied.max(0)) if len(occupied) else ([0] * 3, [-1] * 3)
        segment = {
            "ID": f"Segment_{label}",
            "Name": name.strip(),
            "NameAutoGenerated": "0",
            "Color": colour,
            "ColorAutoGenerated": "0",
            **({"Tags": TAGS.format(code)} if code else {}),
            "LabelValue": str(label),
            "Layer": "0",
            "Extent": " ".join(f"{a} {b}" for a, b in zip(first, last, strict=True)),
        }
        fields |= {f"Segment{number}_{field}": value for field, value in segment.items()}
    return _write_nrrd(target, labels.astype(np.uint8), volume, fields)


def _write_nrrd(
    path: Path, data: NDArray[np.generic], grid: VolumeSequence, fields: Mapping[str, Any]
) -> Path:
    """Write voxels of a grid, an axis of frames first, if any, with pynrrd.

    The same content gives the same bytes.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    content, frames = io.BytesIO(), data.ndim - 3
    header = {
        "space": "left-posterior-superior",
        "space directions": np.vstack(
            [np.full((frames, 3), np.nan), (grid.direction * grid.spacing).T]
        ),
        "space origin": np.asarray(grid.origin, dtype=np.float64),
        "kinds": ["list"] * frames + ["domain"] * 3,
        **fields,
    }
    nrrd.write(content, data, header, compression_level=1)
    head, end, voxels = content.getvalue().partition(b"\n\n")
    # pynrrd's comments hold the time of writing.
    lines = [line for line in head.split(b"\n") if not line.startswith(b"#")]
    write_atomically(path, b"\n".join(lines) + end + voxels)
    return path
