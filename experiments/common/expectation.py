"""What ``check=true`` says before any data are taken: the answer of the Fisher information."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.closure import mesh_store
from experiments.common.building.filters import build_filter
from experiments.common.building.twin import Twin, build_twin
from experiments.common.building.whole_cycle import cycle_model, stored_cycle
from experiments.common.progress import SolveBar
from experiments.common.schema import build
from mvest.closure.cycle.protocol import CycleProtocol
from mvest.estimation.prediction import Prediction
from mvest.estimation.wrappers import SharedStart
from mvest.personalisation.design import design_text
from mvest.personalisation.expectation import foresee_case
from mvest.problem.expectation import Expectation, expect, expect_of_model
from mvest.provenance import config_hash
from mvest.reporting.expectation import expectation_text
from mvest.typing import FloatArray

__all__ = ["TwinExpectation", "expect_cycle", "expect_own"]

Values = Mapping[str, Any]

OF_THE_MODEL = ("valve", "mesh", "mechanics", "parameters", "fixed", "guided")
"""Parts of a configuration on which a closure depends, besides where it is computed."""


@dataclass(slots=True)
class TwinExpectation:
    """Answers for synthetic studies; jobs of a sweep that begin alike share their closure."""

    _known: dict[str, Prediction] = field(default_factory=dict)

    def __call__(self, config: Values, _folder: Path | None = None) -> str:
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
        title = f"{config['name']}, {config['row']}"
        return _words(title, _expected_at_start(twin, self._known[key], start), _noise(config))


def _expected_at_start(twin: Twin, first: Prediction, start: FloatArray) -> Expectation | str:
    """What to expect where the model is known at the start alone; the reason if it is not."""

    def model(m: FloatArray) -> Prediction:
        return first if np.array_equal(m, start) else Prediction.failed("not the start")

    if not first.converged:
        return first.reason
    data = twin.observe(model, start, np.random.default_rng(0))
    assert data.observation is not None
    return expect(replace(twin.problem, model=model), data.observation)


def _noise(config: Values) -> str:
    """How well coordinates are assumed to be seen, in words."""
    std = np.sqrt(np.atleast_1d(np.asarray(config["filter"]["R"], dtype=float)))
    length = config["filter"]["R_correlation_mm"]
    errors = f"alike over {length:g} mm" if length else "independent"
    return f"{' and '.join(f'{s:.3g}' for s in std)} mm of noise assumed, {errors}"


def expect_own(config: Values, _folder: Path | None = None) -> str:
    """The answer for a case.

    Raises
    ------
    MvestError
        If the case is not in order.
    """
    from experiments.common.cases.own_case import read_configured, settings_of
    from experiments.common.cases.settings import PersonalSettings

    case = read_configured(config["case"])
    if case.closed is None:
        return f"{case.name}: an open frame alone, from which nothing can be estimated"
    settings = settings_of(config, build(PersonalSettings, config["personal"]))
    with SolveBar(case.name, len(settings.mechanics.protocol.steps()), 1) as bar:
        store = mesh_store(config)
        expected, designs = foresee_case(case, settings, store=store, on_step=bar.step)
    uncertainty = case.uncertainty
    length = uncertainty.correlation_length_mm
    errors = f"alike over {length:g} mm" if length else "independent"
    noise = f"{uncertainty.typical_mm:.3g} mm of noise stated, {errors}"
    further = (
        f"{case.name}: what further closed frames would tell is not known ({designs})"
        if isinstance(designs, str)
        else design_text(case.name, designs)
    )
    return f"{_words(case.name, expected, noise)}\n{further}"


def expect_cycle(config: Values, _folder: Path | None = None) -> str:
    """The answer for all frames of a cycle.

    Raises
    ------
    MvestError
        If a setting is inadmissible.
    """
    parameters = tuple(config["parameters"])
    _, transform, prior = build_filter(config["filter"], parameters)
    noise = config["cycle"]["noise_mm"]
    model = cycle_model(config, build(CycleProtocol, config["cycle"]["protocol"]))
    with SolveBar(config["name"], len(model.protocol.steps()), 1) as bar:
        model.closure.on_step = bar.step
        expected = expect_of_model(
            stored_cycle(config, model),
            prior,
            noise**2,
            parameters=parameters,
            transform=transform,
            frames=tuple(f"{t:g} s" for t in model.protocol.times),
        )
    return _words(
        f"{config['name']}, {config['row']}",
        expected,
        f"{noise:g} mm of noise assumed, independent",
    )


def _words(title: str, expected: Expectation | str, noise: str) -> str:
    """What to expect, as text."""
    if isinstance(expected, str) or expected.data is None:
        reason = expected if isinstance(expected, str) else expected.reason
        return (
            f"{title}: what the data will tell is not known, the model has no prediction at the "
            f"assumed parameters ({reason})"
        )
    return expectation_text(
        title,
        expected.assumed,
        expected.prior,
        expected.transform,
        expected.data,
        expected.informed,
        f"{expected.observations} numbers of {', '.join(expected.frames)}; {noise}",
    )
