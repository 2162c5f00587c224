"""Dask clusters for the jobs of a sweep: a running one, or one that is made for it.

Dask places jobs, waits, adds and removes workers, and runs the job of a lost worker again on
another one. Processes and limits of a job are not dask's business: `engine.execute` manages them.
"""

from __future__ import annotations

import logging
import os
import shlex
import signal
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from uuid import uuid4

from experiments.common.records.record import Record
from experiments.console import ASKING
from experiments.runner.jobs import Request, write_failure
from mvest.errors import ConfigurationError
from mvest.files import require_writable
from mvest.processes import environment, python
from mvest.quantities import within
from mvest.reading.text import one_line

if TYPE_CHECKING:
    from distributed import Client

Execute = Callable[[Request, int | None, int], Record]

# Dask's cluster of this machine, and where it listens.
LOCAL, LOOPBACK = "LocalCluster", "127.0.0.1"
# Seconds for a scheduler to answer, and for the first worker on this machine to start.
CONNECT_S, START_S = 15, 60

DASK = {
    # Jobs take minutes: none is queued at a busy worker.
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.comm.timeouts.connect": "60s",
    # The job's own process limits its memory.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
}
"""Settings of dask for jobs in separate processes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineSettings:
    """Where the jobs of a sweep run; ``conf/hydra/launcher/jobs.yaml`` explains each setting."""

    n_jobs: Annotated[int, within(-1024, 1024, "", "jobs; -1: one for each core")] = -1
    address: str | None = None
    cluster: str | None = None
    options: dict[str, Any] | None = None
    jobs: Annotated[int, within(1, 100_000, "", "workers")] = 1
    adapt: bool = False

    @property
    def at_a_time(self) -> int:
        """Jobs that run at a time, if known."""
        if self.elsewhere:
            return self.jobs
        return max(1, self.n_jobs if self.n_jobs > 0 else (os.cpu_count() or 1) + 1 + self.n_jobs)

    @property
    def elsewhere(self) -> bool:
        """Whether dask runs the jobs."""
        return bool(self.address or self.cluster)


def run_on_dask(
    execute: Execute,
    stop: Callable[[], None],
    requests: Sequence[Request],
    settings: EngineSettings,
    requested_ns: int | None,
) -> Generator[tuple[int, Record]]:
    """Run jobs as `engine.run_jobs` does, by ``execute`` on the workers of a cluster.

    An interrupt calls ``stop`` on each worker of a cluster that was made for the sweep.
    """
    import dask
    from distributed import as_completed

    for name in list(logging.root.manager.loggerDict):
        if name.startswith(("distributed", "asyncio", "tornado")):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    own = requests[0].folder.resolve().parent / "dask"
    with dask.config.set(DASK), _client(settings, own, stop) as client:
        # Jobs of one call with keys of one group are queued at the scheduler, not at workers,
        # which may be lost. Other sweeps at the same scheduler have other keys.
        group = f"job-{uuid4().hex}"
        futures = client.map(
            _there,
            requests,
            execute=execute,
            directory=str(Path.cwd()),
            requested_ns=requested_ns,
            at_a_time=settings.jobs if settings.cluster == LOCAL else 1,
            key=[(group, k) for k in range(len(requests))],
            pure=False,
        )
        places = {future.key: k for k, future in enumerate(futures)}
        for future, record in as_completed(futures, with_results=True, raise_errors=False):
            k = places[future.key]
            if future.status in ("cancelled", "lost"):
                raise OSError("dask's scheduler is gone")
            if future.status == "error":
                # Its workers were lost again and again.
                error = future.exception()
                reason = f"dask gave the job up: {type(error).__name__}: {error}"
                require_writable(requests[k].folder)
                record = write_failure(requests[k], reason, time.time())
            future.release()
            yield k, record


def _there(
    request: Request, *, execute: Execute, directory: str, requested_ns: int | None, at_a_time: int
) -> Record:
    """Run a job in a worker of dask, in the folder that its relative paths start from."""
    os.chdir(directory)
    return execute(request, requested_ns, at_a_time)


@contextmanager
def _client(settings: EngineSettings, folder: Path, stop: Callable[[], None]) -> Iterator[Client]:
    """A client of the named scheduler, or of a new cluster that ends with the client.

    The cluster's logs and certificates are in ``folder``. Raises a `ConfigurationError` if there
    is no such cluster.
    """
    from distributed import Client

    with ExitStack() as stack:
        try:
            where: Any = settings.address
            if settings.cluster is not None:
                where = _cluster(settings.cluster, settings.options or {}, folder)
                stack.callback(_close, where)
                where.scale(1 if settings.adapt else settings.jobs)
                where.sync(where._correct_state)
                for worker in where.workers.values():
                    if worker.status.name == "created":
                        # It could not be submitted; a second attempt raises the reason.
                        where.sync(worker.start)
                if settings.adapt:
                    where.adapt(minimum=0, maximum=settings.jobs)
            client = stack.enter_context(Client(where, timeout=CONNECT_S))
            if settings.cluster == LOCAL:
                # With wrong options it would start workers forever.
                client.wait_for_workers(1, START_S)
        except (OSError, RuntimeError, ValueError, TypeError, KeyError, ImportError) as error:
            name, why = settings.cluster or settings.address, one_line(error, 300)
            raise ConfigurationError(f"hydra.launcher: no cluster {name}: {why}") from error
        try:
            yield client
        except BaseException:
            if settings.cluster is not None:
                client.run(stop)  # its workers would wait for their jobs
            raise


def _close(cluster: Any) -> None:
    with suppress(AssertionError):  # because of workers that were never submitted
        cluster.close()
    cluster.shutdown_on_close = False


def require_engine(settings: EngineSettings) -> None:
    """Raise a `ConfigurationError` for an unknown cluster, or if dask is not installed."""
    if settings.n_jobs == 0:
        raise ConfigurationError("hydra.launcher.n_jobs = 0, expected 1 or more; -1: one each core")
    if settings.address and settings.cluster:
        raise ConfigurationError("hydra.launcher: address and cluster, expected one of them")
    if settings.elsewhere:
        try:
            import distributed  # noqa: F401

            kinds = _kinds() if settings.cluster not in (None, LOCAL) else {}
        except ImportError as error:
            raise ConfigurationError(
                f"hydra.launcher: a cluster needs dask ({error}): pip install 'mvest[cluster]'"
            ) from error
        if kinds and settings.cluster not in kinds:
            raise ConfigurationError(
                f"hydra.launcher.cluster = {settings.cluster}, expected {LOCAL}, "
                f"{', '.join(sorted(kinds))}"
            )


def _kinds() -> dict[str, Any]:
    """Name -> class of each cluster that dask_jobqueue knows."""
    before = {number: signal.getsignal(number) for number in ASKING}
    import dask_jobqueue

    # Its import installs handlers that end the process with status 0.
    for number, handler in before.items():
        signal.signal(number, handler)
    return {name: kind for name, kind in vars(dask_jobqueue).items() if name.endswith("Cluster")}


def _cluster(name: str, options: Mapping[str, Any], folder: Path) -> Any:
    """A cluster with encrypted connections, or with local ones."""
    if name == LOCAL:
        from distributed import LocalCluster

        own = {
            "n_workers": 0,
            "threads_per_worker": 1,
            "host": LOOPBACK,
            "dashboard_address": f"{LOOPBACK}:0",
            "worker_dashboard_address": f"{LOOPBACK}:0",
            "memory_limit": None,
            "silence_logs": logging.CRITICAL,
        }
        return LocalCluster(**{**own, **options})
    own = {
        "cores": 1,
        "processes": 1,
        "memory": "4GB",
        "python": shlex.join(python("distributed")[:2]),
        "nanny": False,
        # Certificates for this cluster only, in a folder that its nodes share.
        "security": True,
        "shared_temp_directory": str(folder),
        "log_directory": str(folder),
        "protocol": "tls://",
        "scheduler_options": {"dashboard_address": f"{LOOPBACK}:0"},
        "worker_extra_args": ["--no-dashboard", "--dashboard-address", f"{LOOPBACK}:0"],
    }
    folder.mkdir(mode=0o700, exist_ok=True)
    prologue = [f"export PYTHONPATH={shlex.quote(environment()['PYTHONPATH'])}"]
    prologue += options.get("job_script_prologue", ())
    return _kinds()[name](**{**own, **options, "job_script_prologue": prologue})
