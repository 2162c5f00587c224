"""Reading volumes over time from the files that scanners and viewers write."""

from mvest.imaging.reading.reader import read_volume

__all__ = ["read_volume"]
