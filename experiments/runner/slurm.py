"""The launcher of ``launcher=slurm``: one Slurm array through submitit, whatever its jobs' fate.

Submitit's own launcher for Hydra raises at the first job that dies, with the others still running,
and asks Slurm ever less often, down to every ten minutes. This one waits for all of them, and a job
that died comes back as failed, with Slurm's word for why.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from mvest.errors import ConfigurationError, MvestError

__all__ = ["JobDiedError", "SlurmLauncher"]

WORDS = {
    "OUT_OF_MEMORY": "it ran out of memory (hydra.launcher.mem_gb)",
    "TIMEOUT": "it ran out of time (hydra.launcher.timeout_min)",
    "CANCELLED": "it was cancelled",
    "NODE_FAIL": "its node failed",
    "PREEMPTED": "it was preempted",
    "FAILED": "its process died",
}
"""Slurm's states of a job that did not complete, in words."""

SHARED = (
    "timeout_min", "cpus_per_task", "gpus_per_node", "mem_gb", "nodes", "name", "tasks_per_node",
    "stderr_to_stdout",
)  # fmt: skip
"""Settings that submitit names alike for every kind of cluster."""


class JobDiedError(MvestError):
    """A job ended without a result of any kind."""


class SlurmLauncher(Launcher):
    """Submits the jobs of a sweep as one array and waits until each of them has ended.

    Parameters
    ----------
    poll_s : float
        Longest time (s) between two questions to Slurm's accounting.
    **settings
        As for the launcher of hydra-submitit-launcher.
    """

    def __init__(self, poll_s: float = 20.0, **settings: Any) -> None:
        self._poll_s = poll_s
        self._settings = {
            key: OmegaConf.to_container(value, resolve=True)
            if OmegaConf.is_config(value)
            else value
            for key, value in settings.items()
        }
        self._parts: dict[str, Any] = {}

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Keep what Hydra has to say about the sweep."""
        self._parts = {
            "hydra_context": hydra_context,
            "task_function": task_function,
            "config": config,
        }

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Submit, wait, and return how every job ended, in order.

        Raises
        ------
        ConfigurationError
            If submitit or Slurm is not there, or Slurm refuses the array.
        """
        try:
            import submitit
            from hydra_plugins.hydra_submitit_launcher.submitit_launcher import (
                SlurmLauncher as Submitted,
            )
            from submitit.core.utils import FailedJobError
            from submitit.slurm.slurm import SlurmJob
        except ImportError as error:
            raise ConfigurationError(
                "launcher=slurm needs the extra cluster: pip install -e .[cluster]"
            ) from error
        Path(str(self._parts["config"].hydra.sweep.dir)).mkdir(parents=True, exist_ok=True)
        # What is sent to the jobs is the plain launcher, which they can import.
        call = Submitted(**self._settings)
        call.setup(**self._parts)
        state = Singleton.get_state()
        calls = [
            (list(overrides), "hydra.sweep.dir", number, f"job_id_for_{number}", state)
            for number, overrides in enumerate(job_overrides, start=initial_job_idx)
        ]
        try:
            executor = submitit.AutoExecutor(
                folder=self._settings["submitit_folder"], cluster="slurm"
            )
            executor.update_parameters(**_for_executor(self._settings))
            jobs = executor.map_array(call, *zip(*calls, strict=True))
        except (RuntimeError, FailedJobError) as error:
            # Submitit repeats sbatch's own message at the end.
            text = str(error).strip().splitlines()
            raise ConfigurationError(
                f"Slurm takes no jobs: {text[-1] if text else error}"
            ) from error
        SlurmJob.watcher._delay_s = self._poll_s
        array = str(jobs[0].job_id).split("_")[0]
        print(f"Slurm array {array}: {len(jobs)} jobs; `scancel {array}` ends it", file=sys.stderr)
        try:
            lost = _wait(jobs, array, self._poll_s)
        except KeyboardInterrupt:
            subprocess.run(["scancel", array], check=False)
            raise
        return [
            _ended(job, overrides, job in lost)
            for job, overrides in zip(jobs, job_overrides, strict=True)
        ]


def _for_executor(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings by the names that submitit's executor gives them."""
    return {
        key if key in SHARED else f"slurm_{key}": value
        for key, value in settings.items()
        if key != "submitit_folder" and value is not None
    }


def _wait(jobs: Sequence[Any], array: str, poll_s: float) -> set[Any]:
    """Wait until every job has ended; returns those of which Slurm no longer knows anything.

    A job that is cancelled before it starts may never appear in Slurm's accounting, where submitit
    would look for it for ever. It is lost when the queue does not have it either, twice in a row.
    """
    waiting = list(jobs)
    missed: set[Any] = set()
    lost: set[Any] = set()
    asked = time.monotonic()
    while waiting:
        waiting = [job for job in waiting if not job.done()]
        if waiting and time.monotonic() - asked > poll_s:
            asked = time.monotonic()
            queued = _queued(array)
            if queued is not None:
                gone = {job for job in waiting if str(job.job_id) not in queued}
                lost |= gone & missed
                waiting = [job for job in waiting if job not in lost]
                missed = gone
        time.sleep(min(1.0, poll_s))
    return lost


def _queued(array: str) -> set[str] | None:
    """Ids of the array's jobs that wait or run; None if the queue could not be asked."""
    asked = subprocess.run(
        ["squeue", "--noheader", "--array", "--jobs", array, "--format", "%i"],
        capture_output=True,
        text=True,
        check=False,
    )
    if asked.returncode == 0:
        return set(asked.stdout.split())
    # Of an array that ended some minutes ago the queue knows nothing.
    return set() if "Invalid job id" in asked.stderr else None


def _ended(job: Any, overrides: Sequence[str], lost: bool) -> JobReturn:
    """How a job ended."""
    from submitit.core.utils import FailedJobError, UncompletedJobError

    began = job.paths.stdout.exists()
    words = "it died, of what Slurm's accounting does not say"
    if lost and not began:
        words = "it was cancelled before it began"
    elif not lost:
        try:
            returned: JobReturn = job.results()[0]
            return returned
        except (FailedJobError, UncompletedJobError, OSError, EOFError):
            state = str(job.state).split(" ")[0].upper()
            words = WORDS.get(state, f"Slurm's state is {state}")
    reason = f"Slurm job {job.job_id}: {words}"
    if began:
        reason += f"; its output is in {job.paths.stdout}"
    return JobReturn(
        overrides=list(overrides), status=JobStatus.FAILED, _return_value=JobDiedError(reason)
    )
