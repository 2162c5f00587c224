"""The study of designs: what would have to be observed, and how far the valleys of a model go."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import closure_model
from experiments.common.forward import forward_record
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.progress import SolveBar
from experiments.common.study import Section, Study
from experiments.studies.identifiability.observed_sets import SETS, vertex_set
from experiments.studies.identifiability.report import (
    identifiability_text,
    write_identifiability_study,
)
from experiments.studies.identifiability.settings import Settings
from mvest.closure.cycle.model import CycleModel
from mvest.closure.cycle.protocol import CycleProtocol
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.estimation.information.design import Design, together
from mvest.estimation.information.profile import Profile, profile
from mvest.estimation.prediction import ObservationModel, Prediction
from mvest.estimation.transform import Log
from mvest.estimation.wrappers import rows_of, stacked
from mvest.observation.errors import SpatialCorrelation
from mvest.reporting.expectation import confounded_record
from mvest.typing import BoolArray, FloatArray

__all__ = ["STUDY", "run_identifiability"]

Values = Mapping[str, Any]

OFF = 4.0
"""Standard deviations of the bound up to which the grid of a profile goes, within its reach."""

MODULUS = "E_f."


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Some frames of the valve: words, and their Jacobians ``(3n, p)``."""

    label: str
    jacobians: tuple[FloatArray, ...]


def run_identifiability(
    config: Values, config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """Jacobians of one run per set of frames, all designs from them, and profiles."""
    told = config["designs"]
    if told is None:
        raise ConfigurationError(
            "designs is not given; expected what experiment=identifiability has"
        )
    values = np.array(config["truth"]["values"], dtype=float)
    names = tuple(config["parameters"])
    if values.shape != (len(names),):
        raise ConfigurationError(f"truth.values has {values.size} values for {', '.join(names)}")
    peak = config["mechanics"]["protocol"]["pressure_mmHg"]
    closures = {p: _closure(config, names, p) for p in (*told["pressures_mmHg"], peak)}
    reference = closures[peak]
    record = forward_record(config, config_hash, reference, values, started, 0)
    closed, reason = _closed(closures, values)
    if reason:
        return record | {"status": "failed", "reason": reason}, []
    frames = _static_frames(closed, peak)
    cycle, reason = _cycle_frames(told, config, names, values)
    if reason:
        return record | {"status": "failed", "reason": reason}, []
    frames += cycle
    sets = {
        name: vertex_set(name, config["observation"]["columns"], config["observation"]["rows"])
        for name in SETS
    }
    designs = list(_designs(told, reference, frames, sets, values, names))
    record |= {
        "assumed": values.tolist(),
        "settings": dict(told),
        "designs": [row for made in designs for row in _rows(told, made)],
        "ellipses": [_ellipse(told, made) for made in designs if made[0]["vertices"] == "all"],
        "pressure": [_needed_pressure(told, made, names) for made in designs],
        "profiles": _profiles(told, config, names, values, sets),
        "forward_solves": len(closures) + len(cycle),
    }
    record["seconds"] = record["seconds_total"] = time.time() - started
    return record, []


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
    found = {}
    for pressure, model in closures.items():
        steps = len(model.settings.protocol.steps())
        with SolveBar(f"closed at {pressure:g} mmHg", steps, 1) as bar:
            model.on_step = bar.step
            prediction = model(values)
        if not prediction.converged:
            return {}, f"closed at {pressure:g} mmHg: {prediction.reason}"
        found[pressure] = prediction.jacobian[len(prediction.y) // 2 :]
    return found, ""


def _static_frames(closed: Mapping[float, FloatArray], peak: float) -> list[Frames]:
    others = sorted(p for p in closed if p != peak)
    open_ = np.zeros_like(closed[peak])
    found = [
        Frames("closed", (closed[peak],)),
        # The open valve is the model's own shape at rest, which depends on no parameter.
        Frames("open and closed", (open_, closed[peak])),
    ]
    for pressure in others:
        label = f"closed at {pressure:g} and {peak:g} mmHg"
        found.append(Frames(label, (closed[pressure], closed[peak])))
    return found


def _cycle_frames(
    told: Values, config: Values, names: tuple[str, ...], values: FloatArray
) -> tuple[list[Frames], str]:
    times = tuple(told["cycle_times"])
    if not times:
        return [], ""
    pressure = config["mechanics"]["protocol"]["pressure_mmHg"]
    protocol = CycleProtocol(pressure_mmHg=pressure, dt=told["cycle_dt"], times=times)
    prediction = CycleModel(_closure(config, names, pressure), protocol)(values)
    if not prediction.converged:
        return [], f"whole cycle: {prediction.reason}"
    parts = np.split(prediction.jacobian, len(times))
    return [Frames(f"whole cycle, {len(times)} frames", tuple(parts))], ""


Made = tuple[dict[str, Any], Design]
"""What a design is of, and the design."""


def _designs(
    told: Values,
    model: ClosureModel,
    frames: Sequence[Frames],
    sets: Mapping[str, BoolArray],
    values: FloatArray,
    names: tuple[str, ...],
) -> Any:
    length = told["correlation_length_mm"]
    correlation = SpatialCorrelation(model.valve.surface.vertices, length)
    for (name, members), correlated in product(sets.items(), (False, True)):
        R = correlation.of(members).noise(1.0, 3) if correlated else 1.0
        rows = np.repeat(members, 3)
        for some in frames:
            parts = [Design.of(H[rows], R, values, names) for H in some.jacobians]
            about = {
                "frames": some.label,
                "frame_count": len(parts),
                "vertices": name,
                "vertices_words": SETS[name][0],
                "points": int(members.sum()),
                "errors": f"correlated over {length:g} mm" if correlated else "independent",
            }
            yield about, together(*parts)


def _rows(told: Values, made: Made) -> list[dict[str, Any]]:
    """One row for each modulus and each knowledge of the nuisances."""
    about, design = made
    rows = []
    for (knowledge, stds), name in product(told["knowledge"].items(), design.names):
        if not name.startswith(MODULUS):
            continue
        needed = design.needed_noise(name, told["target"], stds)
        repeats = design.needed_repeats(name, told["target"], told["typical_mm"], stds)
        rows.append(
            about
            | {
                "knowledge": knowledge,
                "parameter": name,
                "std": {
                    f"{noise:g}": _finite(design.std(name, noise, stds))
                    for noise in told["noise_mm"]
                },
                "needed_noise_mm": _finite(needed),
                "needed_repeats": _finite(repeats),
            }
        )
    return rows


def _ellipse(told: Values, made: Made) -> dict[str, Any]:
    """Relative covariance with the parameters of the profiles, nothing known of them."""
    about, design = made
    found = design.at(told["typical_mm"], dict.fromkeys(told["known"], 0.0))
    return about | {
        "names": list(found.names),
        "covariance": [[_finite(v) for v in row] for row in found.covariance],
        "confounded": confounded_record(found),
        "condition_number": _finite(found.condition_number),
    }


def _needed_pressure(told: Values, made: Made, names: Sequence[str]) -> dict[str, Any]:
    """How well the pressure must be known for each modulus, the rest half known."""
    about, design = made
    half = told["knowledge"].get(told["believed"], {})
    about = about | {"knowledge": {k: v for k, v in half.items() if k != "pressure_scale"}}
    if "pressure_scale" not in names:
        return about | {"needed": {}}
    return about | {
        "needed": {
            name: _finite(
                design.needed_knowledge(
                    name, told["target"], told["typical_mm"], "pressure_scale", half
                )
            )
            for name in names
            if name.startswith(MODULUS)
        }
    }


def _profiles(
    told: Values,
    config: Values,
    names: tuple[str, ...],
    values: FloatArray,
    sets: Mapping[str, BoolArray],
) -> list[dict[str, Any]]:
    """Profiles of the noise-free observation, weighed with the typical noise."""
    free = [k for k, name in enumerate(names) if name not in told["known"]]
    held = {**config["fixed"], **{n: float(values[names.index(n)]) for n in told["known"]}}
    own = tuple(names[k] for k in free)
    found = []
    for chosen in told["followed"]:
        rows = np.repeat(sets[chosen["vertices"]], 3)
        closed_rows = np.concatenate([np.zeros_like(rows), rows])
        models = tuple(
            replace(_closure(config, own, pressure), fixed=held)
            for pressure in chosen["pressures_mmHg"]
        )
        model = stacked([rows_of(one, closed_rows) for one in models])
        first = model(values[free])
        closed = [m.closed for m in models]
        for k, name in enumerate(own):
            # Each begins from the same closed states, so that their order plays no part.
            for one, state in zip(models, closed, strict=True):
                one.restart(state)
            done = _followed(told, model, first, values[free], k, own)
            print(
                f"{chosen['label']}, {name}: {done.low:.4g} to {done.high:.4g}",
                file=sys.stderr,
                flush=True,
            )
            found.append(_plain(done, chosen))
    return found


def _followed(
    told: Values,
    model: ObservationModel,
    first: Prediction,
    start: FloatArray,
    k: int,
    names: tuple[str, ...],
) -> Profile:
    variance = told["typical_mm"] ** 2
    design = Design.of(first.jacobian, variance, start, names)
    reach = min(told["reach"].get(names[k], np.inf), OFF * design.std(names[k], 1.0))
    if not np.isfinite(reach):
        raise ConfigurationError(f"designs.reach has no {names[k]}, which has no bound of its own")
    steps = np.linspace(0.0, reach, told["points"] + 1)[1:]
    return profile(
        model,
        first.y,
        variance,
        start,
        k,
        np.concatenate([-steps, steps]),
        names=names,
        transform=Log(),
    )


def _plain(found: Profile, chosen: Values) -> dict[str, Any]:
    return {
        "label": chosen["label"],
        "vertices": chosen["vertices"],
        "parameter": found.name,
        "parameters": list(found.names),
        "path": found.path.tolist(),
        "deviance": found.deviance.tolist(),
        "threshold": found.threshold,
        "low": _finite(found.low),
        "high": _finite(found.high),
        "ends": list(found.ends),
    }


def _finite(value: float) -> float | None:
    """Infinity, which JSON lacks, as None."""
    return float(value) if np.isfinite(value) else None


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_identifiability),
    words=lambda record: identifiability_text(flat(record)),
    write=each(write_identifiability_study),
    sections=(
        Section(
            "identifiability",
            {
                "identifiability_designs": "Expected standard deviation of a modulus with each "
                "design: which vertices are seen, with which errors, in which frames, and what is "
                "known of the nuisances; dark where the target is met. Simulated.",
                "identifiability_profiles": "Profile likelihoods: the least misfit with one "
                "parameter held, and how the "
                "others then make up for it. Simulated.",
                "identifiability_valley": "95 % regions of a modulus with a nuisance, for "
                "different frames; the floor "
                "of the valley that the profile followed. Simulated.",
            },
        ),
    ),
)
