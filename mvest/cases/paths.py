"""The files of a case folder: found by name, never outside the folder, and hashed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mvest.cases.schema import wrong
from mvest.errors import InputError
from mvest.reading.yaml_file import read_yaml

CASE_FILE = "case.yaml"


@dataclass(frozen=True, slots=True)
class CaseFolder:
    """A case folder: finds the files in it and remembers which were used."""

    root: Path
    used: dict[str, Path] = field(default_factory=dict)

    @property
    def case(self) -> Path:
        """The file with the fields, which every error names first."""
        return self.root / CASE_FILE

    def file(self, name: str, where: str) -> Path:
        """The path of a file that a field names; it must lie in the folder."""
        given = Path(name)
        path = self.root / given
        outside = given.is_absolute() or ".." in given.parts or "\\" in name or "\0" in name
        try:
            found = not outside and path.is_file()
            outside = outside or not path.resolve().is_relative_to(self.root.resolve())
        except (OSError, RuntimeError) as fault:  # a name too long, a link to itself
            raise wrong(self.case, where, f"{name[:60]!r} cannot be found: {fault}") from fault
        if outside:
            raise wrong(
                self.case, where, f"{name!r} leads out of the folder; expected a file inside it"
            )
        if not found:
            raise wrong(self.case, where, f"{name!r}: no such file in {self.root}")
        self.used[given.as_posix()] = path
        return path

    def sha256(self) -> str:
        """Over names and contents of all used files, in the order of the names."""
        digest = hashlib.sha256()
        for name, path in sorted({CASE_FILE: self.case, **self.used}.items()):
            content = path.read_bytes()
            digest.update(f"{len(name.encode())} {name} {len(content)} ".encode())
            digest.update(content)
        return digest.hexdigest()


def files_of_case(root: Path) -> dict[str, Path]:
    """Name -> file of all that reading a case folder can open, as far as it is there.

    These are the file with the fields and whatever a text in it names, whichever field it is in.
    """
    files = {CASE_FILE: root / CASE_FILE}
    try:
        files |= {text: root / text for text in _texts(read_yaml(root / CASE_FILE))}
        return {name: file for name, file in files.items() if file.is_file()}
    except (InputError, OSError):
        # It is refused when it is read.
        return files


def _texts(data: Any) -> Iterator[str]:
    if isinstance(data, dict | list):
        for item in data.values() if isinstance(data, dict) else data:
            yield from _texts(item)
    elif isinstance(data, str) and len(data) < MAX_NAME and not Path(data).is_absolute():
        yield data


MAX_NAME = 1024
"""Characters; longer texts are descriptions."""
