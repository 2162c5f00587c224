"""What ``check=true`` says of a synthetic study: the answer of the Fisher information."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.twin import build_twin
from experiments.common.progress import SolveBar
from mvest.estimation.prediction import Prediction
from mvest.estimation.wrappers import SharedStart
from mvest.problem.expectation import expect
from mvest.provenance import config_hash
from mvest.reporting.expectation import expectation_text, unknown_text
from mvest.typing import FloatArray

OF_THE_MODEL = ("valve", "mesh", "mechanics", "parameters", "fixed", "guided")
"""Parts of a configuration on which a closure depends, besides where it is computed."""


@dataclass(slots=True)
class TwinExpectation:
    """Answers for synthetic studies; jobs of a sweep that begin alike share their closure."""

    _known: dict[str, Prediction] = field(default_factory=dict)

    def __call__(self, config: Mapping[str, Any], _folder: Path | None = None) -> str:
        """The answer for one configuration.

        Raises
        ------
        MvestError
            If a setting is inadmissible.
        """
        twin = build_twin(config)
        start = twin.problem.start
        observed = config["observation"]
        key = config_hash(
            {part: config[part] for part in OF_THE_MODEL}
            | {"at": start.tolist(), "observed": [observed["columns"], observed["rows"]]}
        )
        with SolveBar(config["name"], len(twin.model.settings.protocol.steps()), 1) as bar:
            twin.model.on_step = bar.step
            if key not in self._known:
                self._known[key] = SharedStart(twin.model, start)(start)
        first = self._known[key]

        def model(m: FloatArray) -> Prediction:
            return first if np.array_equal(m, start) else Prediction.failed("not the start")

        title = f"{config['name']}, {config['row']}"
        data = twin.observe(model, start, np.random.default_rng(0))
        if data.observation is None:
            return unknown_text(title, first.reason)
        std = np.sqrt(np.atleast_1d(np.asarray(config["filter"]["R"], dtype=float)))
        noise = noise_words("assumed", std.tolist(), config["filter"]["R_correlation_mm"])
        return expectation_text(
            title, expect(replace(twin.problem, model=model), data.observation), noise
        )


def noise_words(known: str, std_mm: Sequence[float], length_mm: float) -> str:
    """How well coordinates are "assumed" or "stated" to be seen."""
    errors = f"correlated over {length_mm:g} mm" if length_mm else "independent"
    return f"{' and '.join(f'{s:.3g}' for s in std_mm)} mm of noise {known}, {errors}"
