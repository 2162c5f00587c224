import numpy as np
import pytest
from matplotlib.patches import Rectangle

from experiments.sweeps.noise_figures import calibration_figure, noise_figure
from experiments.sweeps.report import PICTURES, pictures_of
from experiments.sweeps.setting_figures import (
    cost_figure,
    covariance_figure,
    discrepancy_figure,
    filter_figure,
)
from experiments.sweeps.start_figures import basin_figure, paths_figure
from mvest.reporting.style import label_ends, panels, plain_number
from tests.experiments.sweeps.synthetic_sweeps import (
    ALL,
    TRUTH,
    all_failed,
    correlated_noise,
    covariance,
    covariance_values,
    discrepancy,
    empty,
    failed_run,
    filter_conditions,
    filters,
    initial_guess,
    job,
    noise,
    run,
    sweep,
)


def texts(axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def test_basin_map_has_a_cell_per_start_and_marks_failures() -> None:
    figure = basin_figure(initial_guess())
    iterated, paper = figure.axes[:2]
    assert iterated.get_title() == "iterated: 35 of 36 starts\nwithin 0.1 %"
    assert paper.get_title() == "paper: 22 of 36 starts\nwithin 0.1 %"
    for axes, failures in ((iterated, 1), (paper, 4)):
        cells = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
        assert len(cells) == 36
        assert sum(cell.get_hatch() is not None for cell in cells) == failures
        assert sum(line.get_marker() == "x" for line in axes.lines) == failures
        (star,) = [line for line in axes.lines if line.get_marker() == "*"]
        assert [*star.get_xdata(), *star.get_ydata()] == [6.23, 2.09]
        assert axes.get_xscale() == "log"


def test_the_outline_runs_between_inside_and_outside() -> None:
    jobs = []
    for a in (1.0, 2.0, 3.0):
        for b in (1.0, 2.0, 3.0):
            error = 0.0 if (a, b) == (2.0, 2.0) else 1.0
            factors = {"start_anterior": a, "start_posterior": b, "filter": "paper"}
            jobs.append(job(factors, [run(1, TRUTH * (1 + error / 100), [0.1, 0.1])]))
    axes = basin_figure(sweep("initial_guess", jobs)).axes[0]
    outline = {
        (*line.get_xdata(), *line.get_ydata()) for line in axes.lines if line.get_linewidth() == 3
    }
    # The one cell in the basin reaches from 1.5 to 2.5 in both directions.
    assert outline == {
        (1.5, 1.5, 1.5, 2.5), (2.5, 2.5, 1.5, 2.5), (1.5, 2.5, 1.5, 1.5), (1.5, 2.5, 2.5, 2.5)
    }  # fmt: skip
    assert axes.get_xscale() == "linear"


def test_of_several_runs_from_one_guess_the_worst_is_shown() -> None:
    factors = {"start_anterior": 1.0, "start_posterior": 1.0, "filter": "paper"}
    runs = [run(1, TRUTH, [0.1, 0.1]), failed_run(2, "no"), run(3, TRUTH, [0.1, 0.1])]
    axes = basin_figure(sweep("initial_guess", [job(factors, runs)])).axes[0]
    assert [patch.get_hatch() for patch in axes.patches] == ["////"]


def test_guesses_off_a_grid_are_single_marks() -> None:
    jobs = [
        job({"start_anterior": a, "start_posterior": b}, [run(1, TRUTH, [0.1, 0.1])])
        for a, b in ((1.0, 3.0), (2.1, 1.0), (3.3, 2.2), (4.0, 0.7))
    ]
    axes = basin_figure(sweep("initial_guess", jobs)).axes[0]
    assert not axes.patches
    assert sum(line.get_marker() == "s" for line in axes.lines) == 4


def test_a_map_needs_two_starts() -> None:
    jobs = [job({"start_anterior": 1.0}, [run(1, TRUTH, [0.1, 0.1])])]
    assert basin_figure(sweep("initial_guess", jobs)) is None


def test_paths_are_all_drawn_with_the_truth() -> None:
    figure = paths_figure(initial_guess())
    titles = [axes.get_title() for axes in figure.axes[:4]]
    assert titles == ["iterated", "paper", "", ""]
    for k, axes in enumerate(figure.axes[:4]):
        lines = [line for line in axes.lines if line.get_linestyle() == "-" and
                 len(line.get_xdata()) > 1]  # fmt: skip
        # Of 36 starts one and four left no iterates behind.
        assert len(lines) == (35, 32)[k % 2]
        (truth,) = [line for line in axes.lines if line.get_linestyle() == "--"]
        assert truth.get_ydata()[0] == TRUTH[k // 2]


def test_noise_curve_is_the_root_mean_square_beside_the_bound() -> None:
    errors = [0.1, -0.1, 0.3, -0.3]
    runs = [
        run(s, np.add(TRUTH, [e, 0.0]), [0.1, 0.1], bound=[0.2, 0.1]) for s, e in enumerate(errors)
    ]
    jobs = [job({"kind": "white", "noise_mm": level}, runs) for level in (0.5, 1.0)]
    jobs.append(job({"kind": "white", "noise_mm": 1.5}, [], "killed"))
    axes = noise_figure(sweep("noise", jobs)).axes[0]
    curves = {line.get_label(): line for line in axes.lines if len(line.get_xdata()) == 2}
    # Root of (2 x 0.01 + 2 x 0.09) / 4 = 0.05, in percent of 6.23.
    assert curves["RMS"].get_ydata() == pytest.approx([100 * np.sqrt(0.05) / 6.23] * 2)
    assert curves["bound"].get_ydata() == pytest.approx([100 * 0.2 / 6.23] * 2)
    assert curves["RMS"].get_xdata() == pytest.approx([0.5, 1.0])
    dots = [line for line in axes.lines if line.get_marker() == "." and len(line.get_xdata())]
    assert sorted(dots[0].get_ydata()) == pytest.approx(100 * np.array([0.1, 0.1, 0.3, 0.3]) / 6.23)
    (lost,) = [line for line in axes.lines if line.get_marker() == "x"]
    assert lost.get_xdata()[0] == 1.5
    assert axes.get_title() == "white\n(1 of 9 failed)"


def test_calibration_leaves_out_what_has_no_noise() -> None:
    figure = calibration_figure(noise(6))
    assert [axes.get_title() for axes in figure.axes[:4]] == [
        "white", "correlated", "dropout", "annulus"
    ]  # fmt: skip
    # Four levels of noise, of which dropout lost one as a whole.
    assert [len(axes.containers) for axes in figure.axes] == [4, 4, 3, 4] * 2
    assert {"0.1 mm", "0.5 mm", "1 mm", "1.5 mm"} == set(texts(figure.axes[3]))
    quiet = sweep("noise", [job({"kind": "white", "noise_mm": 0.0}, [run(1, TRUTH, [1, 1])])])
    assert calibration_figure(quiet) is None


def test_covariance_panels_show_error_and_reported_deviation() -> None:
    figure = covariance_figure(covariance())
    assert [axes.get_title() for axes in figure.axes[:4]] == ["P0", "Q", "R", "all three"]
    deviation, error = (line.get_ydata() for line in figure.axes[2].lines)
    # R times 100 makes the reported standard deviation ten times larger.
    assert deviation[-1] / deviation[2] == pytest.approx(10)
    at_scale_one = covariance().jobs[12].runs[0].relative_error
    assert error[2] == pytest.approx(100 * max(abs(e) for e in at_scale_one))
    assert [line.get_marker() for line in figure.axes[6].lines].count("x") == 1


def test_values_of_a_covariance_share_a_panel_zero_included() -> None:
    figure = covariance_figure(covariance_values())
    assert [axes.get_title() for axes in figure.axes[:3]] == ["P0", "Q", "R"]
    labels = [label.get_text() for label in figure.axes[1].get_xticklabels()]
    assert labels == ["0", "1e-4", "0.01", "1"]
    # Four values of P0 and two of R, of which Q = 1 is lost at the smallest P0.
    curves = [line for line in figure.axes[1].lines if line.get_marker() == "o"]
    assert sorted(len(line.get_xdata()) for line in curves) == [3, 3, 4, 4, 4, 4, 4, 4]
    assert texts(figure.axes[4]) == ["not varied"]


def test_kinds_of_a_single_level_stand_side_by_side() -> None:
    white, others = noise_figure(correlated_noise(3)).axes[:2]
    assert white.get_title() == "white"
    assert others.get_title() == "other errors"
    (rms,) = [line for line in others.lines if line.get_marker() == "o"]
    assert list(rms.get_xdata()) == [0, 1, 2, 3]
    labels = [axes for axes in calibration_figure(correlated_noise(3)).axes if len(axes.texts) == 4]
    assert any("coaptation" in text for text in texts(labels[0]))


def test_conditions_have_a_row_each() -> None:
    figure = filter_figure(filter_conditions())
    assert [axes.get_title(loc="left") for axes in figure.axes[::3]] == [
        "start anterior 5 MPa, start posterior 3 MPa, noise 0 mm",
        "start anterior 9 MPa, start posterior 6 MPa, noise 0 mm",
        "start anterior 5 MPa, start posterior 3 MPa, noise 0.5 mm",
    ]
    assert texts(figure.axes[1]) == ["single runs"]
    assert texts(figure.axes[3]) == ["failed", "failed"]


def test_discrepancies_are_sorted_by_their_size() -> None:
    figure = discrepancy_figure(discrepancy())
    anterior, posterior = figure.axes
    labels = [label.get_text() for label in anterior.get_yticklabels()]
    assert labels[-3:] == ["annulus 1 mm", "rest length -5 %", "chords +5 %"]
    assert labels[0] == "chords -5 %"
    assert "failed" in texts(anterior)
    widths = [patch.get_width() for patch in posterior.patches]
    assert np.all(np.diff(np.abs(widths)[2:]) >= 0)
    assert widths[-1] == pytest.approx(-57.4)
    assert "“chords +5 %”" in figure.get_suptitle()


def test_filters_have_coverage_only_with_repetitions() -> None:
    figure = filter_figure(filters())
    assert [axes.get_xlabel() for axes in figure.axes] == [
        "error [% of truth]", "95 % interval covers [% of runs]", "forward solves per run"
    ]  # fmt: skip
    single = filter_figure(filters(1))
    assert len(single.axes) == 2
    assert "failed" in texts(single.axes[0])


def test_cost_is_told_by_the_factor_that_splits_it() -> None:
    figure = cost_figure(initial_guess())
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["paper", "iterated"]
    medians = [patch.get_width() for patch in figure.axes[0].patches]
    assert medians == [11.0, 6.0]


@pytest.mark.parametrize("kind", [*PICTURES, "astrology"])
def test_nothing_to_draw_gives_no_figure(kind: str) -> None:
    assert not any(picture.draw(empty(kind)) for picture in pictures_of(empty(kind)))
    lost = all_failed(kind)
    drawn = [picture.ending for picture in pictures_of(lost) if picture.draw(lost) is not None]
    # Guesses that all fail are still a map of failures.
    assert drawn == ([""] if kind == "initial_guess" else [])


def test_all_failed_starts_are_still_a_map() -> None:
    axes = basin_figure(all_failed("initial_guess")).axes[0]
    assert all(patch.get_hatch() for patch in axes.patches)
    assert axes.get_title().startswith("iterated: 0 of 36")
    assert paths_figure(all_failed("initial_guess")) is None


def test_every_kind_has_an_example() -> None:
    assert set(PICTURES) < set(ALL)


def test_labels_of_close_curves_are_apart_and_in_order() -> None:
    _, axes = panels(1, 1, 3.0)
    axes[0, 0].set(xlim=(0, 1), ylim=(0, 1))
    label_ends(axes[0, 0], 1.0, [(0.99, "c", "k"), (0.5, "a", "k"), (0.98, "b", "k")], gap=0.1)
    heights = {text.get_text(): text.xy[1] for text in axes[0, 0].texts}
    assert heights["c"] - heights["b"] == pytest.approx(0.1)
    assert heights["c"] <= 1.0
    assert heights["a"] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("value", "text"), [(0, "0"), (0.0004, "4e-4"), (0.012, "0.012"), (2.25, "2.2"), (73.4, "73")]
)
def test_numbers_on_axes_are_short(value: float, text: str) -> None:
    assert plain_number(value) == text
