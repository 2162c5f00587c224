"""What the figures of a sweep show."""

import pytest

from experiments.sweeps.figures import figures_of
from tests.experiments.sweeps.made_up_sweeps import TRUTH, failed_run, job, run, sweep


def axes_of(figure, label: str):
    (found,) = [axes for axes in figure.axes if axes.get_xlabel() == label]
    return found


def dots(axes) -> list[tuple[float, float]]:
    return [
        (float(line.get_xdata()[0]), float(line.get_ydata()[0]))
        for line in axes.lines
        if line.get_marker() == "o" and line.get_linestyle() == "None"
    ]


def test_a_panel_for_each_factor_with_medians_intervals_and_failures():
    def runs(errors):
        return [run(k, TRUTH * (1 + e / 100), [0.1, 0.1]) for k, e in enumerate(errors)]

    jobs = [
        job({"kind": "a", "R": 0.01}, runs([1.0, 2.0, 6.0])),
        job({"kind": "b", "R": 1.0}, [*runs([-1.0, -1.0, -1.0]), failed_run(3, "no")], seed=0),
    ]
    figure = figures_of(sweep("x", jobs))[""]
    kind, r = axes_of(figure, "kind"), axes_of(figure, "R [mm²]")
    assert [text.get_text() for text in kind.get_xticklabels()] == ["a", "b"]
    # Both moduli at both values; the second one's run failed.
    assert [y for _, y in dots(kind)] == pytest.approx([2.0, 2.0, -1.0, -1.0])
    assert sum(line.get_marker() == "x" for line in kind.lines) == 1
    # Half widths of 1.96 x 0.1 in percent of 6.23 and 2.09.
    assert [bar.get_height() / 2 for bar in kind.patches[:2]] == pytest.approx(
        [100 * 0.196 / 6.23, 100 * 0.196 / 2.09], rel=1e-3
    )
    # Two decades apart: the axis is logarithmic.
    assert list(r.get_xticks()) == [-2.0, 0.0]
    assert [text.get_text() for text in r.get_xticklabels()] == ["0.01", "1"]


def test_the_matrix_shows_the_worst_parameters_root_mean_square():
    runs = [run(k, TRUTH * [1 + e / 100, 1.0], [0.1, 0.1]) for k, e in enumerate((1.0, -7.0))]
    jobs = [job({"a": a, "b": b}, runs) for a in (1, 2) for b in (1, 2)]
    # Root of (1 + 49) / 2 = 5.
    assert {t.get_text() for t in figures_of(sweep("x", jobs))["matrix"].axes[0].texts} == {"5"}
