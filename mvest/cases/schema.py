"""The fields of ``case.yaml`` (version 1), and the files of a case folder.

The models define the fields and their types. The modules that read the files check whether the
values are consistent. The files of a case folder are found by name, never outside the folder, and
hashed.
"""

import difflib
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from mvest.cases.case import Role
from mvest.errors import InputError
from mvest.reading.documents import read_yaml
from mvest.reading.text import MAX_NUMBER, one_line

VERSION = 1
"""The version of the format that is read and written."""
MAX_TEXT, MAX_NAME = 10_000, 200
"""Largest number of characters of a text, and of a name or a file name."""


Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_NUMBER, le=MAX_NUMBER)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=MAX_NUMBER)]
Text = Annotated[str, Field(strict=True, max_length=MAX_TEXT)]
Name = Annotated[str, Field(strict=True, min_length=1, max_length=MAX_NAME)]
Index = Annotated[int, Field(strict=True, ge=0, le=MAX_NUMBER)]
Point = Annotated[list[Number], Field(min_length=3, max_length=3)]
Regions = Annotated[
    dict[Annotated[int, Field(strict=True)] | Name, Name],
    Field(min_length=1),
    BeforeValidator(
        lambda given: dict(enumerate(given)) if isinstance(given, list) else given,
        json_schema_input_type=list[Name] | dict[int | Name, Name],
    ),
]
Segments = Name | Annotated[list[Name], Field(min_length=1)]
SurfaceFiles = Name | Annotated[dict[Name, Segments], Field(min_length=1)]
Curve = Name | Annotated[list[Index], Field(min_length=3)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Units(_Model):
    """Units of all values in the folder without a unit in their name."""

    length: Literal["mm", "cm", "m"] = Field(description="mm, cm or m, of all coordinates")
    pressure: Literal["mmHg", "kPa"] = Field("mmHg", description="mmHg or kPa")
    time: Literal["s", "ms"] = Field("s", description="s or ms")


class PointData(_Model):
    """A field at the vertices of the reference surface."""

    point_data: Name = Field(description="the name of point data of the reference surface")


LOOP = "a list of vertex numbers in the order of the loop, or a .csv file"


class FrameEntry(_Model):
    """One instant at which the valve was observed."""

    name: Name = Field(description="text, different for every frame")
    time: Number = Field(description="a number in units.time, larger than that of the frame before")
    role: Role = Field(
        description="reference (open; the model starts from it), closed (fitted), fitted (a "
        "further closed frame, under another pressure, fitted with it) or held_out"
    )
    surface: SurfaceFiles = Field(
        description="a file (.vtp, .vtu, .vtk, .stl, .obj, .ply), or one file or list of files "
        "for every region"
    )
    annulus: Curve | None = Field(None, description=LOOP)
    free_edge: Curve | None = Field(None, description=LOOP)
    papillary_tips: Annotated[list[Point], Field(min_length=1)] = Field(
        description="a list of [x, y, z] in units.length, in the same order in all frames"
    )
    pressure: Number = Field(
        description="a number: transmitral pressure in units.pressure, positive if it closes"
    )
    corresponds: bool | None = Field(
        None,
        strict=True,
        description="true or false: vertex i is the same material point as in the reference",
    )


class ChordaeEntry(_Model):
    """The table of chordae, and their common properties."""

    file: Name = Field(
        description="a .csv file with tip,x,y,z,family,rest_length_mm,stiffness_n, and start,end "
        "if chordae branch"
    )
    toe_strain: Number = Field(
        0.015, gt=0, lt=0.5, description="strain over which the stiffness rises, in (0, 0.5)"
    )
    families: list[Name] | None = Field(None, description="names of all families, in order")
    follow: bool = Field(
        False,
        strict=True,
        description="true or false: laid out by a program as in the template, so that they are "
        "laid out anew for every error sample",
    )


ChordaeTable = Annotated[
    ChordaeEntry,
    BeforeValidator(
        lambda given: {"file": given} if isinstance(given, str) else given,
        json_schema_input_type=Name | ChordaeEntry,
    ),
]


class ObservationEntry(_Model):
    """Errors of the vertices of a frame."""

    std_mm: Annotated[Number, Field(gt=0)] | PointData = Field(
        description="standard deviation of a coordinate in mm, > 0: a number, or "
        "{point_data: NAME} of the reference surface"
    )
    correlation_length_mm: NotNegative = Field(
        description="mm along the leaflets over which errors are correlated, >= 0"
    )
    error_samples: Name | None = Field(
        None, description="a .npz file with joint errors of all frames: frames, vertices and tips"
    )


class ArrivalEntry(_Model):
    """By which way the geometry arrived."""

    way: Literal["volume", "surfaces", "labels", "vertices"] = Field(
        description="volume, surfaces, labels or vertices"
    )
    made_by: Text = Field("", description="text: SHA-256 of what made it, such as detectors")


class CaseFile(_Model):
    """The content of ``case.yaml``."""

    version: Literal[1] = Field(description="1, the version of this format")
    name: Name = Field(description="text")
    description: Text = Field("", description="text")
    source: Text = Field("", description="text: where the data come from")
    licence: Text = Field("", description="text: under which terms they may be used")
    simulated: bool = Field(
        False, strict=True, description="true or false: do the frames come from a simulation"
    )
    units: Units = Field(description="a mapping with length, and if need be pressure and time")
    regions: Regions = Field(
        description="a list of names (labels 0, 1, ...) or a mapping from label to name; several "
        "labels may have one name"
    )
    thickness: Number | PointData | dict[Name, Number] | None = Field(
        None, description="mm: a number, a number for every region, or {point_data: NAME}"
    )
    fibre: Name | None = Field(
        None, description="the name of point data (3 components) of the reference surface"
    )
    frames: Annotated[list[FrameEntry], Field(min_length=1)] = Field(
        description="a list of frames in the order of time, or the reference alone"
    )
    chordae: ChordaeTable | None = Field(
        None, description="a .csv file, or a mapping with file, toe_strain and families"
    )
    observation: ObservationEntry | None = Field(
        None, description="a mapping with std_mm, correlation_length_mm and error_samples"
    )
    arrival: ArrivalEntry | None = Field(
        None, description="a mapping with way and made_by, written by the program that made it"
    )
    derived: list[Text] = Field(
        default_factory=list,
        description="sentences, one for everything that a program derived when it wrote the case",
    )

    @property
    def region_names(self) -> tuple[str, ...]:
        """The names of the regions, each once."""
        return tuple(dict.fromkeys(self.regions.values()))

    def files(self) -> list[tuple[str, str]]:
        """Field and name of every file that the case names."""
        named: list[tuple[str, object]] = [
            ("chordae", getattr(self.chordae, "file", None)),
            ("observation", getattr(self.observation, "error_samples", None)),
        ]
        for number, frame in enumerate(self.frames):
            surface = frame.surface
            parts = list(surface.values()) if isinstance(surface, dict) else [surface]
            surfaces = [name for p in parts for name in ([p] if isinstance(p, str) else p)]
            for name in (*surfaces, frame.annulus, frame.free_edge):
                named.append((f"frames.{number}", name))
        return [(where, name) for where, name in named if isinstance(name, str)]


PARTS: Mapping[str, type[BaseModel]] = {
    "units": Units,
    "thickness": PointData,
    "frames": FrameEntry,
    "chordae": ChordaeEntry,
    "observation": ObservationEntry,
    "arrival": ArrivalEntry,
    "std_mm": PointData,
}
"""Fields that are models themselves."""


def _explained(loc: Sequence[int | str], kind: str, value: Any) -> tuple[str, str]:
    """Dotted field and a sentence for one of pydantic's errors."""
    path: list[str] = []
    model, expected = cast("type[BaseModel]", CaseFile), "a mapping of fields"
    for part in loc:  # pydantic also names the alternatives of a type, which are not fields
        if isinstance(part, int):
            path.append(str(part))
        elif part in model.model_fields:
            path.append(part)
            expected = model.model_fields[part].description or expected
            model = PARTS.get(part, model)
    if kind == "extra_forbidden":
        known = list(model.model_fields)
        near = difflib.get_close_matches(str(loc[-1]), known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(known)}"
        return ".".join([*path, str(loc[-1])]), f"unknown key; {hint}"
    field = ".".join(path)
    if kind == "missing":
        return field, f"is missing; expected {expected}"
    shown = repr(value)
    found = shown if len(shown) <= 60 else shown[:57] + "..."
    if isinstance(value, str):
        with suppress(ValueError):
            float(value)
            found += " (this is text: YAML wants numbers like 1.0e-3, without quotes)"
    return field, f"found {found}; expected {expected}"


CASE_FILE = "case.yaml"


@dataclass(frozen=True)
class CaseFolder:
    """A case folder: its fields, used files, and sentences on derived values."""

    root: Path
    used: dict[str, Path] = field(default_factory=dict)

    @property
    def case(self) -> Path:
        """``case.yaml``, which every error names first."""
        return self.root / CASE_FILE

    @cached_property
    def document(self) -> CaseFile:
        """The fields of the case.

        InputError if the file is not a plain YAML mapping, or a field is missing, unknown or of the
        wrong kind: one line with the field, what was found and what would be right.
        """
        data = read_yaml(self.file(CASE_FILE, "link"))
        version = data.get("version")
        if version != VERSION or isinstance(version, bool):
            found = f"{version!r} is not known" if "version" in data else "is missing"
            raise self.wrong("version", f"{found}; expected {VERSION}")
        try:
            return CaseFile.model_validate(data)
        except ValidationError as fault:
            errors = fault.errors(include_url=False)
            more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
            field, what = _explained(errors[0]["loc"], errors[0]["type"], errors[0]["input"])
            raise self.wrong(field, what + more) from fault

    @cached_property
    def derived(self) -> list[str]:
        """Sentences, one for everything that was derived instead of given."""
        return list(self.document.derived)

    def wrong(self, field: str, what: str, kind: type[InputError] = InputError) -> InputError:
        """The error of one field, in one line."""
        return kind(f"{self.case}: {one_line(field, 80)}: {one_line(what)}")

    @contextmanager
    def at(self, field: str) -> Iterator[None]:
        """Prepend file and field to the message of any error raised inside."""
        try:
            yield
        except InputError as fault:
            raise self.wrong(field, str(fault), type(fault)) from fault

    def file(self, name: str, where: str) -> Path:
        """The path of a file that a field names; it must lie in the folder."""
        given = Path(name)
        path = self.root / given
        outside = given.is_absolute() or ".." in given.parts or "\\" in name or "\0" in name
        try:
            found = not outside and path.is_file()
            outside = outside or not path.resolve().is_relative_to(self.root.resolve())
        except (OSError, RuntimeError) as fault:  # a name too long, a link to itself
            raise self.wrong(where, f"{name[:60]!r} cannot be found: {fault}") from fault
        if outside:
            raise self.wrong(where, f"{name!r} leads out of the folder; expected a file inside it")
        if not found:
            raise self.wrong(where, f"{name!r}: no such file in {self.root}")
        self.used[given.as_posix()] = path
        return path

    def sha256(self) -> str:
        """Hash of names and contents of all used files, in the order of the names."""
        digest = hashlib.sha256()
        for name, path in sorted(self.used.items()):
            content = path.read_bytes()
            digest.update(f"{len(name.encode())} {name} {len(content)} ".encode())
            digest.update(content)
        return digest.hexdigest()


def files_of_case(root: Path) -> dict[str, Path]:
    """Name -> file of all files that reading a case opens, up to the first missing one."""
    folder = CaseFolder(root)
    with suppress(InputError):  # raised again on reading
        for where, name in folder.document.files():
            folder.file(name, where)
    return folder.used
