"""A stiff patch of one leaflet, found by a modulus that may vary over it.

The truth has the patch and another mesh; the estimator has the smooth field of the configuration,
in whose span the patch does not lie. The same is done with a truth without a patch: what the field
shows there is what the other mesh and the noise alone leave behind.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import build_filter, mechanics_of, template_of
from experiments.common.expectation import foresee_cycle
from experiments.common.forward import forward_record
from experiments.common.plain import Plain, each, flat, plain_run
from experiments.common.progress import TYPICAL_SOLVES, SolveBar
from experiments.common.study import Section, Study
from experiments.common.whole_cycle import cycle_model, shift_by_check_mesh, stored_cycle
from experiments.studies.patch.report import patch_text, write_patch
from experiments.studies.patch.settings import Settings
from mvest.closure.cycle.observation import CycleObservation
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.prediction import ObservationModel
from mvest.estimation.transform import to_filter
from mvest.mechanics.law.field import FieldBasis
from mvest.mechanics.settings import StiffPatch
from mvest.typing import FloatArray

__all__ = ["STUDY", "run_patch_study"]

Values = Mapping[str, Any]


def run_patch_study(
    config: Values, config_hash: str, folder: Path, started: float
) -> tuple[dict[str, Any], list[Path]]:
    """Estimate moduli and field from a valve with the patch, and from one without if asked."""
    settings, parameters = config["cycle"], tuple(config["parameters"])
    _, transform, prior = build_filter(config["filter"], parameters)
    patch = _patch(config)
    model = cycle_model(config)
    leaflet = _Leaflet(config, parameters, patch)
    noise, start, results = settings["noise_mm"], prior.mean, {}
    seen: ObservationModel | None = None
    valves: dict[str, dict[str, StiffPatch]] = {"patch": {"patch": patch}}
    if config["patch"]["compared"]:
        valves["no patch"] = {}
    for label, patches in valves.items():
        frames = _truth(config, patches)
        rng = np.random.default_rng(config["seed"])
        observation = CycleObservation.simulated(frames, noise, rng)
        seen = seen or observation.of(stored_cycle(config, model))
        filter_ = IteratedFilter(
            config["filter"]["tolerance"],
            max_iterations=config["filter"]["max_iterations"],
            start=tuple(map(float, start)),
        )
        with SolveBar(label, len(model.protocol.steps()), TYPICAL_SOLVES, parameters) as bar:
            model.closure.on_step = bar.step
            found = filter_(
                seen,
                prior,
                observation.y,
                observation.R,
                names=parameters,
                transform=transform,
                on_iterate=bar.iterate,
            )
        print(f"{label}: {found.reason.value}, {found.detail}", file=sys.stderr, flush=True)
        told = shift_by_check_mesh(config, found, seen, prior, observation)
        shift = None if isinstance(told, str) else told.shift
        results[label] = {
            "status": "converged" if found.converged else "failed",
            "reason": found.reason.value,
            "estimate": found.mean.tolist(),
            "std": found.transformed.std.tolist(),
            "runs": found.forward_solves,
            "residual_mm": found.residual_rms(observation.y),
            **leaflet.compared(found, shift, bool(patches)),
            "shift_unknown": told if isinstance(told, str) else "",
        }
        start = found.mean
    truth = np.array(config["truth"]["values"], dtype=float)
    record = forward_record(config, config_hash, model.closure, truth, started, 0)
    record |= {
        "patch": asdict(patch),
        "field": asdict(leaflet.field) | {"share": leaflet.basis.share},
        "noise_mm": noise,
        "times": list(model.protocol.times),
        "vertices": len(model.closure.valve.surface.vertices),
        "cells_of_truth": [settings["finer_columns"], settings["finer_rows"]],
        "prior_std": to_filter(transform, prior).std.tolist(),
        "map": leaflet.places(),
        "results": results,
        "measures": {
            key: results["patch"][key]
            for key in ("at_centre", "peak", "peak_distance_mm", "rms_log_error", "within_two_std")
        },
        "forward_solves": sum(entry["runs"] for entry in results.values()),
    }
    failed = [entry for entry in results.values() if entry["status"] != "converged"]
    if failed:
        record |= {"status": "failed", "reason": failed[0]["reason"]}
    record["seconds"] = record["seconds_total"] = time.time() - started
    return record, []


def _patch(config: Values) -> StiffPatch:
    given = config["patch"]
    angle, share = np.array([float(given["angle_deg"])]), np.array([float(given["share"])])
    centre = template_of(config).position(angle, share)[0]
    return StiffPatch(
        given["region"], tuple(map(float, centre)), given["radius_mm"], given["factor"]
    )


def _truth(config: Values, patches: Mapping[str, StiffPatch]) -> FloatArray:
    """Frames ``(f, n, 3)`` mm of a valve whose modulus is no field, on a mesh of its own."""
    settings = config["cycle"]
    mesh = {
        **config["mesh"],
        "columns": settings["finer_columns"],
        "rows": settings["finer_rows"],
    }
    plain = {name: {**asdict(p), "centre": list(p.centre)} for name, p in patches.items()}
    mechanics = {**config["mechanics"], "fields": {}, "patches": plain}
    moduli = [name for name in config["parameters"] if name.startswith("E_f.")]
    values = np.array(config["truth"]["values"], dtype=float)
    if len(values) != len(moduli):
        raise ConfigurationError(
            f"truth.values has {len(values)} values; expected one for each of {', '.join(moduli)}"
        )
    maker = cycle_model(
        {**config, "mesh": mesh, "mechanics": mechanics, "parameters": moduli},
        dt=settings["protocol"]["dt"] * settings["finer_dt_factor"],
    )
    return maker.frames(values)


class _Leaflet:
    """The leaflet with the field: its points, and the modulus there."""

    def __init__(self, config: Values, parameters: tuple[str, ...], patch: StiffPatch) -> None:
        observed = config["observation"]
        template = template_of(config)
        surface = template.valve(observed["columns"], observed["rows"]).surface
        fields = mechanics_of(config).fields
        if list(fields) != [patch.region]:
            raise ConfigurationError(
                f"mechanics.fields has {', '.join(fields) or 'none'}; expected one of "
                f"{patch.region}, where the patch is"
            )
        self.patch, self.field = patch, fields[patch.region]
        self.basis = FieldBasis.of(surface, patch.region, self.field)
        own = surface.triangles[surface.region == surface.region_names.index(patch.region)]
        self.vertices, triangles = np.unique(own, return_inverse=True)
        self.triangles = triangles.reshape(own.shape)
        self.points = surface.vertices[self.vertices]
        self.areas = surface.areas[self.vertices]
        row, column = np.divmod(self.vertices, observed["columns"])
        angle, share = 360.0 * column / observed["columns"], row / (observed["rows"] - 1)
        # Unrolled: along the annulus, and down the leaflet.
        turn = np.linspace(0.0, 360.0, 721)
        step = np.linalg.norm(np.diff(template.position(turn, 0 * turn), axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(step)])
        centre = float(config["patch"]["angle_deg"])
        self.along = np.interp(angle, turn, along) - np.interp(centre, turn, along)
        self.down = share * template.length(angle)
        # log E_f at the points is this times the filter's coordinates.
        self.rows = np.zeros((len(self.points), len(parameters)))
        modes = self.basis(self.points)
        for k, name in enumerate(parameters):
            kind, _, part = name.partition(".")
            if name == f"E_f.{patch.region}":
                self.rows[:, k] = 1.0
            elif kind == "field":
                self.rows[:, k] = modes[:, int(part.rpartition(".")[2])]
        self.log_base = float(np.log(config["truth"]["values"][parameters.index(
            f"E_f.{patch.region}")]))  # fmt: skip

    def places(self) -> dict[str, Any]:
        """Where the points are on the unrolled leaflet, and their triangles."""
        return {
            "along_mm": np.round(self.along, 3).tolist(),
            "down_mm": np.round(self.down, 3).tolist(),
            "triangles": self.triangles.tolist(),
        }

    def compared(
        self, found: Estimate, shift: FloatArray | None, has_patch: bool
    ) -> dict[str, Any]:
        """The modulus that was found beside the true one.

        Standard deviations are of the noise; ``shift (p,)`` is by the mesh, None if not known.
        """
        z = found.transformed
        log = self.rows @ z.mean
        std = np.sqrt(np.einsum("ij,jk,ik->i", self.rows, z.covariance, self.rows))
        raised = self.patch.log_scale(self.points)
        truth = self.log_base + (raised if has_patch else np.zeros_like(raised))
        distance = np.linalg.norm(self.points - np.array(self.patch.centre), axis=1)
        middle, peak = int(np.argmin(distance)), int(np.argmax(log))
        outside = distance > self.patch.radius_mm
        weight = self.areas / self.areas.sum()
        error = log - truth
        told: dict[str, float | None] = {"shift_rms": None, "within_two_with_shift": None}
        if shift is not None:
            moved = self.rows @ shift
            told["shift_rms"] = float(np.sqrt(np.sum(weight * moved**2)))
            inside = np.abs(error) <= 2 * np.hypot(std, moved)
            told["within_two_with_shift"] = float(np.sum(weight[inside]))
        return told | {
            "truth": np.exp(truth).tolist(),
            "modulus": np.exp(log).tolist(),
            "log_std": std.tolist(),
            "at_centre": float(np.exp(log[middle])),
            "true_at_centre": float(np.exp(truth[middle])),
            "log_std_at_centre": float(std[middle]),
            "peak": float(np.exp(log[peak])),
            "peak_log_std": float(std[peak]),
            "peak_distance_mm": float(distance[peak]),
            "outside": float(np.exp(np.average(log[outside], weights=weight[outside]))),
            "rms_log_error": float(np.sqrt(np.sum(weight * error**2))),
            "within_two_std": float(np.sum(weight[np.abs(error) <= 2 * std])),
        }


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_patch_study),
    words=lambda record: patch_text(flat(record)),
    write=each(write_patch),
    checks=lambda: (foresee_cycle,),
    sections=(
        Section(
            "patch",
            {
                "patch": "True and estimated modulus of the unrolled anterior leaflet, and "
                "how sure. "
                "Simulated."
            },
        ),
    ),
)
