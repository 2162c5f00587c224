"""Plugins for Hydra: a sweeper for grids and their unions, and a launcher of many jobs.

Both work with Hydra's other plugins: the launcher with any sweeper (``hydra/sweeper=basic``,
optuna's), and the sweeper with any launcher (``hydra/launcher=basic`` runs jobs in this process).
"""

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

PLACE = "hydra_plugins.mvest"
"""Module of the plugins; Hydra accepts them only from the package ``hydra_plugins``."""


class FailedSweepError(Exception):
    """A job of a sweep has no estimate; that was printed."""


class GridSweeper(Sweeper):
    """Passes all jobs of a grid, or of a union of grids, to the launcher at once.

    ``params``, a grid (setting -> choices in Hydra's syntax) or a list of grids, is read from the
    configuration, where a sweep's own size replaces it.
    """

    def __init__(self, params: object = None) -> None:
        self._parts: tuple[HydraContext, DictConfig, Launcher] | None = None

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Store the configuration of the sweep, and its launcher."""
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )
        self._parts = hydra_context, config, launcher

    def sweep(self, arguments: list[str]) -> Sequence[JobReturn]:
        """Expand and launch the jobs; raises a `FailedSweepError` if one has no estimate.

        Raises an `MvestError`, `HydraException` or `OmegaConfBaseException` if the request is
        wrong.
        """
        from experiments.runner.compose import expand

        assert self._parts is not None
        context, config, launcher = self._parts
        jobs = expand(config, arguments, context.config_loader)
        returned = launcher.launch(jobs, initial_job_idx=0)
        if any(one.status != JobStatus.COMPLETED for one in returned):
            raise FailedSweepError
        return returned


class JobLauncher(Launcher):
    """Plans and checks jobs, runs those that are not done, and collects and logs all of them.

    Each job runs in a separate process and returns its objective. The settings are those of
    `experiments.runner.cluster.EngineSettings`, read from the configuration.
    """

    def __init__(self, **settings: Any) -> None:
        self._given: tuple[DictConfig, ConfigLoader] | None = None
        self._jobs: Any = ()

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Store the configuration of the sweep."""
        self._given = config, hydra_context.config_loader

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run jobs.

        Raises an `MvestError`, `HydraException` or `OmegaConfBaseException` if the request is
        wrong; then nothing is run.
        """
        # Its import takes seconds, which `--help` must not.
        from experiments.runner.sweep import launch

        assert self._given is not None
        returned, self._jobs = launch(*self._given, job_overrides, initial_job_idx, self._jobs)
        return returned


def register_plugins() -> None:
    """Register them with Hydra; may be called again."""
    plugins = Plugins.instance()  # imports the package of plugins, if any other is installed
    package, _, name = PLACE.rpartition(".")
    place = ModuleType(PLACE)
    sys.modules[PLACE] = place
    setattr(sys.modules.setdefault(package, ModuleType(package)), name, place)
    for plugin in (GridSweeper, JobLauncher):
        plugin.__module__ = PLACE
        place.__dict__[plugin.__name__] = plugin
        plugins.register(plugin)
