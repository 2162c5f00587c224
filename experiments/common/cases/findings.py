"""Findings of a personalised case, and of a simulated one whose truth was revealed."""

from __future__ import annotations

import resource
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from scipy import sparse

from experiments.common.records.estimate_record import identified_of, innovation_of, seed_run
from experiments.common.records.estimates import Data, SeedRun
from experiments.common.records.findings import vector
from experiments.common.records.record import NOT_GATED, Mesh, Model, Outcome, has_passed
from mvest.cases.case import Role, ValveCase
from mvest.cases.plausibility import doubts
from mvest.closure.frames import ERROR, OFFSET
from mvest.estimation.information.consistency import moran, zero_mean
from mvest.personalisation.indications import indications_of
from mvest.personalisation.result import Personalised
from mvest.problem.estimate import StudyResult
from mvest.problem.registration import unit_of
from mvest.problem.verdict import judge
from mvest.reporting.case.findings import (
    MODULUS,
    NUISANCE,
    About,
    CaseFindings,
    Cost,
    ErrorRow,
    FrameDistances,
    GeometryRow,
    ImageErrors,
    ImageStep,
    ModuliAlone,
    ModulusRow,
    Narrower,
    PosteriorCheck,
    UnknownRow,
    WhitenessTest,
)
from mvest.reporting.findings import Spread, Vector, spread
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.triangles import surface_edges
from mvest.valve.measure.clinical import clinical_measurements

__all__ = ["Findings", "Revealed", "fields_of", "outcome_of_case"]

T = TypeVar("T")

LABELS = {
    "pressure_scale": "pressure (factor)",
    OFFSET: "offset of pressures",
    "chord_stiffness": "chordal stiffness (factor)",
    "chord_rest_length": "chordal rest length (factor)",
    "stiffening": "stiffening",
    "prestretch": "stretch when seen open (factor)",
}


@dataclass(frozen=True, slots=True)
class Revealed:
    """What is said of a virtual patient after its estimation.

    Anatomies were drawn until one closed. Of the paper's patient there are moduli ``(2,)`` MPa and
    the distances ``(2,)`` mm, generic and personalised; empty if it has none. In its world more is
    otherwise than its case says (see `mvest.simulation.world`); empty if nothing is said of it.
    """

    anatomies_drawn: int
    paper_moduli: Vector
    paper_distance_mm: Vector
    world: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What a run computed of a case, and of a virtual patient what was revealed.

    The one of ``repeats`` is of the moduli among its unknowns, by which runs are compared. The
    process took ``memory_mb`` at its peak, and each part ``parts_s`` of wall-clock time.
    """

    case: CaseFindings
    repeats: tuple[SeedRun]
    data: Data
    revealed: Revealed | None = None
    memory_mb: float
    parts_s: Mapping[str, float]


def outcome_of_case(
    fit: Personalised,
    settings: Mapping[str, Any],
    image_step: ImageStep | None = None,
    gate: str = NOT_GATED,
) -> Outcome[Findings]:
    """What follows from a personalised case; the settings are shown in its report.

    ``gate`` is what the gate said of its anatomy.
    """
    case, result, grid = fit.case, fit.result, fit.settings.mesh
    run = seed_run(None, result)
    moduli = [k for k, name in enumerate(fit.names) if name.startswith("E_f.")]
    return Outcome(
        findings=Findings(
            case=_case_findings(fit, run, settings, image_step, has_passed(gate)),
            repeats=(_of_moduli(run, moduli),),
            data=Data(case.source, case.sha256),
            memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
            parts_s=dict(fit.seconds),
        ),
        status=run.status,
        reason=run.reason,
        detail=run.detail,
        row=case.name,
        parameters=tuple(fit.names[k] for k in moduli),
        model=Model(
            fit.mesh.element_type,
            (grid.columns, grid.rows, 1),
            grid.source,
            "iterated",
            case.uncertainty.typical_mm,
        ),
        mesh=Mesh(fit.mesh.sha256, len(fit.mesh.nodes), len(fit.mesh.elements)),
        forward_solves=run.forward_solves or 0,
        gate=gate,
    )


def _of_moduli(run: SeedRun, kept: list[int]) -> SeedRun:
    """The part of an estimate that is of some of its parameters."""

    def part(values: tuple[T, ...]) -> tuple[T, ...]:
        return tuple(values[k] for k in kept)

    return replace(
        run,
        estimate=run.estimate and part(run.estimate),
        std=run.std and part(run.std),
        bound=run.bound and part(run.bound),
        iterates=run.iterates and tuple(map(part, run.iterates)),
        iterate_std=run.iterate_std and tuple(map(part, run.iterate_std)),
    )


def _case_findings(
    fit: Personalised,
    run: SeedRun,
    settings: Mapping[str, Any],
    image_step: ImageStep | None,
    gate: bool | None,
) -> CaseFindings:
    result = fit.result
    unknowns = _unknowns(fit, result, fit.names)
    objective = () if result.filtered is None else result.filtered.objective.tolist()
    return CaseFindings(
        about=_about(fit.case),
        converged=run.converged,
        reason=run.reason,
        unknowns=unknowns,
        correlation=_correlation(result),
        moduli=_moduli(result, unknowns),
        without_nuisances=_alone(fit, fit.moduli_only),
        as_in_the_paper=_alone(fit, fit.paper),
        distances=tuple(
            FrameDistances(
                d.frame,
                d.seen,
                Spread.of(d.generic),
                Spread.of(d.registered),
                Spread.of(d.personalised),
            )
            for d in fit.distances
        ),
        iterates=run.iterates or (),
        iterate_std=run.iterate_std or (),
        objective=tuple(v if np.isfinite(v) else None for v in objective),
        innovation=innovation_of(result.filtered),
        whiteness=_whiteness(fit),
        errors=_errors(result),
        geometry=tuple(
            GeometryRow(own.name, own.unit, own.size, own.stretch) for own in fit.expected_geometry
        ),
        law_share=fit.law_share,
        identifiability=identified_of(result),
        observation_std_mm=fit.case.uncertainty.typical_mm,
        narrow=_narrow(fit),
        image_errors=_image_errors(fit),
        budget=tuple(
            Cost(_label(row.part), row.modulus, row.without, row.alone) for row in fit.budget
        ),
        measurements=_measurements(fit),
        confirmed_mm=fit.confirmed_mm,
        settings=settings,
        image_step=image_step,
        verdict=judge(
            replace(indications_of(fit, gate), unlike=image_step.unlike if image_step else "")
        ),
        posterior=_posterior(result),
    )


def fields_of(fit: Personalised) -> dict[str, Any]:
    """The arrays of the report, mm."""
    case, surface, filtered = fit.case, fit.case.surface, fit.result.filtered
    frames = [d.frame for d in fit.distances]
    by_name = {frame.name: frame for frame in case.frames}
    seen = [by_name[name] for name in frames]
    shapes = {"generic": fit.generic, "registered": fit.registered, "fitted": fit.fitted}
    reference = case.frame(Role.REFERENCE)
    whole = {
        "triangles": surface.triangles,
        "annulus": case.annulus,
        "free_edge": case.free_edge,
        "chord_tip": case.chordae.tip,
        "chord_insertion": [
            np.argmin(np.linalg.norm(surface.vertices - point, axis=1))
            for point in case.chordae.insertion
        ],
    }
    reals: dict[str, Any] = {
        "rest": surface.vertices,
        "tips": np.stack([reference.papillary_tips, *(frame.papillary_tips for frame in seen)]),
        **{name: np.stack([of[frame] for frame in frames]) for name, of in shapes.items()},
    }
    arrays: dict[str, Any] = {
        "region": surface.region.astype(np.int8),
        "frames": np.array(frames),
        "seen": np.array([d.seen for d in fit.distances]),
        "reach_mm": fit.settings.mechanics.contact.activation_distance
        * surface.thickness[case.free_edge].mean(),
    }
    if all(frame.corresponds for frame in seen):
        reals["observed"] = np.stack([frame.vertices for frame in seen])
        if fit.settings.correspondence:
            arrays["distance_generic"] = np.stack([d.generic for d in fit.distances])
            arrays["distance_registered"] = np.stack([d.registered for d in fit.distances])
            arrays["distance_fitted"] = np.stack([d.personalised for d in fit.distances])
    else:
        reals |= {f"observed_points_{frame.name}": frame.vertices for frame in seen}
    if filtered is not None and filtered.prediction is not None:
        sensitivity, own = filtered.prediction.jacobian, surface.vertices.size
        # Of the closed frame, which comes last.
        if len(sensitivity) == own * (1 + len(case.fitted)):
            reals["sensitivity"] = sensitivity[-own:].reshape(-1, 3, len(fit.names))
            if filtered.innovation is not None:
                arrays["innovation"] = filtered.innovation.standardised[-own:].reshape(-1, 3)
    return (
        arrays
        | {name: np.asarray(values, dtype=np.int32) for name, values in whole.items()}
        | {name: values.astype(np.float32) for name, values in reals.items()}
    )


def _posterior(result: StudyResult) -> PosteriorCheck | None:
    check = None if result.filtered is None else result.filtered.check
    if check is None:
        return None
    value = check.value if np.isfinite(check.value) else None
    return PosteriorCheck(check.compared, value, check.limit)


def _about(case: ValveCase) -> About:
    return About(
        case.name,
        case.description,
        case.source,
        case.licence,
        case.simulated,
        tuple(case.derived),
        case.sha256,
        tuple(case.surface.region_names),
        tuple(map(str, doubts(case))),
    )


def _unknowns(
    fit: Personalised, result: StudyResult, names: tuple[str, ...]
) -> tuple[UnknownRow, ...]:
    """What is known of each unknown before and after; intervals of 95 %."""
    about = {unknown.name: unknown for unknown in fit.settings.unknowns}
    rows = tuple(
        UnknownRow(
            name=name,
            label=_label(name),
            unit=unit_of(name),
            kind=MODULUS if about[name].is_modulus else NUISANCE,
            treatment=about[name].treatment.value,
            prior_mean=about[name].mean,
            prior_std=about[name].std,
        )
        for name in names
    )
    if result.estimate is None or result.std is None or result.filtered is None:
        return rows
    values = (result.estimate, result.std, *result.filtered.interval(0.95))
    return tuple(
        replace(row, estimate=estimate, std=std, low=low, high=high)
        for row, estimate, std, low, high in zip(
            rows, *(value.tolist() for value in values), strict=True
        )
    )


def _correlation(result: StudyResult) -> tuple[Vector, ...]:
    """How the errors of the estimates are alike, in the coordinates of the filter."""
    if result.filtered is None or result.estimate is None:
        return ()
    after = result.filtered.transformed
    return tuple(map(vector, after.covariance / np.outer(after.std, after.std)))


def _moduli(result: StudyResult, unknowns: tuple[UnknownRow, ...]) -> tuple[ModulusRow, ...]:
    """All moduli that follow from the estimated ones through the fixed ratios."""
    by_name = {row.name: row for row in unknowns}
    rows = []
    for modulus in result.moduli:
        row = by_name[f"E_f.{modulus.region}"]
        assert row.estimate is not None
        assert row.low is not None
        assert row.high is not None
        share = modulus.estimate / row.estimate
        rows.append(
            ModulusRow(
                region=modulus.region,
                name=modulus.name,
                estimate=modulus.estimate,
                std=modulus.std,
                low=share * row.low,
                high=share * row.high,
            )
        )
    return tuple(rows)


def _alone(fit: Personalised, result: StudyResult | None) -> ModuliAlone | None:
    """An estimation of the moduli alone."""
    if result is None:
        return None
    return ModuliAlone(
        result.converged,
        result.reason,
        result.detail,
        0 if result.filtered is None else result.filtered.forward_solves,
        _unknowns(fit, result, result.parameters),
        spread(result.distance),
    )


def _whiteness(fit: Personalised) -> tuple[WhitenessTest, ...]:
    """Tests of the standardised innovation of the closed frame."""
    filtered, surface = fit.result.filtered, fit.case.surface
    if filtered is None or filtered.innovation is None:
        return ()
    standardised = filtered.innovation.standardised
    tests = [("mean zero", zero_mean(standardised))]
    if standardised.size == surface.vertices.size * (1 + len(fit.case.fitted)):
        adjacency = _adjacency(len(surface.vertices), surface.triangles)
        by_axis = standardised[-surface.vertices.size :].reshape(-1, 3)
        tests += [
            (f"neighbours alike, {axis}", moran(by_axis[:, k], adjacency))
            for k, axis in enumerate("xyz")
        ]
    white = {True: "as white noise", False: "not as white noise"}
    return tuple(
        WhitenessTest(name, test.statistic, test.p_value, white[bool(test.p_value > 0.05)])
        for name, test in tests
    )


def _errors(result: StudyResult) -> tuple[ErrorRow, ...]:
    """What was learned of the errors of the closed frame."""
    learned = None if result.filtered is None else result.filtered.learned
    rows = []
    for quantity in () if learned is None else learned.quantities:
        low, high = quantity.learned.interval()
        before = quantity.believed.interval()
        rows.append(
            ErrorRow(
                name=quantity.name,
                unit="" if quantity.is_factor else "mm",
                believed=quantity.believed.median,
                believed_low=before[0],
                believed_high=before[1],
                learned=quantity.learned.median,
                low=low,
                high=high,
                stretch=quantity.stretch,
            )
        )
    return tuple(rows)


def _adjacency(n: int, triangles: IntArray) -> sparse.csr_array:
    """Which of n vertices share an edge."""
    a, b = surface_edges(triangles).T
    rows, columns = np.concatenate([a, b]), np.concatenate([b, a])
    return sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))


def _narrow(fit: Personalised) -> tuple[Narrower, ...]:
    """How wide the interval of each modulus would be if something more were known."""
    moduli = [name for name in fit.names if name.startswith("E_f.")]
    return tuple(
        Narrower(f"{_label(name)}, {what}", name, float(fit.narrower["now"][k]), float(values[k]))
        for what, values in fit.narrower.items()
        if what != "now"
        for k, name in enumerate(moduli)
    )


def _image_errors(fit: Personalised) -> ImageErrors | None:
    """What errors of the frames that the model was built from do to the estimate."""
    if fit.geometry is None:
        return None
    moduli = [name for name in fit.names if name.startswith("E_f.")]
    share = fit.image_share
    return ImageErrors(
        len(fit.geometry),
        None if share is None else dict(zip(moduli, map(float, share), strict=True)),
    )


def _measurements(fit: Personalised) -> dict[str, dict[str, dict[str, float | None]]]:
    """Frame -> what is measured -> measurements."""
    case, surface = fit.case, fit.case.surface
    thickness = float(surface.thickness.mean())
    reach = fit.settings.mechanics.contact.activation_distance * thickness
    measured = {}
    for frame in case.frames:
        shapes: dict[str, FloatArray] = {}
        if frame.corresponds:
            shapes["observed"] = frame.vertices
        for which, positions in (("generic", fit.generic), ("personalised", fit.fitted)):
            if frame.name in positions:
                shapes[which] = positions[frame.name]
        measured[frame.name] = {
            which: clinical_measurements(
                points, surface, points[case.annulus], frame.papillary_tips, reach
            )
            for which, points in shapes.items()
        }
    return measured


def _label(name: str) -> str:
    kind, _, part = name.partition(".")
    if kind == "E_f":
        return f"E_f {part}"
    if kind == ERROR:
        return f"pressure in frame {part}"
    if kind in ("shift", "turn"):
        return f"{kind} {'along' if kind == 'shift' else 'about'} {part}"
    return LABELS.get(name, name)
