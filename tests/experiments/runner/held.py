"""``mvest`` and its worker, stopped at the stage that the file ``hold`` names.

There it writes a file ``at`` and waits.
"""

import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

from tests.experiments.runner import fake_worker

PROGRAM = "trap '' TERM HUP INT; sleep 300 & setsid sleep 300 & : > ../../../at; wait; wait"
"""An external program that ignores signals, with two child processes."""

HELD_FILE = "sweep_debug.png"
"""In the stage "drawing", it is complete but not renamed yet."""


def stage() -> str:
    place = Path("hold")
    return place.read_text() if place.exists() else ""


def hold() -> None:
    Path("at").touch()
    time.sleep(600)


def held_replace(path, target, replaced=Path.replace):
    if stage() == "drawing" and Path(target).name == HELD_FILE:
        hold()
    return replaced(path, target)


def run(job):
    if stage() == "simulating":
        from mvest.exchange.external.contract import Command

        with Command(("/bin/sh", "-c", PROGRAM)).started(job.folder) as ended:
            ended()
    return fake_worker.run(job)


def main() -> int:
    # Tests run in the background of a shell, or by nohup, inherit that these are ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    from experiments import cli

    if stage() == "logging":
        import mlflow

        mlflow.MlflowClient.set_terminated = lambda *_, **__: hold()
    from experiments.runner import engine

    engine.WORKER = (sys.executable, __file__, "worker")
    return cli.main(sys.argv[1:])


if __name__ == "__main__":
    Path.replace = held_replace
    if sys.argv[1:] == ["worker"]:
        room = fake_worker.room.__dict__
        room["STUDY"] = replace(room["STUDY"], run=run)
        fake_worker.worker.main()
    else:
        sys.exit(main())
