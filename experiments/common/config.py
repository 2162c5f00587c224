"""The schema of every configuration, registered with Hydra.

What the library names is taken from the library (``experiments.common.mirror``); only what a study
adds to it is written down here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from experiments.common.mirror import schema
from experiments.studies.models.sheet.sheet import Sheet
from mvest.closure.cycle.protocol import CycleProtocol
from mvest.estimation.filters.ensemble import EnsembleFilter
from mvest.estimation.filters.monte_carlo import MonteCarloFilter
from mvest.estimation.filters.sampler import SamplerSettings
from mvest.imaging.detection.tracking import TrackingSettings
from mvest.imaging.detection.trained_model import MODEL_FILE
from mvest.imaging.learning.training import TrainingSettings
from mvest.mechanics.settings import MechanicsSettings
from mvest.personalise.settings import CaseMesh, PaperSettings
from mvest.provenance import config_hash
from mvest.scenarios.scenario import Scenario
from mvest.simulation.motion.population import PopulationSettings
from mvest.simulation.virtual_patient import Deviations, PatientSimulation
from mvest.valve.anatomy.template import TemplateParameters

__all__ = ["NOT_THE_RESULT", "hash_of", "plain", "register"]

NOT_THE_RESULT = (
    "hydra",
    "paths",
    "tracking",
    "sweep",
    "factors",
    "figures",
    "publish",
    "force",
    "dry_run",
    "time_limit_s",
    "isolate",
    "check",
    "imaging.processes",
    "imaging.publish_model",
    "external.folder",
    "external.processes",
    "models.processes",
)
"""What in a configuration changes no number of the result, left out of its hash."""


TemplateConfig = schema(TemplateParameters)
CaseMeshConfig = schema(CaseMesh)
PaperSettingsConfig = schema(PaperSettings)
SimulationConfig = schema(PatientSimulation)
DeviationsConfig = schema(Deviations)
PopulationSettingsConfig = schema(PopulationSettings)
CycleProtocolConfig = schema(CycleProtocol)
TrainingSettingsConfig = schema(TrainingSettings)
DetectionSettingsConfig = schema(TrackingSettings)
SheetConfig = schema(Sheet)
ScenarioConfig = schema(Scenario)
EnsembleFilterConfig = schema(EnsembleFilter)
MonteCarloFilterConfig = schema(MonteCarloFilter)
SamplerSettingsConfig = schema(SamplerSettings)


@dataclass
class MeshConfig:
    """The estimator's mesh."""

    source: str = "structured"  # or tetwild: an unstructured mesh of the thickened leaflets
    columns: int = MISSING  # cells around the valve
    rows: int = MISSING  # cells from annulus to free edge
    layers: int = 1  # cells through the thickness
    edge_length: float = 2.5  # mm, of an unstructured mesh


@dataclass
class ContactPointsConfig:
    """Where contact is sampled, in material coordinates: the same for every mesh."""

    columns: int = 144
    rows: int = 32


@dataclass
class FilterConfig:
    """The filter and what it is told."""

    mode: str = MISSING  # paper, extended, iterated, unscented, ensemble or monte_carlo
    initial: list[float] = MISSING  # prior mean of the parameters
    P0: Any = MISSING  # variance, variances or matrix
    Q: Any = 0.01  # the same, added each round of the paper's mode
    R: Any = 0.01  # mm², one or one for each observed frame
    R_correlation_mm: float = 0.0  # correlation length of R along the leaflets; 0: independent
    transform: str = "identity"  # or log
    tolerance: float = 1e-4
    max_iterations: int = 30
    spread: float = 1.0  # of sigma points, in parts of the simplex whose covariance is P
    ensemble: EnsembleFilterConfig = field(default_factory=EnsembleFilterConfig)  # type: ignore[valid-type]
    monte_carlo: MonteCarloFilterConfig = field(default_factory=MonteCarloFilterConfig)  # type: ignore[valid-type]


@dataclass
class ObservationConfig:
    """What is seen of the valve, and how it differs from what is there."""

    frames: list[str] = field(default_factory=lambda: ["open", "closed"])
    columns: int = 112
    rows: int = 29
    label: str = "none"  # what a table calls its errors
    noise_mm: float = 0.0  # SD of independent errors of each coordinate
    correlated_mm: float = 0.0  # SD of errors that are alike at neighbouring vertices
    correlation_length_mm: float = 5.0
    dropout_mm: float = 0.0  # closed vertices this near to another leaflet are not seen
    annulus_offset_mm: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])


@dataclass
class FilterProblemConfig:
    """One problem on which filters are compared; unknowns are normal in their logarithms."""

    title: str = MISSING
    about: str = ""
    parameters: list[str] = MISSING
    truth: list[float] = MISSING
    initial: list[float] = MISSING  # prior median
    log_std: list[float] = MISSING  # prior standard deviation of the logarithms
    fixed: dict[str, float] = field(default_factory=dict)  # what is known
    columns: int = 28
    rows: int = 8
    every: int = 1  # of the vertices, every so many is seen, in the closed frame
    noise_mm: float = MISSING  # of each coordinate


@dataclass
class FilterMethodConfig(FilterConfig):
    """A filter that is told its prior by each problem."""

    initial: list[float] = field(default_factory=list)
    P0: Any = None


@dataclass
class SurrogateDesignConfig:
    """Runs of the model to which the surrogate for repeats is fitted."""

    surrogate_runs: int = 32
    held_out: int = 8
    reach: float = 3.2  # standard deviations of the prior
    degree: int = 5  # at most
    surrogate_seed: int = 1


@dataclass
class FilterStudyConfig:
    """All filters on the same problems."""

    problems: dict[str, FilterProblemConfig] = field(default_factory=dict)
    methods: dict[str, FilterMethodConfig] = field(default_factory=dict)
    design: SurrogateDesignConfig = field(default_factory=SurrogateDesignConfig)
    repeats: int = 100  # observations, each of a truth drawn from the prior
    sampler: SamplerSettingsConfig = field(default_factory=SamplerSettingsConfig)  # type: ignore[valid-type]  # of repeats


@dataclass
class DonorConfig:
    """What a study of the recorded donor valve adds."""

    vertices: int = 430  # of the midsurface that is meshed and observed
    contact_vertices: int = 3000  # of the midsurface on which contact is sampled
    starts: list[Any] = field(default_factory=list)  # MPa, moduli from which each fit starts
    largest_change: float = 0.15  # of a modulus' logarithm from one closed state to the next


@dataclass
class TruthConfig:
    """What the synthetic observation is made from; null means as the estimator's model."""

    values: list[float] = MISSING
    label: str = MISSING  # what a table calls it
    refine: int = 1  # cells of the truth's mesh per cell of the estimator's, in each direction
    source: str | None = None
    columns: int | None = None
    rows: int | None = None
    layers: int | None = None
    element: str | None = None
    dt_factor: float = 1.0
    reading: str | None = None  # of the Poisson ratio
    ratio: dict[str, float] = field(default_factory=dict)  # region -> E_f over E_perp
    fixed: dict[str, float] = field(default_factory=dict)  # pressure_scale, chord_stiffness, ...


@dataclass
class UnknownConfig:
    """One quantity that is not known of a case: its prior, and what becomes of it."""

    mean: float = MISSING
    std: float = MISSING
    treatment: str = "estimated"  # or considered, or fixed


@dataclass
class PersonalConfig:
    """How a case is personalised (see mvest.personalise.PersonaliseSettings)."""

    unknowns: dict[str, UnknownConfig] = field(default_factory=dict)
    mesh: CaseMeshConfig = field(default_factory=CaseMeshConfig)  # type: ignore[valid-type]
    tolerance: float = 2e-3
    max_iterations: int = 15
    largest_change: float = 0.2  # of a parameter's logarithm from one equilibrium to the next
    paper: PaperSettingsConfig | None = None  # type: ignore[valid-type]
    moduli_only: bool = False  # estimate also with all nuisances fixed
    confirm: bool = False  # close the fitted valve anew from the open one
    correspondence: bool = True  # use corresponding vertices as such, where there are any


@dataclass
class ImagedConfig:
    """From a volume over time to a case: what the file does not say."""

    model: str | None = None  # file of the detection model; null: the one for ultrasound
    package_model: str | None = None  # SHA-256 of that one, where a result is kept as its own
    modality: str | None = None  # ultrasound, ct or mr, where the file does not say
    frame_interval_s: float | None = None  # where the file states no times
    time_unit: str | None = None  # s or ms, where the file states times without a unit
    # [frame, .mrk.json] with landmarks placed by hand, where the automatic ones fail.
    landmarks: list[Any] = field(default_factory=list)
    open_frame: int | None = None  # null: the one with the largest orifice
    closed_frame: int | None = None  # null: the one whose leaflets touch most
    pressure_mmHg: float | None = None  # transmitral, in the closed frame
    pressure_curve: str | None = None  # .csv time,pressure (s, mmHg, the times of the volume)
    held_out: list[Any] = field(default_factory=list)  # [frame, mmHg]: closed frames not shown
    thickness_mm: list[float] = field(default_factory=list)  # anterior, posterior; empty: generic
    valve_confidence: float = 0.6  # of the best frame; below it there is no valve (0: show it)
    least_confidence: float = 0.6  # of the frames that are chosen
    error_samples: int = 20  # at most, with which the valve is closed anew
    name: str | None = None  # null: the name of the file
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = False  # does the volume come from a simulation


@dataclass
class PatientConfig:
    """A virtual patient. Nothing of it reaches the estimator but the case that it writes."""

    name: str = MISSING
    description: str = MISSING
    moduli: dict[str, float] = field(default_factory=dict)  # MPa
    moduli_spread: float = 0.0  # SD of the logarithm by which they are drawn about these
    variation: float = 0.0  # size of the random variation of the anatomy; 0: as configured
    simulation: SimulationConfig = field(default_factory=SimulationConfig)  # type: ignore[valid-type]
    deviations: DeviationsConfig = field(default_factory=DeviationsConfig)  # type: ignore[valid-type]
    paper_moduli: list[float] = field(default_factory=list)  # MPa, of the paper's patient
    paper_distance_mm: list[float] = field(default_factory=list)  # generic, personalised


@dataclass
class DrawnValvesConfig:
    """A population of simulated valves."""

    count: int = MISSING
    seed: int = MISSING


@dataclass
class HeldOutConfig:
    """What detectors are tested on: numbers of simulated volumes of valves that no training saw."""

    volumes: int = MISSING  # of one frame, drawn as those of training are
    shifted: int = MISSING  # of one frame, outside the ranges of training
    curve_volumes: int = MISSING  # of each of these two, for detectors trained on fewer volumes
    sequences: int = MISSING  # of all frames of a valve, drawn as those of training are
    shifted_sequences: int = MISSING
    without_valve: int = MISSING  # of each kind of volume in which there is none
    wrong_mm: float = 5.0  # mean distance of a valve's points from which on it is not the valve


@dataclass
class ImagingConfig:
    """Detectors for valves in volumes: their training, and how well they do."""

    bases: dict[str, TemplateConfig] = field(default_factory=dict)  # type: ignore[valid-type]
    population: PopulationSettingsConfig = field(default_factory=PopulationSettingsConfig)  # type: ignore[valid-type]
    train: DrawnValvesConfig = field(default_factory=DrawnValvesConfig)
    calibration: DrawnValvesConfig = field(default_factory=DrawnValvesConfig)  # for the errors told
    test: DrawnValvesConfig = field(default_factory=DrawnValvesConfig)
    training: TrainingSettingsConfig = field(default_factory=TrainingSettingsConfig)  # type: ignore[valid-type]
    curve: list[int] = field(default_factory=list)  # volumes of further, smaller trainings
    detection: DetectionSettingsConfig = field(default_factory=DetectionSettingsConfig)  # type: ignore[valid-type]
    evaluate: bool = True
    held_out: HeldOutConfig = field(default_factory=HeldOutConfig)
    targets: dict[str, Any] = field(default_factory=dict)  # setting -> column of the table -> limit
    processes: int = 1
    publish_model: bool = False  # make the model the one that comes with the package


@dataclass
class EchoConfig:
    """How a virtual patient who is to be imaged moves, and how the volume is simulated."""

    spread: str = "training"  # of acquisitions; shifted: what no detector was trained on
    tip_motion_mm: list[float] = field(default_factory=lambda: [1.0, 3.0])  # of papillary tips


@dataclass
class ExternalConfig:
    """A program as the model, asked through files (mvest/external/README.md)."""

    command: list[str] = field(default_factory=list)  # the program and its arguments, no shell
    folder: str | None = None  # where its runs are kept; null: in the folder of the job
    observation: str | None = None  # .csv x,y,z (mm), one row per observed point
    points: str | None = None  # .csv x,y,z (mm), reference positions that the program is told
    units: list[str] = field(default_factory=list)  # of the parameters; empty: not told
    prior_std: list[float] = field(default_factory=list)  # of the parameters, in their units
    noise_mm: float | None = None  # SD of the error of each observed coordinate
    settings: dict[str, Any] = field(default_factory=dict)  # handed to the program as they are
    environment: dict[str, str] = field(default_factory=dict)  # beside what this process has
    inputs: list[str] = field(default_factory=list)  # files after whose change runs are done anew
    time_limit_s: float = 600.0  # of one run
    differences: str = "central"  # or forward, or none: the program must give jacobian.csv
    relative_step: float = 1e-3  # of a parameter, in differences
    floor: float = 0.0  # size of a parameter that may be zero
    processes: int = 1  # runs at a time
    reuse: bool = True  # finished runs serve again


@dataclass
class ModelsConfig:
    """The same sheet in two finite-element codes, and as a program."""

    sheet: SheetConfig = field(default_factory=SheetConfig)  # type: ignore[valid-type]
    refinements: list[Any] = field(default_factory=list)  # [along, across, layers] to compare on
    relative_step: float = 1e-3  # of the program's differences
    time_limit_s: float = 120.0  # of one run of the program
    processes: int = 1  # of its runs at a time


@dataclass
class LawStudyConfig:
    """What the study of the material law adds: the linear law's fit, and curves to draw."""

    linear_parameters: list[str] = field(default_factory=list)  # E_f of each leaflet
    linear_initial: list[float] = field(default_factory=list)  # MPa
    linear_P0: Any = None
    excised: dict[str, list[float]] = field(default_factory=dict)  # c0 (MPa), c1, c2


@dataclass
class CycleConfig:
    """What the studies of a whole cycle add."""

    protocol: CycleProtocolConfig = field(default_factory=CycleProtocolConfig)  # type: ignore[valid-type]
    noise_mm: float = 0.5  # SD of each coordinate
    exact_told_mm: float = 0.1  # SD that the filter is told of coordinates without noise
    seeds: int = 8
    # Decrease of the objective below which a search ends that starts near its end: 0.02 moves no
    # parameter by more than a fifth of its standard deviation, 0.05 by a third.
    objective_tolerance: float = 0.02
    finer_columns: int = 32  # cells of the mesh of a truth that is not the estimator's
    finer_rows: int = 4
    finer_contact: list[int] = field(default_factory=lambda: [96, 21])  # points, around and along
    finer_dt_factor: float = 0.5
    # Cells and contact points of the mesh on which the estimator looks for its own mesh's error,
    # with the time step of the finer truth's.
    check_columns: int = 40
    check_rows: int = 5
    check_contact: list[int] = field(default_factory=lambda: [120, 26])
    time_steps: list[float] = field(default_factory=list)  # s, each half of the one before
    path_steps: int = 16  # along which frames are looked at for jumps
    beats: int = 10  # over which a modulus drifts
    beat_times: list[float] = field(default_factory=lambda: [0.1, 0.2, 0.3, 0.4])  # s
    drift: float = -0.3  # of the first parameter, from the first beat to the last
    drift_std: float = 0.04  # that the filter is told of the logarithm from beat to beat


@dataclass
class FollowedConfig:
    """Observations of the closed valve from which profile likelihoods are followed."""

    vertices: str = MISSING  # a set of experiments.studies.identifiability.observed_sets
    pressures_mmHg: list[float] = MISSING
    label: str = MISSING


@dataclass
class DesignsConfig:
    """Which observations are compared before any is made, and how far valleys are followed."""

    pressures_mmHg: list[float] = field(default_factory=lambda: [60.0])  # of one closed frame more
    cycle_times: list[float] = field(default_factory=list)  # s, observed in a whole cycle
    cycle_dt: float = 0.003125  # s
    noise_mm: list[float] = field(default_factory=lambda: [0.1, 0.25, 0.5, 1.0])
    typical_mm: float = 0.5  # noise of profiles and of what tables say at one noise
    correlation_length_mm: float = 5.0
    target: float = 0.05  # relative standard deviation that is wanted of a modulus
    # Relative standard deviations of the nuisances, by what is assumed to be known of them: 0
    # for what is known, and nothing is known of what is not named.
    knowledge: dict[str, dict[str, float]] = field(default_factory=dict)
    believed: str = ""  # which of these holds where it is asked how well pressure must be known
    followed: list[FollowedConfig] = field(default_factory=list)
    known: list[str] = field(default_factory=list)  # parameters that profiles hold
    reach: dict[str, float] = field(default_factory=dict)  # largest change of each logarithm
    points: int = 8  # of a profile, on each side


@dataclass
class PredictionConfig:
    """What is predicted of estimated valves, and how well their truth is hit."""

    scenarios: dict[str, ScenarioConfig] = field(default_factory=dict)  # type: ignore[valid-type]
    samples: int = 32  # of the first patient's posterior; a power of two
    patients: int = 1  # simulated, with the seeds seed, seed + 1, ...
    further_samples: int = 8  # of the posterior of every other patient
    spread: list[float] = field(default_factory=list)  # SD of the logarithms of true parameters
    # Cells [around, annulus to edge] of further meshes on which peak stress is computed.
    stress_meshes: list[Any] = field(default_factory=list)
    # Cells of the finer mesh on which each estimate is predicted once, to tell the mesh's error;
    # empty: intervals know nothing of it.
    check_mesh: list[int] = field(default_factory=list)


@dataclass
class PatchConfig:
    """A stiff patch of the simulated truth, in material coordinates of the template."""

    region: str = "anterior"
    angle_deg: float = 90.0
    share: float = 0.5  # of the way from the annulus to the free edge
    radius_mm: float = 7.0
    factor: float = 2.0
    compared: bool = False  # with a valve that has no patch: takes twice as long


@dataclass
class PaperConfig:
    """What the paper reports for the same experiment."""

    table: str = MISSING
    estimate: list[float] | None = None  # MPa
    error_percent: list[float] | None = None
    moduli_error_percent: list[float] | None = None  # mean and SD over all moduli
    distance_mm: list[float] | None = None  # mean and SD


@dataclass
class PathsConfig:
    """Folders, relative to where the command is typed."""

    outputs: str = "outputs"
    results: str = "results"
    donor: str = "${oc.env:MVEST_TRIVALVE,../shared/data/trivalve}"  # recorded donor valve


@dataclass
class TrackingConfig:
    """MLflow; null is a local database in the outputs folder."""

    enabled: bool = True
    uri: str | None = None


@dataclass
class DiscretisationConfig:
    """What the mechanics are computed on, added to the library's settings."""

    element: str = "hex18"
    reading: str = "A"  # of the Poisson ratio, for every region
    contact_points: ContactPointsConfig = field(default_factory=ContactPointsConfig)


MechanicsConfig = schema(MechanicsSettings, DiscretisationConfig)


@dataclass
class Config:
    """A study."""

    name: str = MISSING
    study: str = "twin"
    title: str = MISSING
    row: str = MISSING  # what a table calls this run
    table: str = "${name}"  # which table in results/ it belongs to
    publish: bool = False  # whether results/ takes it over if run without overrides
    paper: PaperConfig | None = None
    parameters: list[str] = MISSING
    fixed: dict[str, float] = field(default_factory=dict)
    valve: TemplateConfig = field(default_factory=TemplateConfig)  # type: ignore[valid-type]
    mesh: MeshConfig = field(default_factory=MeshConfig)
    mechanics: MechanicsConfig = field(default_factory=MechanicsConfig)  # type: ignore[valid-type]
    filter: FilterConfig = field(default_factory=FilterConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    truth: TruthConfig = field(default_factory=TruthConfig)
    donor: DonorConfig = field(default_factory=DonorConfig)
    law_study: LawStudyConfig = field(default_factory=LawStudyConfig)
    case: str | None = None  # folder of a case
    volume: str | None = None  # file of a volume over time
    imaged: ImagedConfig = field(default_factory=ImagedConfig)
    check: bool = False  # only check the case, or the image step of a volume, and draw it
    personal: PersonalConfig = field(default_factory=PersonalConfig)
    patient: PatientConfig | None = None
    cycle: CycleConfig = field(default_factory=CycleConfig)
    patch: PatchConfig = field(default_factory=PatchConfig)
    echo: EchoConfig = field(default_factory=EchoConfig)
    imaging: ImagingConfig | None = None
    external: ExternalConfig = field(default_factory=ExternalConfig)
    models: ModelsConfig = field(default_factory=ModelsConfig)
    designs: DesignsConfig | None = None
    prediction: PredictionConfig = field(default_factory=PredictionConfig)
    filters: FilterStudyConfig | None = None
    continuation: bool = True  # later closures start from the last closed state
    continuation_reach: float | None = None  # if no logarithm of a parameter changes by more
    guided: bool = True  # the first closure is followed on coarser meshes
    confirm: bool = True  # close the fitted valve anew from the open state
    measure: bool = True  # orifice, coaptation and passing ball of the fitted valve: seconds
    seed: int = 1
    repeats: int = 1  # observations with the seeds seed, seed + 1, ..., each estimated from
    figures: bool = True  # draw the run; a sweep need not draw every job
    force: bool = False  # run again what is done
    dry_run: bool = False  # only say what would run, and how long it would take
    time_limit_s: float | None = None  # after which a job is stopped and recorded as failed
    isolate: bool = True  # in a sweep, jobs run in a process apart, whose death costs one row
    factors: dict[str, Any] = field(default_factory=dict)  # what is varied in this job, by name
    # A sweep's name, size, kind, and under the name of each size its grid, or a list of grids of
    # which it is the union; empty for a run by itself.
    sweep: dict[str, Any] = field(default_factory=dict)
    paths: PathsConfig = field(default_factory=PathsConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)


def plain(config: DictConfig, without: Collection[str] = ("hydra",)) -> dict[str, Any]:
    """A configuration, without some of its parts, as resolved plain data."""
    found: dict[str, Any] = {}
    for key in map(str, config):
        if key not in without:
            # Part by part: a copy without the others would take longer than everything else here.
            value = MISSING if OmegaConf.is_missing(config, key) else config[key]
            is_part = OmegaConf.is_config(value)
            found[key] = OmegaConf.to_container(value, resolve=True) if is_part else value
    return found


def hash_of(config: DictConfig) -> str:
    """SHA-256 of everything in a configuration that can change the result."""
    values = plain(config, NOT_THE_RESULT)
    for name in NOT_THE_RESULT:
        part, _, key = name.partition(".")
        if key and values.get(part) is not None:
            del values[part][key]
    return config_hash(values)


def _package_model() -> str | None:
    """SHA-256 of the detectors that come with the package, if there are any."""
    if not MODEL_FILE.is_file():
        return None
    return hashlib.sha256(MODEL_FILE.read_bytes()).hexdigest()


def register() -> None:
    """Make the schema and its resolvers known; may be called again.

    ``${config_hash:}`` is the hash of the configuration, ``${package_model:}`` that of the
    package's detectors.
    """
    ConfigStore.instance().store(name="schema", node=Config)
    OmegaConf.register_new_resolver("package_model", _package_model, replace=True)
    OmegaConf.register_new_resolver(
        "config_hash", lambda *, _root_: hash_of(_root_)[:16], replace=True
    )
