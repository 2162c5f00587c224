"""Closures, gate runs and estimates of imported valves.

The study fits a recorded closure (``donor``) to its closed frame from several starts. It meshes and
closes the shape of a reference heart (``heart``), and estimates known moduli on it. The data are
not part of this project; ``conf/experiment`` names their sources.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any

import numpy as np

from experiments.common.building.closure import folder_hash, mechanics_of
from experiments.common.building.filters import build_filter
from experiments.common.building.gate import (
    anatomy_digest,
    close_valve,
    draw_closing,
    gate_report,
    gate_rows,
)
from experiments.common.building.twin import build_twin, estimate_twin
from experiments.common.progress import solving
from experiments.common.records.record import FAILED_GATE, PASSED_GATE, Mesh
from experiments.common.schema import InputFile, Reads, Values, contents
from experiments.common.study import Figures, Job, Result, Results, Study
from mvest.cases.case import ValveCase
from mvest.cases.folder import write_case
from mvest.cases.tissue import CLOSED_DEPTH, LeafletBand, assumed_closure, lay_out_chordae
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.prediction import Prediction, Remembered
from mvest.exchange.abaqus.recording import Recording, read_recording, recording_files
from mvest.exchange.importing.leaflets import LeafletsOptions, import_leaflets
from mvest.mechanics.settings import MechanicsSettings
from mvest.observation.surfaces import mean_surface_distance
from mvest.observation.vertices import Observation
from mvest.problem.estimate import Problem, estimate
from mvest.problem.fields import valve_fields
from mvest.problem.record import EstimateRecord, record_of
from mvest.quantities import Count, Length, Share, Thickness
from mvest.reporting.skill import estimates_table
from mvest.reporting.tables import Column, table
from mvest.typing import FloatArray
from mvest.units import mpa_to_mmhg
from mvest.valve.anatomy.dimensions import ChordLayout
from mvest.valve.anatomy.valve import Valve
from mvest.valve.mesh.remesh import layered_wedges
from mvest.valve.mesh.solid_mesh import SolidMesh


def recording_folder(recording: str | None, case: str) -> Path:
    """A case folder in a checkout of a donor's data; raises an InputError if there is none."""
    folder = Path(recording or "") / case
    if not recording or not folder.is_dir():
        raise InputError(
            f"donor.recording = {recording}: there is no folder {folder}; {WHERE_FROM}/donor.yaml"
        )
    return folder


def _recording(value: str | None, other: Values) -> Any:
    try:
        return contents(recording_files(recording_folder(value, str(other.get("case", "")))))
    except InputError:
        return value  # the study raises the error


LARGEST_CHANGE = 0.15
"""Largest change of a modulus's logarithm between closed states."""

WHERE_FROM = "the data are not part of this package, for where to get them see conf/experiment"


@dataclass(frozen=True, slots=True, kw_only=True)
class DonorSettings:
    """A recorded closure; set names are those of its input deck."""

    # Checkout of the data.
    recording: Annotated[str | None, Reads(_recording)] = None
    case: str = ""  # its folder; deck and frames have the same name; empty: no donor
    citation: str = ""  # of the data
    leaflets: dict[str, str] = field(default_factory=dict)  # name of a leaflet -> element set
    annulus: str = ""  # node set
    free_edge: str = ""  # node set
    # For the meshed and observed midsurface, and for the contact midsurface.
    vertices: Count = 430
    contact_vertices: Count = 3000
    starts: tuple[Any, ...] = ()  # MPa, moduli at the start of each fit


@dataclass(frozen=True, slots=True, kw_only=True)
class HeartSettings:
    """A static shape of a thick valve with two papillary muscles, and twins of it.

    Files, names and units are passed to `mvest.exchange.importing.leaflets`.
    """

    source: InputFile = None  # closed surface of both leaflets
    leaflets: str | None = None  # their object in it, if there are others
    # Papillary muscles, antero-lateral and postero-medial: files, or objects of the source.
    muscles: Annotated[tuple[str, ...], Reads(contents)] = ()
    units: str = "mm"
    name: str = "imported valve"
    citation: str = ""
    smoothing_mm: Length = 4.0  # removes spikes that are sharper than leaflets are thick
    # Bounds of the thickness, because some parts are not leaflet.
    min_thickness_mm: Thickness = 0.3
    max_thickness_mm: Thickness = 3.0
    # Depth of the free edges below the annulus, closed over open; sets the chordal lengths.
    closed_depth: Share = 0.5
    # Twin -> settings of the truth that differ from the estimator's model.
    twins: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings that the study adds to the configuration."""

    donor: DonorSettings = field(default_factory=DonorSettings)
    heart: HeartSettings = field(default_factory=HeartSettings)


def require_data(values: Values) -> None:
    """Raise an `InputError` if the recording, or a file of the heart, is missing."""
    settings = STUDY.settings_of(values)
    if settings.donor.case:
        recording_folder(settings.donor.recording, settings.donor.case)
    else:
        _require_files(settings.heart)


def _require_files(heart: HeartSettings) -> None:
    for file in (heart.source, *(heart.muscles if heart.leaflets is None else ())):
        if file is None or not Path(file).is_file():
            raise InputError(f"heart: no file {file}; {WHERE_FROM}/reference_heart.yaml")


def run(job: Job[Settings]) -> Result:
    """Fit the recorded donor valve, or close, gate and estimate the reference heart.

    MvestError if the data are missing (the message names their source) or a setting is
    inadmissible.
    """
    return _donor(job) if job.settings.donor.case else _heart(job)


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """A recorded valve, ready to close; ``coarse`` is the meshed and observed midsurface."""

    recording: Recording
    coarse: Valve
    contact: Valve
    mesh: SolidMesh
    settings: MechanicsSettings
    seen: FloatArray

    def model(self, parameters: tuple[str, ...], **settings: Any) -> ClosureModel:
        """A model of the open valve."""
        valves = self.coarse, self.contact
        return ClosureModel(*valves, self.mesh, self.settings, parameters, **settings)

    def distances(self, closed: FloatArray | None) -> dict[str, float | None]:
        """Distances (mm) between closed positions ``(n, 3)`` and the recorded positions.

        ``surface`` is the mean distance between the full surfaces, in both directions.
        """
        if closed is None:
            return dict.fromkeys(DISTANCES)
        d, triangles = np.linalg.norm(closed - self.seen, axis=1), self.coarse.surface.triangles
        recorded = self.recording.frames[-1], self.recording.valve.surface.triangles
        surface = mean_surface_distance(closed, triangles, *recorded)
        return dict(zip(DISTANCES, (float(d.mean()), float(d.max()), surface), strict=True))


DISTANCES = ("mean", "max", "surface")


def recorded_valve(config: Values, donor: DonorSettings) -> Recorded:
    """Read, mesh and load the recorded valve as configured.

    MvestError if the data are missing or a setting is inadmissible.
    """
    names = donor.leaflets, donor.annulus, donor.free_edge
    recording = read_recording(recording_folder(donor.recording, donor.case), *names)
    settings = mechanics_of(config)
    protocol = settings.protocol
    if protocol.pressure_mmHg != 0 or protocol.curve:
        raise ConfigurationError(
            f"mechanics.protocol.pressure_mmHg = {protocol.pressure_mmHg}: the recording has the "
            "pressure and its rise; expected 0, without a curve"
        )
    # Pressure and motion may rise differently.
    shares, times = recording.pressure_share, recording.times / recording.times[-1] * protocol.ramp
    together = np.allclose(shares, recording.valve.motion.phase, rtol=0, atol=1e-12)
    curve = () if together else tuple(zip(times.tolist(), shares.tolist(), strict=True))
    loaded = replace(protocol, pressure_mmHg=mpa_to_mmhg(recording.pressure), curve=curve)
    unknown = [f"E_f.{name}" for name in recording.valve.surface.region_names]
    if sorted(unknown) != sorted(config["parameters"]):
        raise ConfigurationError(
            f"parameters = {config['parameters']}, expected one modulus for each leaflet: {unknown}"
        )
    kept, coarse = recording.remeshed(donor.vertices)
    _, contact = recording.remeshed(donor.contact_vertices)
    layers = {"element_type": config["mechanics"]["element"], "layers": config["mesh"]["layers"]}
    mesh = layered_wedges(coarse.surface, recording.valve.surface, **layers)
    seen = recording.frames[-1][kept]
    return Recorded(recording, coarse, contact, mesh, replace(settings, protocol=loaded), seen)


def _donor(job: Job[Settings]) -> Result:
    values, donor = job.values, job.settings.donor
    parameters = tuple(values["parameters"])
    filter_, transform, prior = build_filter(values["filter"], parameters)
    if not isinstance(filter_, IteratedFilter):
        raise ConfigurationError(
            "filter: a recorded valve needs the iterated filter, whose result does not depend on "
            "the start"
        )
    starts = [np.array(start, dtype=float) for start in donor.starts]
    if not starts or any(start.shape != prior.mean.shape for start in starts):
        raise ConfigurationError(
            f"donor.starts = {list(donor.starts)}, expected lists of {len(parameters)} moduli each"
        )
    valve = recorded_valve(values, donor)
    seen = Observation(("closed",), valve.seen[None], np.asarray(values["filter"]["R"]))
    how = {"continuation": values["continuation"], "largest_change": LARGEST_CHANGE}
    records, rows, shapes = [], [], {}
    first = valve.model(parameters, repeat=False, **how)
    with solving("donor", first, parameters) as bar:
        # A start may differ by the rounding error of its logarithm.
        known = Remembered(first, rtol=1e-12)
        generic: Prediction = known(prior.mean)
        if generic.converged:
            shapes["generic"] = generic.y.reshape(2, -1, 3)[1]
        row = {"closure": "generic", "ended": generic.reason}
        rows.append(row | valve.distances(shapes.get("generic")))
        for k, start in enumerate(starts):
            # Each continues from the generic closed valve.
            model = Remembered(copy(first), known.runs, known.rtol)
            own = replace(filter_, start=tuple(map(float, start)))
            tissue = valve.settings.tissue
            problem = Problem(parameters, model, prior, own, transform, tissue)
            found = estimate(problem, seen, on_iterate=bar.iterate)
            record = record_of(found, case=f"fitted, start {k + 1}", simulated=True)
            closed = None if found.fitted is None else found.fitted[-1]
            if closed is not None:
                shapes.setdefault("fitted", closed)
            row = {"closure": record.case, "ended": record.reason}
            rows.append(row | valve.distances(closed))
            records.append(record)
    failed = [] if generic.converged else [f"generic: {generic.reason}"]
    failed += [one.reason for one in records if not one.converged]
    about = {"closure": Column(), "ended": Column(hidden=True)}
    pressure = valve.settings.protocol.pressure_mmHg
    return Result(
        tables={
            "": table(rows, **about, **dict.fromkeys(DISTANCES, "mm:.2f")),
            "moduli": estimates_table("estimation", records),
        },
        estimates=tuple(records),
        numbers={"data": donor.citation, "pressure_mmHg": pressure},
        arrays=_arrays(valve, shapes) if len(shapes) == 2 else {},
        status="failed" if failed else "converged",
        reason=failed[0] if failed else records[0].reason,
        detail=records[0].detail,
        mesh=Mesh.of(valve.mesh),
        forward_solves=1 + sum(one.forward_solves or 0 for one in records),
    )


def _arrays(valve: Recorded, shapes: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Fields of a case (`mvest.problem.fields`)."""
    tips = valve.recording.valve.motion.papillary_tips[[0, -1]]
    arrays = {**valve_fields(valve.coarse, ["closed"]), "tips": tips, "observed": valve.seen[None]}
    for name, points in shapes.items():
        away = np.linalg.norm(points - valve.seen, axis=1)
        arrays |= {name: points[None], f"distance_{name}": away[None]}
    return arrays


def import_heart(heart: HeartSettings) -> ValveCase:
    """Make a case of the valve's open frame.

    InputError or GeometryError if a part is missing, or does not fit a thick valve with two
    muscles.
    """
    _require_files(heart)
    known = LeafletsOptions(
        leaflets=heart.leaflets,
        units=heart.units,
        muscles=heart.muscles,
        smoothing_mm=heart.smoothing_mm,
        thickness_range_mm=(heart.min_thickness_mm, heart.max_thickness_mm),
    )
    case = import_leaflets(Path(str(heart.source)), known)
    surface, tips = case.surface, case.frames[0].papillary_tips
    loops = case.annulus, case.free_edge
    band = LeafletBand.of(surface.vertices, surface.triangles, surface.region, *loops, anterior=0)
    closed = assumed_closure(band, surface.vertices[loops[0]], tips, heart.closed_depth)
    stated = f"at {CLOSED_DEPTH:g} of their depth", f"at {heart.closed_depth:g} of their depth"
    return replace(
        case,
        name=heart.name,
        source=heart.citation,
        chordae=lay_out_chordae(band.position, tips, closed.position, tips, ChordLayout()),
        derived=tuple(line.replace(*stated) for line in case.derived),
    )


def _heart(job: Job[Settings]) -> Result:
    heart, values, place = job.settings.heart, job.values, job.folder / "case"
    case = import_heart(heart)
    if place.exists():
        shutil.rmtree(place)
    write_case(place, case)
    anatomy = {"folder": str(place), "folder_sha256": folder_hash(str(place))}
    own = {**values, "valve": {**values["valve"], **anatomy}}
    closing = close_valve(own)
    gate = gate_report(own)
    records = [_twin(own, name, changes) for name, changes in heart.twins.items()]
    states = zip(("open", "closed"), closing.ends().steps().rows, strict=True)
    failed = [one.reason for one in records if not one.converged]
    steps = closing.result.simulation
    failed += [] if steps.converged else [steps.reason.value]
    return Result(
        tables={
            "": table({"state": state, **row} for state, row in states),
            "gate": gate_rows(gate),
            "moduli": estimates_table("estimation", records),
            "derived": table([{"what follows from the source": text} for text in case.derived]),
        },
        estimates=tuple(records),
        numbers={"anatomy": anatomy_digest(own), "passed": gate.passed, "data": heart.citation},
        arrays=closing.ends().arrays(),
        status="failed" if failed else "converged",
        reason=failed[0] if failed else "completed",
        mesh=Mesh.of(closing.model.mesh),
        forward_solves=1 + gate.closures,
        gate=f"{PASSED_GATE if gate.passed else FAILED_GATE} on {values['mesh']['columns']} x "
        f"{values['mesh']['rows']} hex18",
    )


def _twin(values: Values, name: str, changes: Values) -> EstimateRecord:
    """Estimate moduli from one simulated observation."""
    twin = build_twin({**values, "truth": {**values["truth"], **changes}})
    (found,) = estimate_twin(twin, [values["seed"]], name)
    return record_of(found, seed=values["seed"], case=name, simulated=True)


def figure(results: Results) -> Figures:
    """The closed donor valve with generic and fitted moduli, or the heart valve open and closed."""
    from matplotlib.figure import Figure

    from mvest.reporting.case.figures import case_figure

    record = results.first
    if results.first_arrays is None:
        return None
    if "gate" not in record.tables:
        return case_figure(results.first_arrays)
    drawn = Figure(figsize=(8.0, 7.4), layout="constrained")
    titles = {0: "open, as modelled", 1: "closed (simulated)"}
    draw_closing(drawn, results.first_arrays, titles)
    title = f"{record.title}: only its shape is real"
    drawn.suptitle(f"{title}\n{fill(str(record.numbers['data']), 110)}", fontsize=9)
    return drawn


STUDY = Study(
    settings=Settings,
    run=run,
    figure=figure,
    captions={"": "A valve from outside and closures of its model."},
    keeps_failures=True,
    require=require_data,
    golden=("case",),
)
