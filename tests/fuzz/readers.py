"""All readers of files that a user brings, by name."""

from tests.fuzz import readers_of_data, readers_of_surfaces, readers_of_volumes
from tests.fuzz.trial import Reader

__all__ = ["READERS"]

READERS: dict[str, Reader] = {
    reader.name: reader
    for room in (
        readers_of_volumes.READERS,
        readers_of_surfaces.READERS,
        readers_of_data.READERS,
    )
    for reader in room
}
