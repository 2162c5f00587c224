"""Configurations as the application composes them."""

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from experiments.common.config import register
from tests.places import CONF


def composed(*overrides: str) -> DictConfig:
    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", list(overrides))


def plain(config: DictConfig) -> dict:
    values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    assert isinstance(values, dict)
    return values
