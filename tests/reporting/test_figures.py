import pytest
from matplotlib.figure import Figure

from mvest.reporting.figures import iterates_figure, save_figure_with
from tests.experiments.studies.made_up import made_up_estimate

LINE = "table1: mvest 0.1.0, commit 0123456789ab, configuration cdcdcdcdcdcd, seed 1"


def drawn() -> Figure:
    """The iterates of one estimate."""
    figure = iterates_figure([made_up_estimate()])
    assert figure is not None
    return figure


def test_iterates_band_and_truth_are_drawn() -> None:
    for axes, start, end, std, truth in zip(
        drawn().axes, (5.0, 3.0), (6.2296, 2.0901), (0.02, 0.005), (6.23, 2.09), strict=True
    ):
        lines = {line.get_label(): line.get_ydata() for line in axes.lines}
        assert list(lines["estimate"]) == [start, end]
        assert lines["truth"][0] == truth
        (band,) = (each.get_paths()[0].vertices for each in axes.collections)
        # Two standard deviations: 2.0 at first.
        at_start, at_end = (band[band[:, 0] == k, 1] for k in (0, 1))
        assert (at_start.min(), at_start.max()) == pytest.approx((start - 4.0, start + 4.0))
        assert (at_end.min(), at_end.max()) == pytest.approx((end - 2 * std, end + 2 * std))


def test_files_are_reproducible_and_say_where_they_come_from(tmp_path) -> None:
    names = [save_figure_with(tmp_path / base, drawn(), LINE, pdf=True) for base in ("a", "b")]
    for first, second in zip(*names, strict=True):
        assert first.read_bytes() == second.read_bytes()
    assert [path.suffix for path in names[0]] == [".png", ".pdf"]
    assert b"configuration cdcdcdcdcdcd" in names[0][0].read_bytes()
    assert not list(tmp_path.glob(".*"))
