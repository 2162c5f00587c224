"""Shared by all importers: checks options, sides and frames, and makes the case.

A case is written to a folder and read back with the usual checks.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import yaml
from pydantic import Field

from mvest.cases.case import Frame, Role, ValveCase
from mvest.cases.folder import read_case
from mvest.cases.plausibility import implausible_values
from mvest.cases.schema import CASE_FILE
from mvest.cases.tissue import write_chordae
from mvest.errors import InputError, MvestError
from mvest.exchange.surfaces import Data, Surface, write_surface
from mvest.quantities import Place, Thickness
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import Chordae
from mvest.valve.geometry.midsurface import Midsurface

REGIONS = ("anterior", "posterior")


Tips: TypeAlias = Annotated[tuple[Place, ...], Field(min_length=6, max_length=6)]
"""Coordinates of two papillary tips, antero-lateral and postero-medial."""
Pair: TypeAlias = Annotated[tuple[Thickness, ...], Field(min_length=2, max_length=2)]
"""Thickness of the anterior and the posterior leaflet, or two bounds."""


def check_sides(left: str, to_left: FloatArray, to_front: FloatArray, down: FloatArray) -> None:
    """Raise an InputError if a valve is mirrored.

    ``left`` names the structure that must be left of the anterior leaflet, seen from the atrium.
    The directions ``(3,)`` point to it, to the anterior leaflet, and to the ventricle.
    """
    if np.linalg.det(np.stack([to_left, to_front, down])) < 0:
        raise InputError(
            f"{left} lies as in a mirror: on the right of the anterior leaflet, seen from the "
            "atrium; are tips or leaflets exchanged, or is an axis turned? (mirrored=true skips "
            "this check)"
        )


@dataclass(frozen=True, slots=True, eq=False)
class FoundFrame:
    """A frame in mm, mmHg and s; for the fields see ``frames`` of a case."""

    name: str
    role: Role
    time: float
    pressure: float
    surface: Midsurface | Surface | Frame
    tips: FloatArray
    point_data: Data = field(default_factory=dict)


def case_of_frames(
    frames: Sequence[FoundFrame],
    document: Mapping[str, Any],
    chordae: Chordae | None = None,
    *,
    mirrored: bool,
) -> ValveCase:
    """Make a case from frames without common vertices, with the usual checks.

    The regions of the frames are 0 (anterior) and 1 (posterior). ``document`` has further fields of
    ``case.yaml``; without ``chordae`` they are laid out; ``mirrored`` accepts a mirrored valve.

    InputError or GeometryError as `mvest.cases.folder.read_case`; or the valve is mirrored, or the
    frames are swapped.
    """
    for one in frames:
        x, faces, region = one.surface.vertices, one.surface.triangles, one.surface.region
        if not mirrored:
            front, back = (x[faces[region == k]].mean(axis=(0, 1)) for k in (0, 1))
            down = one.tips.mean(axis=0) - x.mean(axis=0)
            tip = f"{one.name}: the antero-lateral (first) papillary tip"
            check_sides(tip, one.tips[0] - one.tips[1], front - back, down)
    with tempfile.TemporaryDirectory() as temporary:
        folder, entries = Path(temporary), []
        for number, one in enumerate(frames):
            labels = {"region": np.asarray(one.surface.region)}
            surface = Surface(one.surface.vertices, one.surface.triangles, one.point_data, labels)
            write_surface(folder / f"{number}.vtp", surface)
            entry = {"name": one.name, "role": one.role.value, "time": float(one.time)}
            entry |= {"surface": f"{number}.vtp", "papillary_tips": one.tips.tolist()}
            apart = {} if one.role is Role.REFERENCE else {"corresponds": False}
            entries.append(entry | {"pressure": float(one.pressure)} | apart)
        units = {"length": "mm", "pressure": "mmHg", "time": "s"}
        regions = {"version": 1, "units": units, "regions": list(REGIONS)}
        whole = {**regions, **document, "frames": entries}
        if chordae is not None:
            write_chordae(folder / "chordae.csv", chordae)
            families = list(chordae.family_names)
            own = {"file": "chordae.csv", "toe_strain": chordae.toe_strain, "families": families}
            whole["chordae"] = own
        text = yaml.safe_dump(whole, sort_keys=False, allow_unicode=True)
        (folder / CASE_FILE).write_text(text, encoding="utf-8")
        try:
            case = replace(read_case(folder), sha256="")
        except MvestError as fault:
            reason = str(fault).replace(f"{folder / CASE_FILE}: ", "").replace(f"{folder}/", "")
            raise type(fault)(reason) from fault
    for value in implausible_values(case):
        if value.mistake and value.field == "frames":
            raise InputError(str(value))
    return case
