import io

import pytest

from experiments.common import progress
from experiments.common.progress import SolveBar


@pytest.fixture
def bar(monkeypatch):
    """A bar that counts although no terminal is looking."""

    def visible(**settings):
        return tqdm(**{**settings, "disable": False, "file": io.StringIO()})

    tqdm = progress.tqdm
    monkeypatch.setattr(progress, "tqdm", visible)
    with SolveBar("estimation", 3, 2) as found:
        yield found


def count(bar: SolveBar) -> tuple[int, int]:
    return bar._bar.n, bar._bar.total


def test_steps_of_solves_are_counted(bar) -> None:
    for time in (0.1, 0.2, 0.3, 0.1):
        bar.step(time, 1)
    assert count(bar) == (4, 6)
    assert "forward solve 2" in bar._bar.desc


def test_a_solve_that_stopped_early_is_made_up_for(bar) -> None:
    for time in (0.1, 0.1, 0.2):
        bar.step(time, 1)
    assert count(bar) == (5, 6)


def test_the_bar_grows_with_solves_beyond_the_expected(bar) -> None:
    for _ in range(3):
        for time in (0.1, 0.2, 0.3):
            bar.step(time, 1)
    assert count(bar) == (9, 9)
