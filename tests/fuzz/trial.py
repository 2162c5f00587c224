"""Examples of a reader, made once, and inputs made of them one after another."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.child import Child, Outcome
from tests.fuzz.mutation import Change, changed, random_changes

__all__ = ["Bench", "Reader"]

Maker = Callable[[Path], Path]


@dataclass(frozen=True)
class Reader:
    """An entry of the table of readers.

    Attributes
    ----------
    name
        ``ROOM.KIND``, also the folder of its stored inputs.
    read
        Reads a file, or the folder that it is in; what it returns does not matter.
    makers
        Write valid files into an empty folder; each returns the one that is damaged.
    """

    name: str
    read: Callable[[Path], object]
    makers: tuple[Maker, ...]


class Bench:
    """The examples of one reader in a folder, each written over by what is made of it."""

    def __init__(self, reader: Reader, folder: Path, child: Child) -> None:
        self.reader, self.child = reader, child
        self.paths: list[Path] = []
        self.contents: list[bytes] = []
        for number, maker in enumerate(reader.makers):
            place = folder / f"{reader.name}-{number}"
            place.mkdir(parents=True)
            path = maker(place)
            self.paths.append(path)
            self.contents.append(path.read_bytes())
        self.whole = [self.child.read(reader.name, path, limited=False) for path in self.paths]
        """How the valid files are read, which also loads what the reader needs."""

    def tried(self, content: bytes, number: int = 0) -> Outcome:
        """How the reader ends on bytes in the place of an example."""
        path = self.paths[number]
        path.write_bytes(content)
        found = self.child.read(self.reader.name, path)
        if found.kind in ("slow", "died"):
            # The new process has to load first what the reader needs.
            path.write_bytes(self.contents[number])
            self.child.read(self.reader.name, path, limited=False)
        return found

    def drawn(self, seed: int) -> tuple[int, list[Change], bytes]:
        """Number of an example, and its changes, that follow from a number."""
        draw = random.Random(seed)
        number, changes = draw.randrange(len(self.paths)), random_changes(draw)
        return number, changes, changed(self.contents[number], changes)
