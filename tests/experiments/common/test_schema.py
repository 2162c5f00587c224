import dataclasses
from dataclasses import dataclass

from omegaconf import OmegaConf

from experiments.common.building.closure import ValveSettings
from experiments.common.config import Mechanics
from experiments.common.schema import build, schema
from mvest.imaging.learning.training import TrainingSettings
from mvest.mechanics.settings import MechanicsSettings, TissueSettings
from mvest.simulation.motion import MotionSettings
from mvest.valve.anatomy.dimensions import TemplateParameters


@dataclass(frozen=True)
class Inner:
    x: float = 1.5


@dataclass(frozen=True)
class Outer:
    needed: float
    inner: Inner = Inner()
    numbers: tuple[float, ...] = (1.0, 2.0)
    pairs: tuple[tuple[float, float], ...] = ((1.0, 2.0),)
    table: dict[str, Inner] = dataclasses.field(default_factory=dict)
    maybe: int | None = None


def test_there_and_back() -> None:
    config = OmegaConf.structured(schema(Outer))
    config.merge_with(
        {"needed": 2, "inner": {"x": 3}, "pairs": [[3, 4], [5, 6]], "table": {"a": {}}}
    )
    assert build(Outer, OmegaConf.to_container(config)) == Outer(
        2.0, Inner(3.0), pairs=((3, 4), (5, 6)), table={"a": Inner()}
    )


def test_the_librarys_defaults_are_the_configurations() -> None:
    template = OmegaConf.to_container(OmegaConf.structured(schema(ValveSettings)))
    assert build(TemplateParameters, template) == TemplateParameters()
    # Dataclasses within dataclasses, and mappings.
    for cls in (MotionSettings, TrainingSettings):
        made = OmegaConf.to_container(OmegaConf.structured(schema(cls)))
        assert build(cls, made) == cls()
    mechanics = OmegaConf.structured(schema(Mechanics))
    mechanics.merge_with({"tissue": {"anterior": {"ratio": 2.0}}})
    tissue = {"anterior": TissueSettings(2.0)}
    assert build(MechanicsSettings, OmegaConf.to_container(mechanics)) == MechanicsSettings(tissue)
