"""Synthetic observations that several studies share are simulated once.

The key covers everything that can change the simulated positions: the truth's part of the
configuration and the code of the forward model. Entries are written whole or not at all.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Mapping
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np

import mvest
from mvest.estimation import ObservationModel, Prediction
from mvest.provenance import config_hash
from mvest.typing import FloatArray

__all__ = ["StoredModel", "truth_key"]

FORWARD_MODEL = ("elements.py", "units.py", "model.py", "mechanics", "valve")
"""Files and folders of the library that decide what a closure gives."""


def truth_key(values: Mapping[str, Any]) -> str:
    """Key of a simulation described by plain values, for the present source of the library."""
    root = Path(mvest.__file__).parent
    source = hashlib.sha256()
    for part in FORWARD_MODEL:
        place = root / part
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            source.update(_code(path).encode())
    return config_hash({"source": source.hexdigest(), **values})


def _code(path: Path) -> str:
    """What a file does: its syntax tree without comments, layout and docstrings."""
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
    """A model whose converged predictions are kept on disk, without their Jacobian.

    Parameters
    ----------
    model : ObservationModel
    folder : Path
    key : str
        See :func:`truth_key`; the parameters are added to it.
    """

    def __init__(self, model: ObservationModel, folder: Path, key: str) -> None:
        self._model = model
        self._folder = folder
        self._key = key

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Prediction at ``m (p,)``, read from disk if it is there; its Jacobian is zero."""
        name = config_hash({"key": self._key, "m": [float(v).hex() for v in m]})
        path = self._folder / f"{name}.npz"
        if path.is_file():
            with np.load(path, allow_pickle=False) as stored:
                y = stored["y"]
            return Prediction(y, np.zeros((len(y), len(m))))
        prediction = self._model(m)
        if prediction.converged:
            self._folder.mkdir(parents=True, exist_ok=True)
            with NamedTemporaryFile(dir=self._folder, suffix=".part", delete=False) as part:
                np.savez(part, y=prediction.y)
            Path(part.name).replace(path)
        return prediction
