"""The schema of every configuration, registered with Hydra.

What the library names is taken from the library (``experiments.common.schema``); only what a study
adds to it is written down here.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, make_dataclass
from functools import cache
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import MISSING, DictConfig, OmegaConf

from experiments.common.building.anatomy import ValveFolderConfig, folder_hash
from experiments.common.schema import schema, with_contents
from experiments.common.study import load_settings, study_names
from mvest.estimation.filters.ensemble import EnsembleFilter
from mvest.estimation.filters.monte_carlo import MonteCarloFilter
from mvest.files import sha256_of
from mvest.imaging.models import MODEL_FILE
from mvest.mechanics.settings import MechanicsSettings
from mvest.provenance import config_hash
from mvest.valve.anatomy.template import TemplateParameters

__all__ = ["NOT_THE_RESULT", "hash_of", "plain", "register", "without_places"]

AS_BEFORE: dict[str, Any] = {
    "check_runs": 0,
    "curve": [],
    "active": True,
    "extrapolated_from": [],
    "folder_sha256": None,
    "annulus_contraction": 0.0,
}
"""Settings that came after results which are as with these values; so they leave no trace in the
hash, wherever they stand in a configuration."""

GROUP = "study"
"""The configuration group of the rooms."""

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
    "detach",
    "time_limit_s",
    "memory_limit_gb",
    "isolate",
    "check",
    "imaging.processes",
    "imaging.publish_model",
    "external.folder",
    "external.processes",
    "models.processes",
    "valve.folder",
)
"""What in a configuration changes no number of the result, left out of its hash."""


TemplateConfig = schema(TemplateParameters, ValveFolderConfig)
EnsembleFilterConfig = schema(EnsembleFilter)
MonteCarloFilterConfig = schema(MonteCarloFilter)


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

    mode: str = MISSING  # paper, extended, iterated, unscented, ensemble, monte_carlo or importance
    initial: list[float] = MISSING  # prior mean of the parameters
    P0: Any = MISSING  # variance, variances or matrix
    Q: Any = 0.01  # the same, added each round of the paper's mode
    R: Any = 0.01  # mm², one or one for each observed frame
    R_correlation_mm: float = 0.0  # correlation length of R along the leaflets; 0: independent
    transform: str = "identity"  # or log
    tolerance: float = 1e-4
    max_iterations: int = 30
    spread: float = 1.0  # of sigma points, in parts of the simplex whose covariance is P
    check_runs: int = 0  # made at the end to check the posterior; an ensemble has its own
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
    # Columns and rows of a coarser mesh: closures on both are carried on to cells of no size.
    extrapolated_from: list[int] = field(default_factory=list)
    dt_factor: float = 1.0
    reading: str | None = None  # of the Poisson ratio
    ratio: dict[str, float] = field(default_factory=dict)  # region -> E_f over E_perp
    fixed: dict[str, float] = field(default_factory=dict)  # pressure_scale, chord_stiffness, ...


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
    results: str = "${.outputs}/results"  # published tables; those of a checkout: results


@dataclass
class TrackingConfig:
    """MLflow; null is a local database in the outputs folder."""

    enabled: bool = True
    uri: str | None = None
    runs: bool | None = None  # whether each job of a sweep is a run; null: of up to 1000 jobs


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
    study: str = MISSING  # a room of experiments/studies
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
    check: bool = False  # only check the case, or the image step of a volume, and draw it
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
    detach: bool = False  # of a sweep: submit its jobs, or only plan them, and leave
    time_limit_s: float | None = None  # after which a job is stopped and recorded as failed
    memory_limit_gb: float | None = None  # beyond which it fails; null: its part of the machine
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


def hash_of(config: DictConfig | Mapping[str, Any]) -> str:
    """SHA-256 of everything in a configuration, resolved or not, that can change the result.

    Of files and folders that it names what lies there counts, and not their names.
    """
    values = plain(config, NOT_THE_RESULT) if isinstance(config, DictConfig) else config
    kept = {str(key): value for key, value in values.items() if key not in NOT_THE_RESULT}
    for name in NOT_THE_RESULT:
        part, _, inner = name.partition(".")
        if inner and kept.get(part) is not None:
            kept[part] = {key: value for key, value in kept[part].items() if key != inner}
    return config_hash(with_contents(_settings(kept.get("study")), _without_as_before(kept)))


def without_places(values: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration as it is written and given away: no name of a file or folder of its user.

    What a setting reads has its SHA-256 in the place of its name; where results lie is left out.
    """
    kept = {str(key): value for key, value in values.items() if key != "paths"}
    return dict(with_contents(_settings(kept.get("study")), kept))


def _without_as_before(part: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _without_as_before(value) if isinstance(value, Mapping) else value
        for key, value in part.items()
        if not (key in AS_BEFORE and value == AS_BEFORE[key])
    }


@cache
def _settings(study: str | None) -> type | None:
    return load_settings(study) if study in study_names() else None


def _package_model() -> str | None:
    """SHA-256 of the detectors that come with the package, if there are any."""
    if not MODEL_FILE.is_file():
        return None
    return sha256_of(MODEL_FILE)


class StudySource(ConfigSource):
    """The configuration group ``study``: the schema of each room, made when it is asked for.

    So a job imports its own study's settings only, and a new room needs no registration.
    """

    @staticmethod
    def scheme() -> str:
        """What the search path names it by."""
        return "studies"

    def load_config(self, config_path: str) -> ConfigResult:
        """The schema of a room: what every study has, and what its own settings add."""
        name = _room(config_path)
        node = schema(load_settings(name), Config)
        whole = make_dataclass(f"{name}_study", [("study", str, name)], bases=(node,))
        return ConfigResult(
            provider=self.provider,
            path=self.full_path(),
            config=OmegaConf.structured(whole),
            header={"package": "_global_"},
        )

    def is_group(self, config_path: str) -> bool:
        """Whether this is the one group, or what holds it."""
        return config_path.strip("/") in ("", GROUP)

    def is_config(self, config_path: str) -> bool:
        """Whether there is such a room."""
        return _room(config_path) in study_names()

    def available(self) -> bool:
        """Always."""
        return True

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """The group, or the rooms in it."""
        if config_path.strip("/") != GROUP:
            return [] if results_filter == ObjectType.CONFIG else [GROUP]
        return [] if results_filter == ObjectType.GROUP else sorted(study_names())


def _room(config_path: str) -> str:
    group, _, name = config_path.strip("/").partition("/")
    return name.removesuffix(".yaml") if group == GROUP else ""


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
    Plugins.instance().register(StudySource)
    OmegaConf.register_new_resolver("package_model", _package_model, replace=True)
    OmegaConf.register_new_resolver("valve_folder", _valve_folder, replace=True)
    OmegaConf.register_new_resolver("chosen", _chosen, replace=True)
    OmegaConf.register_new_resolver(
        "config_hash", lambda *, _root_: hash_of(_root_)[:16], replace=True
    )
