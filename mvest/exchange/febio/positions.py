"""Positions of nodes as FEBio logs them beside an input of `mvest.exchange.febio.document`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mvest.errors import InputError
from mvest.reading.text import read_text
from mvest.typing import FloatArray

MAX_LOG = 1 << 28
"""Bytes of a log that are read."""


def read_positions(path: Path, n: int) -> tuple[FloatArray, FloatArray]:
    """Times ``(s,)`` and positions ``(s, n, 3)`` mm that FEBio has logged of n nodes.

    A last step that was not written in full is left out.

    Raises
    ------
    InputError
        If the file is not such a log.
    """
    times: list[float] = []
    frames: list[FloatArray] = []
    parts = re.split(r"^\*Step.*$", read_text(path, MAX_LOG), flags=re.MULTILINE)
    for part in parts[1:]:
        found = re.search(r"^\*Time\s*=\s*(\S+)\s*$", part, re.MULTILINE)
        rows = [line for line in part.splitlines() if line and not line.startswith("*")]
        if found is None or len(rows) < n:
            continue
        try:
            values = np.array([row.split(",") for row in rows], dtype=np.float64)
            time_s = float(found.group(1))
        except ValueError as error:
            raise InputError(f"{path}: rows that are no log of positions") from error
        if values.shape != (n, 4) or not np.array_equal(values[:, 0], np.arange(1, n + 1)):
            raise InputError(f"{path}: rows of shape {values.shape}, expected {n} nodes x,y,z")
        times.append(time_s)
        frames.append(values[:, 1:])
    return np.array(times), np.array(frames).reshape(len(frames), n, 3)
