"""Synthetic observations that several studies share are simulated once.

The key covers everything that can change the simulated positions: the truth's part of the
configuration and the code of the forward model. Entries are written whole or not at all.
"""

from __future__ import annotations

import ast
import hashlib
import os
import sys
import uuid
import zipfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

import mvest
from mvest.errors import InputError, cannot_write
from mvest.estimation.prediction import ObservationModel, Prediction, predict
from mvest.provenance import config_hash
from mvest.typing import FloatArray

__all__ = ["StoredModel", "truth_key"]

FORWARD_MODEL = ("elements.py", "units.py", "closure/model.py", "mechanics", "valve")
"""Files and folders of the library that decide what a closure gives."""


def truth_key(values: Mapping[str, Any], more: Sequence[str] = ()) -> str:
    """Key of a simulation described by plain values, for the present source of the library.

    Parameters
    ----------
    values : mapping
    more : sequence of str
        Modules of the library besides the forward model that the simulation uses.
    """
    root = Path(mvest.__file__).parent
    source = hashlib.sha256()
    for part in (*FORWARD_MODEL, *more):
        place = root / part
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            about = path.stat()
            source.update(_code(path, about.st_mtime_ns, about.st_size).encode())
    return config_hash({"source": source.hexdigest(), **values})


@cache
def _code(path: Path, changed: int, size: int) -> str:
    """What a file does: its syntax tree without comments, layout and docstrings.

    Parsing the library takes longer than some jobs, so a process does it once, unless a file was
    ``changed`` (ns) or has another ``size``.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        node.body = [  # type: ignore[attr-defined]
            item
            for item in body
            if not (isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant))
        ]
    return ast.dump(tree)


class StoredModel:
    """A model whose converged predictions are kept on disk.

    Of several processes that need the same one, the first simulates it and the others wait.

    Parameters
    ----------
    model : ObservationModel
    folder : Path
    key : str
        See :func:`truth_key`; the parameters are added to it.
    jacobian : bool
        Whether the Jacobian is kept as well; that of a stored prediction is zero otherwise.

    Attributes
    ----------
    hits, misses : int
        How often a prediction was read, and how often simulated.
    """

    def __init__(
        self, model: ObservationModel, folder: Path, key: str, *, jacobian: bool = False
    ) -> None:
        self._model = model
        self._jacobian = jacobian
        self._folder = folder
        self._key = key
        self.hits = 0
        self.misses = 0

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Prediction at ``m (p,)``, read from disk if it is there.

        Raises
        ------
        InputError
            If the store cannot be written.
        """
        kept = {"jacobian": True} if self._jacobian else {}
        name = config_hash({**kept, "key": self._key, "m": [float(v).hex() for v in m]})
        path = self._folder / f"{name}.npz"
        found = _read(path, len(m))
        if found is None:
            _make(self._folder)
            with FileLock(self._folder / f".{name}.lock"):
                found = _read(path, len(m))
                if found is None:
                    self.misses += 1
                    return self._simulate(m, path)
        self.hits += 1
        return found

    def _simulate(self, m: FloatArray, path: Path) -> Prediction:
        """The model's own prediction, kept if it converged; the caller holds the entry's lock."""
        for part in self._folder.glob(f"{path.stem}.*.part"):
            # Left by a process that was killed while it wrote.
            part.unlink(missing_ok=True)
        prediction = predict(self._model, m)
        if prediction.converged:
            part = self._folder / f"{path.stem}.{uuid.uuid4().hex}.part"
            try:
                try:
                    with part.open("xb") as stream:
                        if self._jacobian:
                            np.savez(stream, y=prediction.y, jacobian=prediction.jacobian)
                        else:
                            np.savez(stream, y=prediction.y)
                        stream.flush()
                        os.fsync(stream.fileno())
                    part.replace(path)
                finally:
                    part.unlink(missing_ok=True)
            except OSError as error:
                raise cannot_write(path, error) from error
        return prediction


def _read(path: Path, parameters: int) -> Prediction | None:
    """A stored prediction; None if there is none, or only what a broken disk left of it."""
    try:
        # Opened here: NumPy leaves what it opened and could not read to the garbage collector.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            y = stored["y"]
            jacobian = (
                stored["jacobian"] if "jacobian" in stored else np.zeros((len(y), parameters))
            )
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        print(f"note: {path} is damaged and is made again", file=sys.stderr)
        return None
    return Prediction(y, jacobian)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}") from error
