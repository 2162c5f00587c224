"""What Hydra is extended by: a sweeper that plans all jobs, and then has them run."""

from __future__ import annotations

import sys
from types import ModuleType

from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

PLACE = "hydra_plugins.mvest"
"""Where Hydra finds plugins: it takes them from modules of that package only."""


class FailedSweepError(Exception):
    """A job of a sweep has no estimate; the sweep has said so."""


class PlannedSweeper(Sweeper):
    """Plans all jobs of a sweep before it launches those that are not done.

    Parameters
    ----------
    params : mapping or sequence of mapping, optional
        A grid (setting -> choices in Hydra's syntax), or several grids that stand for their union.
        They are read from the configuration, where a sweep's own size takes their place.
    """

    def __init__(self, params: object = None) -> None:
        self._parts: tuple[HydraContext, DictConfig] | None = None

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Keep what Hydra has to say about the sweep; its jobs run in processes of their own."""
        self._parts = hydra_context, config

    def sweep(self, arguments: list[str]) -> None:
        """Plan, check, launch, collect and log.

        Raises
        ------
        FailedSweepError
            If a job has no estimate.
        MvestError, HydraException, OmegaConfBaseException
            If the request is wrong.
        """
        # Imports every study, for seconds: not where only help is asked for.
        from experiments.runner.sweep import run_sweep

        assert self._parts is not None
        if run_sweep(*self._parts, arguments):
            raise FailedSweepError


def register_plugins() -> None:
    """Make them known to Hydra; may be called again."""
    plugins = Plugins.instance()  # imports the package of plugins, if any other is installed
    package, _, name = PLACE.rpartition(".")
    place = ModuleType(PLACE)
    sys.modules[PLACE] = place
    setattr(sys.modules.setdefault(package, ModuleType(package)), name, place)
    PlannedSweeper.__module__ = PLACE
    place.__dict__[PlannedSweeper.__name__] = PlannedSweeper
    plugins.register(PlannedSweeper)
