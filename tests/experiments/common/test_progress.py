import io

import numpy as np
import pytest

from experiments.common import progress
from experiments.common.progress import PartBar, SolveBar


@pytest.fixture
def bar(monkeypatch):
    """A bar that counts although no terminal is looking."""

    def visible(**settings):
        return tqdm(**{**settings, "disable": False, "file": io.StringIO()})

    tqdm = progress.tqdm
    visible.write, visible.format_interval = tqdm.write, tqdm.format_interval
    monkeypatch.setattr(progress, "tqdm", visible)
    with SolveBar("estimation", 3, 2) as found:
        yield found


def test_the_bar_counts_the_steps_of_each_solve_anew(bar) -> None:
    # The second solve stops early.
    for time in (0.1, 0.2, 0.3, 0.1, 0.1, 0.2):
        bar.step(time, 1)
    assert (bar._bar.n, bar._bar.total) == (2, 3)
    assert "forward solve 3" in bar._bar.desc


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def lines(capsys) -> list[str]:
    return capsys.readouterr().err.splitlines()


def test_each_solve_and_each_step_of_the_filter_is_told(clock, capsys) -> None:
    with SolveBar("estimation", 2, 4, ("E_f.anterior", "E_f.posterior")) as bar:

        def solve() -> None:
            for reached in (0.1, 0.2):
                clock[0] += 10.0
                bar.step(reached, 3)

        solve()
        assert lines(capsys) == [], "not before it is known to have ended"
        bar.iterate(0, np.array([5.0, 3.0]), 12.5)
        assert lines(capsys) == [
            "estimation, forward solve 1: 2 time steps in 20.0 s; 00:20 elapsed, about 01:00 left "
            "if 4 solves do",
            "estimation, step 0 of the filter: objective 12.5; E_f.anterior 5, E_f.posterior 3; "
            "00:20 elapsed, about 01:00 left if 4 solves do",
        ]
        solve()
        bar.iterate(1, np.array([6.0, 2.5]), 2.5)
        assert lines(capsys)[-1] == (
            "estimation, step 1 of the filter: objective 2.5 (-10); E_f.anterior 6 (+1), "
            "E_f.posterior 2.5 (-0.5); 00:40 elapsed, about 00:40 left if 4 solves do"
        )
        # Another estimate begins anew, and more solves than expected are told one by one.
        for time in (0.1, 0.2) * 3:
            bar.step(time, 1)
        bar.iterate(0, np.array([5.0, 3.0]), 12.5)
        assert "objective 12.5; E_f.anterior 5," in (told := lines(capsys)[-1])
        assert told.endswith("about 00:08 for each further solve")


def test_solves_that_take_no_time_are_left_to_the_bar(clock, capsys) -> None:
    with SolveBar("estimation", 2, 4) as bar:
        for time in (0.1, 0.2) * 3:
            clock[0] += 0.01
            bar.step(time, 1)
    assert lines(capsys) == []


def test_compiling_is_announced_with_what_follows(clock, capsys, monkeypatch) -> None:
    monkeypatch.setattr(progress, "kernels_are_compiled", lambda: False)
    progress.announce_compilation.cache_clear()
    with SolveBar("observation", 2, 1):
        (said,) = lines(capsys)
        assert said.startswith("compiling on first use")
        assert said.endswith("then the observation goes on")
    progress.announce_compilation.cache_clear()


def test_pieces_are_told_now_and_then_where_no_terminal_is_there(clock, capsys) -> None:
    with PartBar("prediction", 10, "closure") as bar:
        for _ in range(4):
            clock[0] += 20.0
            bar.step()
    assert lines(capsys) == [
        "prediction: 2 of 10 closures, 00:40 elapsed, about 02:40 left",
        "prediction: 4 of 10 closures, 01:20 elapsed, about 02:00 left",
        "prediction: done in 01:20",
    ]


@pytest.mark.parametrize("workers", [1, 2, 8])
def test_the_time_left_is_right_within_a_factor_of_two_from_the_third_job_on(workers):
    # Jobs of 60 s to 180 s in a fixed disorder; each worker takes the next one as it is free.
    seconds = [60.0 + 120.0 * ((k * 37) % 64) / 63 for k in range(64)]
    free, ends = [0.0] * workers, []
    for spent in seconds:
        began = free.pop(free.index(min(free)))
        free.append(began + spent)
        ends.append((began + spent, spent))
    last = max(free)
    with PartBar("trial", len(ends), "job", workers) as bar:
        for count, (now, spent) in enumerate(sorted(ends), 1):
            bar.step(seconds=spent)
            if 3 <= count <= len(ends) - workers:
                assert 0.5 < bar.left() / (last - now) < 2.0


def test_an_estimation_of_the_moduli_alone_names_them(capsys):
    names = ("E_f.anterior", "pressure_scale", "E_f.posterior")
    with SolveBar("case", 3, 2, names) as bar:
        bar.iterate(0, np.array([5.0, 3.0]), 12.5)
    assert "E_f.anterior 5, E_f.posterior 3" in capsys.readouterr().err
