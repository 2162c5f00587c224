import re

import numpy as np
import pytest

from experiments.common import progress
from experiments.common.progress import PartBar, SolveBar
from tests.processes import until

BEAT = progress.Heartbeat._beat


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def lines(capsys) -> list[str]:
    return capsys.readouterr().err.splitlines()


def test_solves_and_steps_of_the_filter_are_reported(clock, capsys) -> None:
    with SolveBar("estimation", 2, ("E_f.anterior", "E_f.posterior")) as bar:

        def solve(seconds: float) -> None:
            for reached in (0.1, 0.2):
                clock[0] += seconds / 2
                bar.step(reached, 3)

        solve(60.0)
        assert lines(capsys) == [], "not before it is known to have ended"
        bar.iterate(0, np.array([5.0, 3.0]), 12.5)
        assert all(line.endswith("01:00 elapsed") for line in lines(capsys))
        solve(20.0)
        bar.iterate(1, np.array([6.0, 2.5]), 2.5)
        said = " ".join(" ".join(lines(capsys)).split())
        assert "step 1: objective 2.5, E_f.anterior 6, E_f.posterior 2.5" in said
        assert said.endswith("01:20 elapsed")


def test_a_first_stage_shows_the_moduli_alone(clock, capsys) -> None:
    names = ("E_f.anterior", "pressure_scale", "E_f.posterior")
    with SolveBar("case", 2, names) as bar:
        bar.iterate(0, np.array([5.0, 3.0]), 12.5)
    said = " ".join(lines(capsys))
    assert "E_f.anterior 5, E_f.posterior 3, 00:00 elapsed" in said


def test_silence_is_broken_by_what_goes_on(monkeypatch, capsys) -> None:
    monkeypatch.setattr(progress.Heartbeat, "_beat", BEAT)
    monkeypatch.setattr(progress, "SILENCE_S", 1.0)
    said: list[str] = []
    monkeypatch.setattr(progress, "say", said.append)
    with PartBar("prediction", 10, "closure") as bar:
        bar.step()
        until(lambda: said, 10.0)
    assert re.fullmatch(
        r"prediction: 1 of 10 closures, 00:0\d elapsed, about 00:[0-4]\d left", said[0]
    )
    assert said[-1].startswith("prediction: done in ")


@pytest.mark.parametrize("workers", [1, 8])
def test_the_time_left_is_right_within_a_factor_of_two_from_the_third_job_on(clock, workers):
    # Jobs of 60 s to 180 s in a fixed disorder; each worker takes the next one as it is free.
    seconds = [60.0 + 120.0 * ((k * 37) % 64) / 63 for k in range(64)]
    free, ends = [0.0] * workers, []
    for spent in seconds:
        began = free.pop(free.index(min(free)))
        free.append(began + spent)
        ends.append(began + spent)
    with PartBar("trial", len(ends), "job") as bar:
        for count, now in enumerate(sorted(ends), 1):
            clock[0] = now
            bar.step()
            if 3 <= count <= len(ends) - workers:
                clocked = re.search(r"about ([\d:]+) left", bar._status())[1].split(":")
                left = sum(float(part) * 60**k for k, part in enumerate(reversed(clocked)))
                assert 0.5 < left / (max(free) - now) < 2.0
