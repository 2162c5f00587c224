"""A stiff patch of one leaflet, estimated by a modulus that may vary over it.

The truth has the patch and another mesh; the estimator has the smooth field of the configuration,
in whose span the patch does not lie. The same is done with a truth without a patch: what the field
shows there is what the other mesh and the noise alone leave behind.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from experiments.common.building.anatomy import template_of
from experiments.common.building.closure import mechanics_of
from experiments.common.building.cycle_settings import CycleSettings
from experiments.common.building.gate import gate_of
from experiments.common.building.whole_cycle import (
    CycleEstimator,
    cycle_model,
    finer_steps,
    iterated_from,
    shift_by_check_mesh,
    stored_cycle,
)
from experiments.common.expectation import expect_cycle
from experiments.common.progress import say
from experiments.common.records.findings import vector
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import Outcome
from experiments.common.records.report import answer_of_main, write_each
from experiments.common.study import Job, Section, Study
from experiments.studies.patch.findings import Compared, Findings, Fit, Places
from experiments.studies.patch.report import patch_answer, patch_figure, patch_table, patch_words
from experiments.studies.patch.settings import PatchSettings, Settings
from mvest.closure.cycle.observation import CycleObservation
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate
from mvest.estimation.prediction import ObservationModel
from mvest.estimation.transform import to_filter
from mvest.mechanics.law.field import FieldBasis
from mvest.mechanics.settings import StiffPatch
from mvest.typing import BoolArray, FloatArray

__all__ = ["STUDY", "run_patch"]

Values = Mapping[str, Any]


def run_patch(job: Job[Settings]) -> Outcome[Findings]:
    """Estimate moduli and field from a valve with the patch, and from one without if asked.

    Raises
    ------
    ConfigurationError
        If the field is not of the patch's leaflet, or the truth has not one modulus for each.
    InputError
        If the truth has no cycle.
    """
    values, settings = job.values, job.settings.cycle
    estimator = CycleEstimator.of(values, settings.protocol)
    model, prior = estimator.model, estimator.prior
    patch = _patch(values, job.settings.patch)
    leaflet = _Leaflet(values, estimator.parameters, patch, job.settings.patch.angle_deg)
    start, results = prior.mean, {}
    seen: ObservationModel | None = None
    valves: dict[str, dict[str, StiffPatch]] = {"patch": {"patch": patch}}
    if job.settings.patch.compared:
        valves["no patch"] = {}
    for label, patches in valves.items():
        frames = _truth(values, settings, patches)
        rng = np.random.default_rng(values["seed"])
        observation = CycleObservation.simulated(frames, settings.noise_mm, rng)
        seen = seen or observation.of(stored_cycle(values, model))
        found = estimator(label, iterated_from(values, start), seen, observation)
        say(f"{label}: {found.reason.value}, {found.detail}")
        by = shift_by_check_mesh(values, settings, found, seen, prior, observation)
        shift = None if isinstance(by, str) else by.shift
        results[label] = Fit(
            "converged" if found.converged else "failed",
            found.reason.value,
            vector(found.mean),
            vector(found.transformed.std),
            found.forward_solves,
            found.residual_rms(observation.y),
            leaflet.compared(found, shift, bool(patches)),
            by if isinstance(by, str) else "",
        )
        start = found.mean
    compared = results["patch"].compared
    findings = Findings(
        truth=tuple(map(float, values["truth"]["values"])),
        patch=patch,
        field=leaflet.field,
        share=leaflet.basis.share,
        noise_mm=settings.noise_mm,
        times=settings.protocol.times,
        vertices=len(model.closure.valve.surface.vertices),
        cells_of_truth=(settings.finer_columns, settings.finer_rows),
        prior_std=vector(to_filter(estimator.transform, prior).std),
        map=leaflet.places(),
        results=results,
        measures={
            "at_centre": compared.at_centre,
            "peak": compared.peak,
            "peak_distance_mm": compared.peak_distance_mm,
            "rms_log_error": compared.rms_log_error,
            "within_two_std": compared.within_two_std,
        },
    )
    return outcome_of(
        findings,
        model.closure.mesh,
        sum(fit.runs for fit in results.values()),
        (fit.reason for fit in results.values() if fit.status != "converged"),
        gate_of(values),
    )


def _patch(values: Values, given: PatchSettings) -> StiffPatch:
    angle, share = np.array([given.angle_deg]), np.array([given.share])
    centre = template_of(values).position(angle, share)[0]
    return StiffPatch(given.region, tuple(map(float, centre)), given.radius_mm, given.factor)


def _truth(
    values: Values, settings: CycleSettings, patches: Mapping[str, StiffPatch]
) -> FloatArray:
    """Frames ``(f, n, 3)`` mm of a valve whose modulus is no field, on a mesh of its own."""
    mesh = {
        **values["mesh"],
        "columns": settings.finer_columns,
        "rows": settings.finer_rows,
    }
    plain = {name: {**asdict(p), "centre": list(p.centre)} for name, p in patches.items()}
    mechanics = {**values["mechanics"], "fields": {}, "patches": plain}
    moduli = [name for name in values["parameters"] if name.startswith("E_f.")]
    truth = np.array(values["truth"]["values"], dtype=float)
    if len(truth) != len(moduli):
        raise ConfigurationError(
            f"truth.values has {len(truth)} values; expected one for each of {', '.join(moduli)}"
        )
    changed = {**values, "mesh": mesh, "mechanics": mechanics, "parameters": moduli}
    return cycle_model(changed, finer_steps(settings)).frames(truth)


class _Leaflet:
    """The leaflet with the field: its points, and the modulus there."""

    def __init__(
        self, values: Values, parameters: tuple[str, ...], patch: StiffPatch, centre_deg: float
    ) -> None:
        observed = values["observation"]
        template = template_of(values)
        surface = template.valve(observed["columns"], observed["rows"]).surface
        fields = mechanics_of(values).fields
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
        areas = surface.areas[self.vertices]
        self.weight = areas / areas.sum()
        row, column = np.divmod(self.vertices, observed["columns"])
        angle, share = 360.0 * column / observed["columns"], row / (observed["rows"] - 1)
        # Unrolled: along the annulus, and down the leaflet.
        turn = np.linspace(0.0, 360.0, 721)
        step = np.linalg.norm(np.diff(template.position(turn, 0 * turn), axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(step)])
        self.along = np.interp(angle, turn, along) - np.interp(centre_deg, turn, along)
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
        moduli = values["truth"]["values"]
        self.log_base = float(np.log(moduli[parameters.index(f"E_f.{patch.region}")]))

    def places(self) -> Places:
        """Where the points are on the unrolled leaflet, and their triangles."""
        return Places(
            vector(np.round(self.along, 3)),
            vector(np.round(self.down, 3)),
            tuple(map(tuple, self.triangles.tolist())),
        )

    def compared(self, found: Estimate, shift: FloatArray | None, has_patch: bool) -> Compared:
        """The estimated modulus beside the true one.

        ``shift (p,)`` of the filter's coordinates is by the mesh, None if it is not known.
        """
        z = found.transformed
        log = self.rows @ z.mean
        std = np.sqrt(np.einsum("ij,jk,ik->i", self.rows, z.covariance, self.rows))
        raised = self.patch.log_scale(self.points)
        truth = self.log_base + (raised if has_patch else np.zeros_like(raised))
        distance = np.linalg.norm(self.points - np.array(self.patch.centre), axis=1)
        middle, peak = int(np.argmin(distance)), int(np.argmax(log))
        outside = distance > self.patch.radius_mm
        error = log - truth
        moved = None if shift is None else self.rows @ shift
        return Compared(
            truth=vector(np.exp(truth)),
            modulus=vector(np.exp(log)),
            log_std=vector(std),
            at_centre=float(np.exp(log[middle])),
            true_at_centre=float(np.exp(truth[middle])),
            log_std_at_centre=float(std[middle]),
            peak=float(np.exp(log[peak])),
            peak_log_std=float(std[peak]),
            peak_distance_mm=float(distance[peak]),
            outside=float(np.exp(np.average(log[outside], weights=self.weight[outside]))),
            rms_log_error=float(np.sqrt(np.sum(self.weight * error**2))),
            within_two_std=self._share(np.abs(error) <= 2 * std),
            shift_rms=None if moved is None else float(np.sqrt(np.sum(self.weight * moved**2))),
            within_two_with_shift=None
            if moved is None
            else self._share(np.abs(error) <= 2 * np.hypot(std, moved)),
        )

    def _share(self, inside: BoolArray) -> float:
        """Share of the leaflet's area."""
        return float(np.sum(self.weight[inside]))


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_patch,
    words=patch_words,
    write=write_each(patch_table, patch_words, patch_figure),
    checks=lambda: (expect_cycle,),
    sections=(
        Section(
            "patch",
            {
                "patch": "True and estimated modulus of the unrolled anterior leaflet, and how"
                " sure. Simulated."
            },
            answer=answer_of_main(patch_answer),
        ),
    ),
)
