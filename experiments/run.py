"""The application behind ``mvest run experiment=NAME [overrides] [--multirun]``.

Exit status: 0 done; 1 a run, or a job of a sweep, found no estimate (it is recorded, with its
reason); 2 the request is wrong (one line says how) or nothing can be written; 130, 143 or 129
stopped by Ctrl-C, SIGTERM or SIGHUP (nothing is left half-written).
"""

import difflib
import math
import os
import sys
import traceback
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from experiments.common.config import hash_of, plain, register
from experiments.common.places import CONF
from experiments.common.progress import wrapped
from experiments.console import TRACEBACKS, interruptible
from experiments.runner.jobs import RESULT, FailedRunError, Request, nothing_empty
from experiments.runner.plugins import FailedSweepError, register_plugins
from mvest.errors import ConfigurationError, MvestError


@interruptible
def main() -> int:
    """Run the application on the command line's arguments; returns the exit status."""
    wants_tracebacks = TRACEBACKS in os.environ
    ended: list[Exception] = []

    def task(config: DictConfig) -> float:
        try:
            return run_alone(config)
        except (MvestError, FailedRunError) as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise
            # Raised below: Hydra would print further lines first.
            ended.append(error)
            return math.nan

    register()
    register_plugins()
    # Hydra then passes exceptions on, which become one line here.
    os.environ[TRACEBACKS] = "1"
    try:
        hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(task)()
        for error in ended:
            raise error
    except FailedSweepError:
        return 1
    except FailedRunError as error:
        print(f"no estimate: {error}", file=sys.stderr)
        return 1
    except Exception as error:
        *_, (frame, _) = traceback.walk_tb(error.__traceback__)
        within_hydra = str(frame.f_globals.get("__name__")).startswith("hydra.")
        is_theirs = isinstance(error, HydraException | OmegaConfBaseException)
        if wants_tracebacks or not (is_theirs or (within_hydra and not isinstance(error, OSError))):
            raise
        raise ConfigurationError(explain(error)) from error
    finally:
        if not wants_tracebacks:
            del os.environ[TRACEBACKS]
    return 0


def run_alone(config: DictConfig) -> float:
    """One single run: plan, check, or run and log it; returns its objective, or NaN.

    Raises an `MvestError` if a setting is inadmissible or a file cannot be written, and a
    `FailedRunError` if there is no estimate; the run is recorded all the same.
    """
    # Their import takes seconds, which `--help` must not.
    from experiments.results.published import publish_as, publish_runs
    from experiments.runner.job import check_of, require_admissible, run_job
    from experiments.runner.metrics import metrics
    from experiments.runner.plan import Plan, earlier
    from experiments.runner.tracking import log_run

    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    with nothing_empty(folder, Path(config.paths.outputs)):
        values, overrides = plain(config), tuple(hydra_config.overrides.task)
        published = publish_as(values, overrides, None)
        request = Request(values, hash_of(values), folder, published, overrides)
        require_admissible(values)
        if config.dry_run:
            plan = Plan(str(values["name"]), folder.parent, {}, (request,), earlier([request]))
            print(wrapped(f"{plan.summary()}\n{plan.listing()}"))
            return math.nan
        if config.check:
            print(wrapped(check_of(values)(values, folder)), flush=True)
            return math.nan
        record = run_job(request)
        results = Path(values["paths"]["results"])
        if values["publish"] and not values["sweep"] and not published:
            print(f"{results} left as it is: this run has overrides")
        publish_runs([(published, record, folder, results)])
        log_run(folder, values)
        if not record.converged:
            detail = f" ({record.detail})" if record.detail else ""
            raise FailedRunError(f"{record.reason}{detail} (recorded in {folder / RESULT})")
        return metrics(record).get(config.objective, math.nan)


def explain(error: BaseException) -> str:
    """One line about an error: what is wrong and, if known, what would be right."""
    own = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not isinstance(error, HydraException | OmegaConfBaseException):
        return f"{' '.join(sys.argv[1:])}: {own[0] if own else type(error).__name__}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: {own[0]}"
    causes: list[BaseException] = [error]
    while (cause := causes[-1].__cause__) is not None:
        causes.append(cause)
    lines = [line.strip() for e in reversed(causes) for line in str(e).splitlines() if line.strip()]
    text = lines[0] if lines else type(error).__name__
    unknown = [one for one in causes if isinstance(one, MissingConfigException)]
    if unknown and (known := list(unknown[0].options or ())):
        wrong = text.rpartition("/")[2].strip("'")
        close = difflib.get_close_matches(wrong, known, n=1, cutoff=0.7)
        hint = f"did you mean {close[0]}? " if close else ""
        missing = text.removeprefix("In 'config': ")
        return f"{missing}; {hint}known: {', '.join(known)}"
    # An error in one of our resolvers.
    if refused := text.partition("ConfigurationError raised while resolving interpolation: ")[2]:
        return refused
    if isinstance(causes[-1], OmegaConfBaseException):
        full_key = next((line for line in lines if line.startswith("full_key:")), None)
        if full_key is not None:
            text = f"{full_key.removeprefix('full_key:').strip()}: {text}"
        key, parent = (getattr(causes[-1], name, None) for name in ("key", "parent_node"))
        if key is not None and isinstance(parent, DictConfig) and key not in parent:
            close = difflib.get_close_matches(str(key), [str(name) for name in parent], n=1)
            return f"{text}; did you mean {close[0]}?" if close else text
        return text
    return ": ".join(own[:2]) or type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
