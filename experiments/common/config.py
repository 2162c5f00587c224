"""The schema of every configuration, registered with Hydra.

Settings of the library are declared in the library (`experiments.common.schema` converts them), and
those of a study in its own `Settings`. Everything else is declared here.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import PurePath
from typing import Annotated, Any, Literal, TypeAlias

from hydra.core.config_store import ConfigNode, ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING, DictConfig, OmegaConf

import mvest.quantities as q
from experiments.common.building.closure import ValveSettings, folder_hash
from experiments.common.schema import (
    BY_PARAMETER,
    NOT_HASHED,
    hints_of,
    kinds_in,
    parts_of,
    require_admissible_values,
    schema,
    validated,
    with_contents,
)
from experiments.common.study import load_study, study_names
from mvest.errors import ConfigurationError
from mvest.files import sha256_of
from mvest.imaging.models import MODEL_FILE
from mvest.mechanics.settings import MechanicsSettings, Relaxation, TissueSettings
from mvest.problem.registration import range_of
from mvest.provenance import config_hash

MAX_NAME = 120  # letters of a text that names files
NAMES = ("name", "table", "study")  # settings that name files and folders, besides ``sweep.name``

Switch: TypeAlias = Annotated[bool, NOT_HASHED]
ByParameter: TypeAlias = Annotated[dict[str, float], BY_PARAMETER]


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """The estimator's mesh."""

    # tetwild: an unstructured mesh of the thickened leaflets
    source: Literal["structured", "tetwild"] = "structured"
    columns: q.CellsAround = MISSING
    rows: q.CellsAlong = MISSING
    layers: q.Layers = 1
    edge_length: q.EdgeLength = 2.5  # of an unstructured mesh


@dataclass(frozen=True, kw_only=True)
class ContactPoints:
    """Where contact is sampled, in material coordinates: the same for every mesh."""

    columns: q.PointsAround = 144
    rows: q.PointsAlong = 32


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """The prior, the assumed noise, and the filter."""

    mode: str = MISSING  # what tables call the filter
    method: dict[str, Any] = field(default_factory=dict)  # its _target_ and its own settings
    initial: tuple[q.Value, ...] = MISSING  # prior mean of the parameters
    P0: q.Values = MISSING  # variance, variances or matrix
    R: q.Values = 0.01  # mm², one or one for each observed frame
    R_correlation_mm: q.Length = 0.0  # correlation length of R along the leaflets; 0: independent
    transform: Literal["identity", "log"] = "identity"


@dataclass(frozen=True, kw_only=True)
class Observation:
    """Which frames and points of the valve are observed, and with which errors."""

    frames: tuple[str, ...] = ("open", "closed")
    columns: q.PointsAround = 112
    rows: q.PointsAlong = 29
    label: str = "none"  # what a table calls its errors
    noise_mm: q.Length = 0.0  # SD of independent errors of each coordinate
    correlated_mm: q.Length = 0.0  # SD of errors that neighbouring vertices share
    correlation_length_mm: q.Length = 5.0
    dropout_mm: q.Length = 0.0  # closed vertices closer than this to another leaflet are lost
    annulus_offset_mm: tuple[q.Place, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The model that makes the synthetic observation; null: as in the estimator's model."""

    values: tuple[q.Value, ...] = MISSING
    label: str = MISSING  # what a table calls it
    refine: q.Refinement = 1  # cells of the truth's mesh per cell of the estimator's, each way
    source: Literal["structured", "tetwild"] | None = None
    columns: q.CellsAround | None = None
    rows: q.CellsAlong | None = None
    layers: q.Layers | None = None
    element: str | None = None
    # Columns and rows of a coarser mesh: both closures are extrapolated to zero mesh size.
    extrapolated_from: tuple[q.AxisCount, ...] = ()
    dt_factor: Annotated[float, q.within(0.001, 100, "", "one time step over another")] = 1.0
    tissue: dict[str, TissueSettings] = field(default_factory=dict)  # empty: the estimator's
    relaxation: Relaxation | None = None
    fixed: ByParameter = field(default_factory=dict)  # pressure_scale, chord_stiffness, ...


@dataclass(frozen=True, kw_only=True)
class Paper:
    """What the paper reports for the same experiment."""

    table: str = MISSING
    estimate: tuple[q.Modulus, ...] | None = None
    error_percent: tuple[q.Percent, ...] | None = None
    moduli_error_percent: tuple[q.Percent, ...] | None = None  # mean and SD over all moduli
    distance_mm: tuple[q.Length, ...] | None = None  # mean and SD


@dataclass(frozen=True, kw_only=True)
class Paths:
    """Folders, relative to where the command is typed."""

    outputs: str = "outputs"
    results: str = "${.outputs}/results"  # published tables; those of a checkout: results


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """MLflow; null is a local database in the outputs folder."""

    enabled: bool = True
    uri: str | None = None


@dataclass(frozen=True, kw_only=True)
class Mechanics(MechanicsSettings):
    """The mechanics, their finite element, and the contact points."""

    element: str = "hex18"
    reading: str = "A"  # Poisson option of every region
    contact_points: ContactPoints = field(default_factory=ContactPoints)


@dataclass(frozen=True, kw_only=True)
class Config:
    """What every study has."""

    name: str = MISSING
    study: str = MISSING
    title: str = MISSING
    row: str = MISSING  # what a table calls this run
    table: str = "${name}"  # which table in results/ it belongs to
    publish: Switch = False  # copy the record to results/ if run without overrides
    paper: Paper | None = None
    parameters: tuple[str, ...] = MISSING
    fixed: ByParameter = field(default_factory=dict)
    valve: ValveSettings = field(default_factory=ValveSettings)
    mesh: Mesh = field(default_factory=Mesh)
    mechanics: Mechanics
    filter: FilterSettings = field(default_factory=FilterSettings)
    observation: Observation = field(default_factory=Observation)
    truth: Truth = field(default_factory=Truth)
    check: Switch = False  # only check the case, or the image step of a volume, and draw it
    continuation: bool = True  # later closures start from the last closed state
    continuation_reach: q.Logarithm | None = None  # unless the log of a parameter changes by more
    guided: bool = True  # the first closure is followed on coarser meshes
    seed: q.Seed = 1
    repeats: q.Repeats = 1  # observations with the seeds seed, seed + 1, ..., each estimated from
    figures: Switch = True  # draw the run; a sweep need not draw every job
    force: Switch = False  # run finished jobs again
    dry_run: Switch = False  # only list what would run, and how long it would take
    detach: Switch = False  # only plan the jobs of a sweep, for `mvest worker`
    # A job that takes longer is stopped and recorded as failed.
    time_limit_s: Annotated[q.TimeLimit | None, NOT_HASHED] = None
    # A job that needs more fails; null: an equal share of the machine's memory.
    memory_limit_gb: Annotated[q.Gigabytes | None, NOT_HASHED] = None
    # The metric that optimising sweepers minimise, by its name in MLflow.
    objective: Annotated[str, NOT_HASHED] = "error.mean"
    # What is varied in this job, by name.
    factors: Annotated[dict[str, Any], NOT_HASHED] = field(default_factory=dict)
    # A sweep's name, its size, and for each size a grid or a list of grids (their union); empty
    # for a single run.
    sweep: Annotated[dict[str, Any], NOT_HASHED] = field(default_factory=dict)
    paths: Annotated[Paths, NOT_HASHED] = field(default_factory=Paths)
    tracking: Annotated[Tracking, NOT_HASHED] = field(default_factory=Tracking)


def plain(config: DictConfig) -> dict[str, Any]:
    """Resolved plain data; raises a `ConfigurationError` if a setting was deleted."""
    found: dict[str, Any] = {}
    for key in map(str, config):
        if key != "hydra":
            # Part by part: a copy without Hydra's part would take longer than all else here.
            value = MISSING if OmegaConf.is_missing(config, key) else config[key]
            is_part = OmegaConf.is_config(value)
            found[key] = OmegaConf.to_container(value, resolve=True) if is_part else value
    for name in _kinds(found.get("study")):
        if name not in config:
            raise ConfigurationError(f"{name} has no value")
    return found


def hash_of(config: DictConfig | Mapping[str, Any]) -> str:
    """SHA-256 of everything that can change the result; files count by content, not by name."""
    values = plain(config) if isinstance(config, DictConfig) else config
    _require_names(values)  # Hydra is about to make a folder of this name
    return config_hash(with_contents(_kinds(values.get("study")), values, hashed=True))


def is_hashed(key: str, study: str | None) -> bool:
    """Whether a setting, or the part that holds it, can change the result of a study."""
    kinds = _kinds(study)
    for name in key.split("."):
        kind, marks = parts_of(kinds.get(name, Any))
        if NOT_HASHED in marks:
            return False
        kinds = kinds_in(kind, ())
    return True


def require_in_range(values: Mapping[str, Any]) -> None:
    """Raise a `ConfigurationError` for a number outside its range, or an unusable text."""
    _require_names(values)
    kinds = _kinds(values.get("study"))
    for name, value in values.items():
        require_admissible_values(kinds.get(name, Any), value, name)
    for part, key in (("truth", "values"), ("filter", "initial")):
        given = (values.get(part) or {}).get(key) or ()
        for parameter, value in zip(values.get("parameters") or (), given, strict=False):
            kind = Annotated[float, range_of(str(parameter))]
            validated(kind, value, f"{part}.{key} of {parameter}")


def _require_names(values: Mapping[str, Any]) -> None:
    """Refuse texts that cannot name a file."""
    names = {key: values.get(key) for key in NAMES}
    names["sweep.name"] = (values.get("sweep") or {}).get("name")
    for key, given in names.items():
        name = str(given or "")
        if len(name) > MAX_NAME:
            raise ConfigurationError(f"{key} has more than {MAX_NAME} letters")
        if name and (PurePath(name).name != name or name[0] == "." or not name.isprintable()):
            raise ConfigurationError(f"{key} = {name!r}, expected a name of a file or folder")


def without_places(values: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration without names of the user's files and folders, for writing to disk.

    A setting that names a file has its SHA-256 instead; the folders of results are left out.
    """
    known = {str(key): value for key, value in values.items() if key != "paths"}
    return with_contents(_kinds(known.get("study")), known, hashed=False)


@cache
def _kinds(study: str | None) -> dict[str, Any]:
    """Top-level setting of a study -> its type."""
    if study not in study_names():
        return hints_of(Config)
    return {**hints_of(Config), **load_study(study).kinds}


class Studies(dict[str, Any]):
    """Hydra's configuration group ``study``. A schema is made when Hydra reads it.

    So a job imports only its own study, and a new study needs no registration.
    """

    def __getitem__(self, file: str) -> ConfigNode:
        name = file.removesuffix(".yaml")
        study = load_study(name)
        settings: type = study.settings
        config = OmegaConf.structured(schema(Config, settings, part=study.part))
        config.study = name
        return ConfigNode(file, config, "study", "_global_", "mvest")


def _chosen(group: str, *, _root_: DictConfig) -> str:
    """The choice of a configuration group; the group's name where it is not known."""
    # The configuration of a sweep's job includes Hydra's part; that of a single run does not.
    if OmegaConf.select(_root_, "hydra") is not None:
        return str(_root_.hydra.runtime.choices[group])
    known = HydraConfig.initialized()
    return str(HydraConfig.get().runtime.choices[group]) if known else group


def register() -> None:
    """Register the schemas and resolvers; may be called again.

    ``${config_hash:}`` is the hash of the configuration, ``${package_model:}`` that of the
    package's detectors, ``${chosen:GROUP}`` the choice of a group, and ``${valve_folder:}`` the
    hash of the case whose anatomy is configured.
    """
    studies = Studies.fromkeys(f"{name}.yaml" for name in study_names())
    ConfigStore.instance().repo["study"] = studies
    resolvers: dict[str, Callable[..., str | None]] = {
        "package_model": lambda: sha256_of(MODEL_FILE) if MODEL_FILE.is_file() else None,
        "valve_folder": lambda *, _root_: folder_hash(_root_.valve.folder),
        "chosen": _chosen,
        "config_hash": lambda *, _root_: hash_of(_root_)[:16],
    }
    for name, resolver in resolvers.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)
