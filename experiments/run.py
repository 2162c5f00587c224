"""The one application: ``python -m experiments.run experiment=NAME [overrides] [--multirun]``.

Exit status: 0 done; 1 a run found no estimate (it is recorded, with its reason); 2 the request is
wrong (one line says how); 130 interrupted (nothing is left half-written).
"""

from __future__ import annotations

import difflib
import os
import re
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from experiments.job import RunFailed, run_job
from mvest.errors import MvestError

__all__ = ["main"]

CONF = Path(__file__).resolve().parent.parent / "conf"
"""The folder of the configuration."""

TRACEBACKS = "HYDRA_FULL_ERROR"
"""Environment variable with which a user asks for tracebacks."""


def main() -> int:
    """Run the application on the command line's arguments; returns the exit status."""
    wants_tracebacks = TRACEBACKS in os.environ
    # Hydra then lets exceptions through, so that they can be told in one line here.
    os.environ[TRACEBACKS] = "1"
    ended: list[Exception] = []

    def task(config: DictConfig) -> None:
        try:
            run_job(config)
        except (MvestError, RunFailed) as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise
            ended.append(error)

    try:
        hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(task)()
        for error in ended:
            raise error
    except KeyboardInterrupt:
        print("interrupted: nothing of this run was kept", file=sys.stderr)
        return 130
    except RunFailed as error:
        print(f"no estimate: {error}", file=sys.stderr)
        return 1
    except (MvestError, HydraException, OmegaConfBaseException, OSError) as error:
        if wants_tracebacks:
            raise
        print(f"error: {explain(error)}", file=sys.stderr)
        return 2
    return 0


def explain(error: BaseException) -> str:
    """One line that says what is wrong and, where it can be told, what would be right."""
    if isinstance(error, OSError):
        place = f" {error.filename}" if error.filename else ""
        return f"cannot write{place}: {error.strerror or error}"
    causes = [error]
    while (cause := causes[-1].__cause__) is not None:
        causes.append(cause)
    lines = [line.strip() for e in reversed(causes) for line in str(e).splitlines() if line.strip()]
    text = lines[0] if lines else type(error).__name__
    full_key = next((line for line in lines if line.startswith("full_key:")), None)
    if isinstance(causes[-1], OmegaConfBaseException):
        if full_key is not None:
            text = f"{full_key.removeprefix('full_key:').strip()}: {text}"
        text += _nearest(causes[-1])
    elif "available" in " ".join(lines).lower():
        text = re.sub(r"\s+", " ", " ".join(lines[: lines.index(text) + 8]))
    return text


def _nearest(error: BaseException) -> str:
    """The setting that a misspelt one was probably meant to be."""
    key, parent = getattr(error, "key", None), getattr(error, "parent_node", None)
    if key is None or not isinstance(parent, DictConfig) or key in parent:
        return ""
    close = difflib.get_close_matches(str(key), [str(name) for name in parent], n=1)
    return f"; did you mean {close[0]}?" if close else ""


if __name__ == "__main__":
    sys.exit(main())
