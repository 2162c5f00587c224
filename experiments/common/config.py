"""The schema of every configuration, registered with Hydra.

What the library names is taken from the library (`experiments.common.schema`); what a study adds is
its own `Settings`. Everything else is declared here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import PurePath
from typing import Annotated, Any, Literal, TypeAlias

from hydra.core.config_store import ConfigNode, ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING, DictConfig, OmegaConf

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
from mvest.mechanics.settings import MechanicsSettings
from mvest.problem.registration import range_of
from mvest.provenance import config_hash
from mvest.quantities import (
    AxisCount,
    CellsAlong,
    CellsAround,
    EdgeLength,
    Gigabytes,
    Layers,
    Length,
    Logarithm,
    Modulus,
    Percent,
    Place,
    PointsAlong,
    PointsAround,
    Ratio,
    Refinement,
    Repeats,
    Seed,
    TimeLimit,
    Value,
    Values,
    within,
)

GROUP = "study"
"""The configuration group of the studies."""

MAX_NAME = 120
"""Letters of a text that names files."""

NAMES = ("name", "table", "study")
"""Settings that name files and folders, besides ``sweep.name``."""

Switch: TypeAlias = Annotated[bool, NOT_HASHED]
ByParameter: TypeAlias = Annotated[dict[str, float], BY_PARAMETER]


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """The estimator's mesh."""

    # tetwild: an unstructured mesh of the thickened leaflets
    source: Literal["structured", "tetwild"] = "structured"
    columns: CellsAround = MISSING
    rows: CellsAlong = MISSING
    layers: Layers = 1
    edge_length: EdgeLength = 2.5  # of an unstructured mesh


@dataclass(frozen=True, kw_only=True)
class ContactPoints:
    """Where contact is sampled, in material coordinates: the same for every mesh."""

    columns: PointsAround = 144
    rows: PointsAlong = 32


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """The prior, the assumed noise, and the filter."""

    mode: str = MISSING  # what tables call the filter
    method: dict[str, Any] = field(default_factory=dict)  # its _target_ and its own settings
    initial: tuple[Value, ...] = MISSING  # prior mean of the parameters
    P0: Values = MISSING  # variance, variances or matrix
    R: Values = 0.01  # mm², one or one for each observed frame
    R_correlation_mm: Length = 0.0  # correlation length of R along the leaflets; 0: independent
    transform: Literal["identity", "log"] = "identity"


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What is seen of the valve, and how it differs from what is there."""

    frames: tuple[str, ...] = ("open", "closed")
    columns: PointsAround = 112
    rows: PointsAlong = 29
    label: str = "none"  # what a table calls its errors
    noise_mm: Length = 0.0  # SD of independent errors of each coordinate
    correlated_mm: Length = 0.0  # SD of errors that neighbouring vertices share
    correlation_length_mm: Length = 5.0
    dropout_mm: Length = 0.0  # closed vertices this near to another leaflet are not seen
    annulus_offset_mm: tuple[Place, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What the synthetic observation is made from; null means as the estimator's model."""

    values: tuple[Value, ...] = MISSING
    label: str = MISSING  # what a table calls it
    refine: Refinement = 1  # cells of the truth's mesh per cell of the estimator's, each way
    source: Literal["structured", "tetwild"] | None = None
    columns: CellsAround | None = None
    rows: CellsAlong | None = None
    layers: Layers | None = None
    element: str | None = None
    # Columns and rows of a coarser mesh: both closures are extrapolated to zero mesh size.
    extrapolated_from: tuple[AxisCount, ...] = ()
    dt_factor: Annotated[float, within(0.001, 100, "", "one time step over another")] = 1.0
    reading: str | None = None  # Poisson option
    ratio: dict[str, Ratio] = field(default_factory=dict)  # region -> E_f over E_perp
    fixed: ByParameter = field(default_factory=dict)  # pressure_scale, chord_stiffness, ...


@dataclass(frozen=True, kw_only=True)
class Paper:
    """What the paper reports for the same experiment."""

    table: str = MISSING
    estimate: tuple[Modulus, ...] | None = None
    error_percent: tuple[Percent, ...] | None = None
    moduli_error_percent: tuple[Percent, ...] | None = None  # mean and SD over all moduli
    distance_mm: tuple[Length, ...] | None = None  # mean and SD


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
    """The mechanics, and what they are computed on."""

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
    publish: Switch = False  # whether results take it over if run without overrides
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
    continuation_reach: Logarithm | None = None  # unless the log of a parameter changes by more
    guided: bool = True  # the first closure is followed on coarser meshes
    seed: Seed = 1
    repeats: Repeats = 1  # observations with the seeds seed, seed + 1, ..., each estimated from
    figures: Switch = True  # draw the run; a sweep need not draw every job
    force: Switch = False  # run again what is done
    dry_run: Switch = False  # only say what would run, and how long it would take
    detach: Switch = False  # of a sweep: only plan its jobs, for `mvest worker`
    # After this a job is stopped and recorded as failed.
    time_limit_s: Annotated[TimeLimit | None, NOT_HASHED] = None
    # Beyond this a job fails; null: its part of the machine.
    memory_limit_gb: Annotated[Gigabytes | None, NOT_HASHED] = None
    # What optimising sweepers compare jobs by: a number of a run, as MLflow names it.
    objective: Annotated[str, NOT_HASHED] = "error.mean"
    # What is varied in this job, by name.
    factors: Annotated[dict[str, Any], NOT_HASHED] = field(default_factory=dict)
    # A sweep's name, size, and under the name of each size its grid, or a list of grids of
    # which it is the union; empty for a run by itself.
    sweep: Annotated[dict[str, Any], NOT_HASHED] = field(default_factory=dict)
    paths: Annotated[Paths, NOT_HASHED] = field(default_factory=Paths)
    tracking: Annotated[Tracking, NOT_HASHED] = field(default_factory=Tracking)


def plain(config: DictConfig) -> dict[str, Any]:
    """A configuration, without Hydra's part, as resolved plain data.

    Raises
    ------
    ConfigurationError
        If an override has deleted a setting.
    """
    found: dict[str, Any] = {}
    for key in map(str, config):
        if key != "hydra":
            # Part by part: a copy without the others would take longer than everything else here.
            value = MISSING if OmegaConf.is_missing(config, key) else config[key]
            is_part = OmegaConf.is_config(value)
            found[key] = OmegaConf.to_container(value, resolve=True) if is_part else value
    for name in _kinds(found.get("study")):
        if name not in config:
            raise ConfigurationError(f"{name} has no value")
    return found


def hash_of(config: DictConfig | Mapping[str, Any]) -> str:
    """SHA-256 of everything in a configuration, resolved or not, that can change the result.

    A file or folder that it names counts by its content, not by its name.
    """
    values = plain(config) if isinstance(config, DictConfig) else config
    _require_names(values)  # of the folder, which Hydra makes next
    return config_hash(with_contents(_kinds(values.get("study")), values, hashed=True))


def is_hashed(key: str, study: str | None) -> bool:
    """Whether a setting, or what it is part of, can change the result of a study."""
    kinds = _kinds(study)
    for name in key.split("."):
        kind, marks = parts_of(kinds.get(name, Any))
        if NOT_HASHED in marks:
            return False
        kinds = kinds_in(kind, ())
    return True


def require_in_range(values: Mapping[str, Any]) -> None:
    """Refuse a configuration with a number outside its range, or a text that is none.

    Parameters
    ----------
    values : mapping
        Plain data, resolved.

    Raises
    ------
    ConfigurationError
        One line with the setting, its value and the range.
    """
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
    """Refuse a name that is none for a file."""
    names = {key: values.get(key) for key in NAMES}
    names["sweep.name"] = (values.get("sweep") or {}).get("name")
    for key, given in names.items():
        name = str(given or "")
        if len(name) > MAX_NAME:
            raise ConfigurationError(f"{key} has more than {MAX_NAME} letters")
        if name and (PurePath(name).name != name or name[0] == "." or not name.isprintable()):
            raise ConfigurationError(f"{key} = {name!r}, expected a name of a file or folder")


def without_places(values: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration as it is written and given away: no name of a file or folder of its user.

    A setting that names a file has its SHA-256 instead; the folders of results are left out.
    """
    known = {str(key): value for key, value in values.items() if key != "paths"}
    return with_contents(_kinds(known.get("study")), known, hashed=False)


@cache
def _kinds(study: str | None) -> dict[str, Any]:
    """Setting of a study at the top -> its type."""
    if study not in study_names():
        return hints_of(Config)
    settings: type = load_study(study).settings
    return {**hints_of(Config), **hints_of(settings)}


def _package_model() -> str | None:
    """SHA-256 of the detectors that come with the package, if there are any."""
    if not MODEL_FILE.is_file():
        return None
    return sha256_of(MODEL_FILE)


class Studies(dict[str, Any]):
    """Hydra's configuration group ``study``: the schema of a study is made when Hydra reads it.

    So a job imports its own study only, and a new study needs no registration.
    """

    def __getitem__(self, file: str) -> ConfigNode:
        name = file.removesuffix(".yaml")
        settings: type = load_study(name).settings
        config = OmegaConf.structured(schema(Config, settings))
        config.study = name
        return ConfigNode(file, config, GROUP, "_global_", "mvest")


def _valve_folder(*, _root_: DictConfig) -> str | None:
    """SHA-256 of the case folder whose anatomy is configured, if there is one."""
    return folder_hash(_root_.valve.folder)


def _chosen(group: str, *, _root_: DictConfig) -> str:
    """What was chosen of a group; its name where that is not known."""
    # A job of a sweep is composed with Hydra's part, one by itself is not.
    if OmegaConf.select(_root_, "hydra") is not None:
        return str(_root_.hydra.runtime.choices[group])
    known = HydraConfig.initialized()
    return str(HydraConfig.get().runtime.choices[group]) if known else group


def register() -> None:
    """Make the schemas and the resolvers known; may be called again.

    ``${config_hash:}`` is the hash of the configuration, ``${package_model:}`` that of the
    package's detectors, ``${chosen:GROUP}`` what was chosen of a group,
    ``${valve_folder:}`` the hash of the case whose anatomy is configured.
    """
    studies = Studies.fromkeys(f"{name}.yaml" for name in study_names())
    ConfigStore.instance().repo[GROUP] = studies
    OmegaConf.register_new_resolver("package_model", _package_model, replace=True)
    OmegaConf.register_new_resolver("valve_folder", _valve_folder, replace=True)
    OmegaConf.register_new_resolver("chosen", _chosen, replace=True)
    OmegaConf.register_new_resolver(
        "config_hash", lambda *, _root_: hash_of(_root_)[:16], replace=True
    )
