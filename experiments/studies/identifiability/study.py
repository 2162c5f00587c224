"""The study of designs: what would have to be observed, and how far the valleys of a model go."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from experiments.common.building.closure import closure_model
from experiments.common.progress import SolveBar, say
from experiments.common.records.findings import finite, vector
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import Outcome
from experiments.common.records.report import answer_of_main
from experiments.common.study import Job, Section, Study
from experiments.studies.identifiability.figures import designs_answer
from experiments.studies.identifiability.findings import Design, Expected, Findings, Joint, Profile
from experiments.studies.identifiability.observed_sets import SETS, vertex_set
from experiments.studies.identifiability.report import (
    identifiability_words,
    write_identifiability,
)
from experiments.studies.identifiability.settings import DesignsSettings, Settings
from mvest.closure.cycle.model import CycleModel
from mvest.closure.cycle.protocol import CycleProtocol
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.estimation.information import design as information
from mvest.estimation.information import profile as profiles
from mvest.estimation.prediction import ObservationModel, Prediction
from mvest.estimation.transform import Log
from mvest.estimation.wrappers import rows_of, stacked
from mvest.observation.errors import SpatialCorrelation
from mvest.reporting.expectation import alike
from mvest.typing import BoolArray, FloatArray

__all__ = ["STUDY", "run_identifiability"]

Values = Mapping[str, Any]

OFF = 4.0
"""Standard deviations of the bound up to which the grid of a profile goes, within its reach."""


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Some frames of the valve: words, and their Jacobians ``(3n, p)``."""

    label: str
    jacobians: tuple[FloatArray, ...]


def run_identifiability(job: Job[Settings]) -> Outcome[Findings]:
    """Jacobians of one run per set of frames, all designs from them, and profiles.

    Raises
    ------
    ConfigurationError
        If the truth does not have one value for each parameter, or a profile has no reach.
    """
    config, settings = job.values, job.settings.designs
    values = np.array(config["truth"]["values"], dtype=float)
    names = tuple(config["parameters"])
    if values.shape != (len(names),):
        raise ConfigurationError(f"truth.values has {values.size} values for {', '.join(names)}")
    peak = config["mechanics"]["protocol"]["pressure_mmHg"]
    closures = {p: _closure(config, names, p) for p in (*settings.pressures_mmHg, peak)}
    reference = closures[peak]
    findings = Findings(assumed=vector(values), settings=settings)
    closed, reason = _closed(closures, values)
    if reason:
        return outcome_of(findings, reference.mesh, len(closures), [reason])
    frames = _static_frames(closed, peak)
    cycle, reason = _cycle_frames(settings, config, names, values)
    if reason:
        return outcome_of(findings, reference.mesh, len(closures), [reason])
    observed = config["observation"]
    sets = {name: vertex_set(name, observed["columns"], observed["rows"]) for name in SETS}
    findings = replace(
        findings,
        designs=tuple(_designs(settings, reference, frames + cycle, sets, values, names)),
        profiles=tuple(_profiles(settings, config, names, values, sets)),
    )
    return outcome_of(findings, reference.mesh, len(closures) + len(cycle))


def _closure(config: Values, names: tuple[str, ...], pressure: float) -> ClosureModel:
    model = closure_model(config)
    protocol = replace(model.settings.protocol, pressure_mmHg=pressure)
    return replace(
        model,
        names=names,
        fixed={**config["fixed"]},
        settings=replace(model.settings, protocol=protocol),
        continuation=True,
    )


def _closed(
    closures: Mapping[float, ClosureModel], values: FloatArray
) -> tuple[dict[float, FloatArray], str]:
    """Jacobian of the closed frame at each pressure, or why there is none."""
    jacobians = {}
    for pressure, model in closures.items():
        steps = len(model.settings.protocol.steps())
        with SolveBar(f"closed at {pressure:g} mmHg", steps, 1) as bar:
            model.on_step = bar.step
            prediction = model(values)
        if not prediction.converged:
            return {}, f"closed at {pressure:g} mmHg: {prediction.reason}"
        jacobians[pressure] = prediction.jacobian[len(prediction.y) // 2 :]
    return jacobians, ""


def _static_frames(closed: Mapping[float, FloatArray], peak: float) -> list[Frames]:
    others = sorted(p for p in closed if p != peak)
    open_ = np.zeros_like(closed[peak])
    frames = [
        Frames("closed", (closed[peak],)),
        # The open valve is the model's own shape at rest, which depends on no parameter.
        Frames("open and closed", (open_, closed[peak])),
    ]
    for pressure in others:
        label = f"closed at {pressure:g} and {peak:g} mmHg"
        frames.append(Frames(label, (closed[pressure], closed[peak])))
    return frames


def _cycle_frames(
    settings: DesignsSettings, config: Values, names: tuple[str, ...], values: FloatArray
) -> tuple[list[Frames], str]:
    times = settings.cycle_times
    if not times:
        return [], ""
    pressure = config["mechanics"]["protocol"]["pressure_mmHg"]
    protocol = CycleProtocol(pressure_mmHg=pressure, dt=settings.cycle_dt, times=times)
    prediction = CycleModel(_closure(config, names, pressure), protocol)(values)
    if not prediction.converged:
        return [], f"whole cycle: {prediction.reason}"
    parts = np.split(prediction.jacobian, len(times))
    return [Frames(f"whole cycle, {len(times)} frames", tuple(parts))], ""


def _designs(
    settings: DesignsSettings,
    model: ClosureModel,
    frames: Sequence[Frames],
    sets: Mapping[str, BoolArray],
    values: FloatArray,
    names: tuple[str, ...],
) -> Iterator[Design]:
    length = settings.correlation_length_mm
    correlation = SpatialCorrelation(model.valve.surface.vertices, length)
    for (name, members), correlated in product(sets.items(), (False, True)):
        R = correlation.of(members).noise(1.0, 3) if correlated else 1.0
        rows = np.repeat(members, 3)
        for some in frames:
            parts = [information.Design.of(H[rows], R, values, names) for H in some.jacobians]
            design = information.together(*parts)
            yield Design(
                frames=some.label,
                frame_count=len(parts),
                vertices=name,
                vertices_words=SETS[name][0],
                points=int(members.sum()),
                errors=f"correlated over {length:g} mm" if correlated else "independent",
                moduli=tuple(_expected(settings, design)),
                joint=_joint(settings, design) if name == "all" else None,
                pressure=_needed_pressure(settings, design),
            )


def _moduli(design: information.Design) -> list[str]:
    return [name for name in design.names if name.startswith("E_f.")]


def _expected(settings: DesignsSettings, design: information.Design) -> Iterator[Expected]:
    """Each modulus with each knowledge of the nuisances."""
    target = settings.target
    for (knowledge, stds), name in product(settings.knowledge.items(), _moduli(design)):
        yield Expected(
            knowledge,
            name,
            {f"{noise:g}": finite(design.std(name, noise, stds)) for noise in settings.noise_mm},
            finite(design.needed_noise(name, target, stds)),
            finite(design.needed_repeats(name, target, settings.typical_mm, stds)),
        )


def _joint(settings: DesignsSettings, design: information.Design) -> Joint:
    """Relative covariance with the parameters of the profiles, nothing known of them."""
    bound = design.at(settings.typical_mm, dict.fromkeys(settings.known, 0.0))
    return Joint(
        tuple(bound.names),
        tuple(tuple(map(finite, row)) for row in bound.covariance),
        alike(bound),
        finite(bound.condition_number),
    )


def _needed_pressure(
    settings: DesignsSettings, design: information.Design
) -> dict[str, float | None]:
    """How well the pressure must be known for each modulus, the rest half known."""
    pressure = "pressure_scale"
    if pressure not in design.names:
        return {}
    half = settings.knowledge.get(settings.believed, {})
    asked = settings.target, settings.typical_mm, pressure, half
    return {name: finite(design.needed_knowledge(name, *asked)) for name in _moduli(design)}


def _profiles(
    settings: DesignsSettings,
    config: Values,
    names: tuple[str, ...],
    values: FloatArray,
    sets: Mapping[str, BoolArray],
) -> Iterator[Profile]:
    """Profiles of the noise-free observation, weighed with the typical noise."""
    free = [k for k, name in enumerate(names) if name not in settings.known]
    held = {**config["fixed"], **{n: float(values[names.index(n)]) for n in settings.known}}
    own = tuple(names[k] for k in free)
    for chosen in settings.followed:
        rows = np.repeat(sets[chosen.vertices], 3)
        closed_rows = np.concatenate([np.zeros_like(rows), rows])
        models = tuple(
            replace(_closure(config, own, pressure), fixed=held)
            for pressure in chosen.pressures_mmHg
        )
        model = stacked([rows_of(one, closed_rows) for one in models])
        first = model(values[free])
        closed = [m.closed for m in models]
        for k, name in enumerate(own):
            # Each begins from the same closed states, so that their order plays no part.
            for one, state in zip(models, closed, strict=True):
                one.restart(state)
            done = _followed(settings, model, first, values[free], k, own)
            say(f"{chosen.label}, {name}: {done.low:.4g} to {done.high:.4g}")
            yield Profile(
                label=chosen.label,
                vertices=chosen.vertices,
                parameter=done.name,
                parameters=tuple(done.names),
                path=tuple(map(vector, done.path)),
                deviance=vector(done.deviance),
                threshold=done.threshold,
                low=finite(done.low),
                high=finite(done.high),
                ends=done.ends,
            )


def _followed(
    settings: DesignsSettings,
    model: ObservationModel,
    first: Prediction,
    start: FloatArray,
    k: int,
    names: tuple[str, ...],
) -> profiles.Profile:
    variance = settings.typical_mm**2
    design = information.Design.of(first.jacobian, variance, start, names)
    reach = min(settings.reach.get(names[k], np.inf), OFF * design.std(names[k], 1.0))
    if not np.isfinite(reach):
        raise ConfigurationError(f"designs.reach has no {names[k]}, which has no bound of its own")
    steps = np.linspace(0.0, reach, settings.points + 1)[1:]
    return profiles.profile(
        model,
        first.y,
        variance,
        start,
        k,
        np.concatenate([-steps, steps]),
        names=names,
        transform=Log(),
    )


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_identifiability,
    words=identifiability_words,
    write=write_identifiability,
    sections=(
        Section(
            "identifiability",
            {
                "identifiability_designs": "Expected standard deviation of a modulus with each "
                "design: which vertices are seen, with which errors, in which frames, and what is "
                "known of the nuisances; dark where the target is met. Simulated.",
                "identifiability_profiles": "Profile likelihoods: the smallest misfit with one "
                "parameter held, and how the "
                "others then make up for it. Simulated.",
                "identifiability_valley": "95 % regions of a modulus with a nuisance, for "
                "different frames; the floor "
                "of the valley that the profile followed. Simulated.",
            },
            answer=answer_of_main(lambda record: f"{designs_answer(record.findings)} (simulated)."),
        ),
    ),
)
