"""The recorded donor valve: one modulus per leaflet from its recorded closed frame.

The valve is tricuspid and its tissue follows another law than ours, so there is no truth to compare
with. What a run can show is that the chain is general: it finishes, the estimate does not depend on
the start, and the fitted closure is nearer to the recording than the one with generic moduli.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments.common.building.closure import mechanics_of
from experiments.common.building.filters import build_filter
from experiments.common.progress import SolveBar
from experiments.common.records.estimate_record import (
    identified_of,
    innovation_of,
    seed_run,
)
from experiments.common.records.estimates import Data
from experiments.common.records.findings import vector
from experiments.common.records.record import Mesh, Outcome
from experiments.common.records.report import answer_of_main
from experiments.common.study import Job, Section, Study
from experiments.studies.donor.findings import (
    Distances,
    Findings,
    Row,
)
from experiments.studies.donor.report import donor_answer, donor_words, write_donor
from experiments.studies.donor.settings import (
    CITATION,
    DonorSettings,
    Settings,
    recording_folder,
)
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import Prediction
from mvest.estimation.transform import Transform
from mvest.estimation.wrappers import Remembered
from mvest.files import sha256_of
from mvest.mechanics.settings import MechanicsSettings
from mvest.observation.surfaces import mean_surface_distance
from mvest.observation.vertices import Observation
from mvest.problem.estimate import StudyResult, estimate
from mvest.problem.problem import Problem
from mvest.provenance import config_hash
from mvest.typing import FloatArray
from mvest.units import mpa_to_mmhg
from mvest.valve.io.abaqus.leaflet_mesh import SetNames
from mvest.valve.io.abaqus.recording import Recording, read_recording, recording_files
from mvest.valve.mesh.remesh import Remeshed, remesh
from mvest.valve.mesh.solid_mesh import SolidMesh
from mvest.valve.mesh.structured import layered_wedges

__all__ = ["STUDY", "DonorStudy", "build_donor", "run_donor"]

Values = Mapping[str, Any]

CLAIM = (
    "A human tricuspid valve, not a mitral one, whose tissue in the recording follows another "
    "(exponential) law than the linear one fitted here: the moduli are those of the linear tissue "
    "that closes most like the recording, not properties of the donor. Asked is only whether the "
    "chain is general: whether it finishes, two starts agree, and the fitted closure is nearer to "
    "the recording than the generic one."
)

TYPICAL_SOLVES = 5
"""Forward solves of one fit; only the progress bar's first guess."""


@dataclass(frozen=True, slots=True, eq=False)
class DonorStudy:
    """The recorded valve, ready to be fitted.

    Attributes
    ----------
    recording : Recording
    coarse : Remeshed
        Its midsurface in the resolution of the mesh; the vertices are what is observed.
    contact : Remeshed
        The same in the resolution at which contact is sampled.
    mesh : SolidMesh
    settings : MechanicsSettings
    parameters : tuple of str
    prior : Gaussian
        Of the moduli; its mean are the generic ones.
    filter : IteratedFilter
    transform : Transform
    observation : Observation
        The recorded closed frame.
    starts : tuple of (p,) MPa
    continuation : bool
        Whether closures after the first start from the last closed state.
    largest_change : float
        See :class:`mvest.closure.model.ClosureModel`.
    """

    recording: Recording
    coarse: Remeshed
    contact: Remeshed
    mesh: SolidMesh
    settings: MechanicsSettings
    parameters: tuple[str, ...]
    prior: Gaussian
    filter: IteratedFilter
    transform: Transform
    observation: Observation
    starts: tuple[FloatArray, ...]
    continuation: bool
    largest_change: float

    def model(self) -> ClosureModel:
        """A model of the open valve."""
        return ClosureModel(
            self.recording.valve(self.coarse),
            self.recording.valve(self.contact),
            self.mesh,
            self.settings,
            self.parameters,
            continuation=self.continuation,
            repeat=False,
            largest_change=self.largest_change,
        )


def build_donor(config: Values, donor: DonorSettings) -> DonorStudy:
    """Read, mesh and load the recorded valve as configured.

    Raises
    ------
    MvestError
        If the data are absent (the message says where to get them) or a setting is inadmissible.
    """
    parameters = tuple(config["parameters"])
    filter_, transform, prior = build_filter(config["filter"], parameters)
    if not isinstance(filter_, IteratedFilter):
        raise ConfigurationError(
            f"filter.mode = {config['filter']['mode']!r}: a recorded valve needs the iterated "
            "filter, whose result does not depend on the start by construction"
        )
    starts = [np.array(start, dtype=float) for start in donor.starts]
    if not starts or any(start.shape != prior.mean.shape for start in starts):
        raise ConfigurationError(
            f"donor.starts = {list(donor.starts)}, expected lists of {len(parameters)} moduli each"
        )
    names = SetNames(donor.leaflets, donor.annulus, donor.free_edge)
    recording = read_recording(recording_folder(donor.recording, donor.case), names)
    settings = _as_recorded(mechanics_of(config), recording)
    unknown = [f"E_f.{name}" for name in recording.surface.region_names]
    if sorted(unknown) != sorted(parameters):
        raise ConfigurationError(
            f"parameters = {list(parameters)}, expected one modulus for each leaflet: {unknown}"
        )
    coarse, contact = (
        remesh(recording.surface, recording.annulus, recording.free_edge, vertices)
        for vertices in (donor.vertices, donor.contact_vertices)
    )
    mesh = layered_wedges(
        coarse.surface,
        element_type=config["mechanics"]["element"],
        layers=config["mesh"]["layers"],
        onto=recording.surface,
    ).solid
    seen = recording.positions(coarse.triangle, coarse.weights, -1)
    return DonorStudy(
        recording,
        coarse,
        contact,
        mesh,
        settings,
        parameters,
        prior,
        filter_,
        transform,
        Observation(("closed",), seen[None], np.asarray(config["filter"]["R"])),
        tuple(starts),
        config["continuation"],
        donor.largest_change,
    )


def _as_recorded(settings: MechanicsSettings, recording: Recording) -> MechanicsSettings:
    """Mechanics under the recorded pressure, which may rise otherwise than the motion."""
    protocol = settings.protocol
    if protocol.pressure_mmHg != 0 or protocol.curve:
        raise ConfigurationError(
            f"mechanics.protocol.pressure_mmHg = {protocol.pressure_mmHg}: the recording says how "
            "large the pressure is and how it rises; leave it 0, without a curve"
        )
    shares = recording.pressure_share
    together = np.allclose(shares, recording.phase, rtol=0, atol=1e-12)
    times = recording.times / recording.times[-1] * protocol.ramp
    curve = () if together else tuple(zip(times.tolist(), shares.tolist(), strict=True))
    pressure = mpa_to_mmhg(recording.pressure)
    return replace(settings, protocol=replace(protocol, pressure_mmHg=pressure, curve=curve))


def run_donor(job: Job[Settings]) -> Outcome[Findings]:
    """Fit the recorded valve from every start.

    Raises
    ------
    MvestError
        If the data are absent (the message says where to get them) or a setting is inadmissible.
    """
    study = build_donor(job.values, job.settings.donor)
    fits = _fit(study)
    first = fits.results[0]
    generic = _generic_row(study, fits)
    fitted = [
        _fit_row(f"fitted, start {k + 1}", study, start, result, equilibria, seconds)
        for k, (start, result, equilibria, seconds) in enumerate(
            zip(study.starts, fits.results, fits.equilibria, fits.seconds_of, strict=True)
        )
    ]
    rows = (generic, *fitted)
    if fits.generic.converged and first.fitted is not None:
        np.savez_compressed(
            job.folder / "fields.npz",
            triangles=study.coarse.surface.triangles,
            region=study.coarse.surface.region,
            annulus=study.coarse.annulus,
            free_edge=study.coarse.free_edge,
            rest=study.coarse.surface.vertices,
            recorded=study.observation.positions[-1],
            generic=_closed(fits.generic),
            fitted=first.fitted[-1],
        )
    run = seed_run(job.values["seed"], first)
    motion = np.linalg.norm(study.observation.positions[-1] - study.coarse.surface.vertices, axis=1)
    tips = study.recording.papillary_tips
    donor = job.settings.donor
    files = recording_files(recording_folder(donor.recording, donor.case))
    findings = Findings(
        estimate=run.estimate,
        std=run.std,
        iterates=run.iterates,
        iterate_std=run.iterate_std,
        moduli=first.moduli,
        distance_mm=run.distance_mm,
        innovation=innovation_of(first.filtered),
        identifiability=identified_of(first),
        iterations=run.iterations or 0,
        seconds=sum(row.seconds for row in rows),
        memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        claim=CLAIM,
        data=Data(CITATION, config_hash({file.name: sha256_of(file) for file in files})),
        recording=donor.case,
        pressure_mmHg=study.settings.protocol.pressure_mmHg,
        tip_motion_mm=float(np.linalg.norm(tips[-1] - tips[0], axis=1).max()),
        regions=tuple(study.recording.surface.region_names),
        rows=rows,
        recorded_motion_mm=float(motion.mean()),
    )
    failed = next((row for row in rows if row.status != "converged"), None)
    return Outcome(
        findings=findings,
        status="converged" if failed is None else "failed",
        reason=first.reason if failed is None else f"{failed.closure}: {failed.reason}",
        detail=first.detail,
        mesh=Mesh(study.mesh.sha256, len(study.mesh.nodes), len(study.mesh.elements)),
        forward_solves=sum(row.forward_solves for row in rows),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """The closure with generic moduli, and the fit from every start.

    Attributes
    ----------
    generic : Prediction
    seconds : float
        Processor time of the generic closure.
    results : tuple of StudyResult
    seconds_of : tuple of float
        Processor time of each.
    equilibria : tuple of int
        Closed states that each fit went through.
    """

    generic: Prediction
    seconds: float
    results: tuple[StudyResult, ...]
    seconds_of: tuple[float, ...]
    equilibria: tuple[int, ...]


def _fit(study: DonorStudy) -> Fits:
    """Close the open valve with the generic moduli, and fit it from there from every start."""
    steps = len(study.settings.protocol.steps())
    results, models, seconds_of = [], [], []
    solves = TYPICAL_SOLVES * len(study.starts)
    with SolveBar("donor", steps, solves, study.parameters) as bar:
        started = time.process_time()
        first = study.model()
        first.on_step = bar.step
        # A start is met again by rounding of its logarithm.
        known = Remembered(first, rtol=1e-12)
        generic = known(study.prior.mean)
        seconds = time.process_time() - started
        for start in study.starts:
            # Each goes on from the generic closed valve.
            model = copy(first)
            model.closures = 0
            models.append(model)
            case = Problem(
                study.parameters,
                Remembered(model, known.runs, known.rtol),
                study.prior,
                replace(study.filter, start=tuple(map(float, start))),
                study.transform,
                study.settings.tissue,
            )
            started = time.process_time()
            results.append(estimate(case, study.observation, on_iterate=bar.iterate))
            seconds_of.append(time.process_time() - started)
    closures = tuple(model.closures for model in models)
    return Fits(generic, seconds, tuple(results), tuple(seconds_of), closures)


def _closed(prediction: Prediction) -> FloatArray:
    """Closed positions ``(n, 3)`` out of a prediction of the open and the closed frame."""
    return prediction.y.reshape(2, -1, 3)[1]


def _distances(study: DonorStudy, closed: FloatArray) -> Distances:
    """Distances of closed positions ``(n, 3)`` mm from the recording."""
    d = np.linalg.norm(closed - study.observation.positions[-1], axis=1)
    surface = study.coarse.surface
    return Distances(
        float(d.mean()),
        float(np.median(d)),
        float(np.sqrt(np.mean(d**2))),
        float(d.max()),
        mean_surface_distance(
            closed,
            surface.triangles,
            study.recording.frames[-1],
            study.recording.surface.triangles,
        ),
        {
            name: float(d[np.unique(surface.triangles[surface.region == k])].mean())
            for k, name in enumerate(surface.region_names)
        },
    )


def _generic_row(study: DonorStudy, fits: Fits) -> Row:
    closed = fits.generic
    return Row(
        closure="generic",
        status="converged" if closed.converged else "failed",
        reason="closed" if closed.converged else closed.reason,
        start=vector(study.prior.mean),
        estimate=None,
        std=None,
        distance_mm=_distances(study, _closed(closed)) if closed.converged else None,
        iterations=0,
        forward_solves=1,
        equilibria=1,
        seconds=fits.seconds,
    )


def _fit_row(
    name: str,
    study: DonorStudy,
    start: FloatArray,
    result: StudyResult,
    equilibria: int,
    seconds: float,
) -> Row:
    fitted, filtered = result.fitted, result.filtered
    return Row(
        closure=name,
        status="converged" if result.converged else "failed",
        reason=result.reason,
        start=vector(start),
        estimate=None if result.estimate is None else vector(result.estimate),
        std=None if result.std is None else vector(result.std),
        distance_mm=None if fitted is None else _distances(study, fitted[-1]),
        iterations=0 if filtered is None else filtered.iterations,
        forward_solves=0 if filtered is None else filtered.forward_solves,
        equilibria=equilibria,
        seconds=seconds,
    )


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_donor,
    words=donor_words,
    write=write_donor,
    keeps_failures=True,
    sections=(
        Section(
            "donor",
            {"donor": "A recorded donor tricuspid valve and closures of its model."},
            answer=answer_of_main(donor_answer),
        ),
        Section(
            "donor_diseased",
            {"donor_diseased": "The same of a regurgitant donor tricuspid valve."},
            answer=answer_of_main(donor_answer),
        ),
    ),
)
