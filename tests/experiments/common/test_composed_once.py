"""What tests compose is what Hydra composes, though most of it is kept from one to the next."""

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf

from experiments.common.config import register
from tests.experiments.composed_once import MAKE_LIST, MERGE, composed_once
from tests.places import CONF


def composed(*overrides: str) -> str:
    register()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = compose("config", list(overrides), return_hydra_config=True)
        return OmegaConf.to_yaml(config)
    finally:
        GlobalHydra.instance().clear()


def test_it_is_what_hydra_composes(monkeypatch):
    asked = (
        ("experiment=debug", "seed=1"),
        ("experiment=debug", "seed=2", "filter.initial=[1,2]"),
        ("experiment=debug", "filter=paper", "seed=2"),
        ("experiment=debug", "seed=1"),
    )
    merged = []

    def watched(self, defaults, repo):
        merged.append(len(defaults))
        return MERGE(self, defaults, repo)

    monkeypatch.setattr("tests.experiments.composed_once.MERGE", watched)
    with composed_once():
        kept = [composed(*overrides) for overrides in asked]
        for _ in range(2):
            with pytest.raises(ConfigCompositionException, match="sed"):
                composed("experiment=debug", "sed=1")
    assert len(merged) == 2
    monkeypatch.setattr(config_loader_impl, "create_defaults_list", MAKE_LIST)
    monkeypatch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", MERGE)
    assert kept == [composed(*overrides) for overrides in asked]
    assert len(set(kept)) == 3
