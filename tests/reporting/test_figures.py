import numpy as np
import pytest

from mvest.errors import InputError
from mvest.reporting.figures import iterates_figure, save_figure_with, valve_figure
from tests.reporting.records import failed_record, record

LINE = "table1: mvest 0.1.0, commit 0123456789ab, configuration cdcdcdcdcdcd, seed 1"


@pytest.fixture
def fields(tmp_path):
    """Two triangles that move by 0.3 mm and 0.1 mm."""
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, -1]], dtype=float)
    path = tmp_path / "fields.npz"
    np.savez_compressed(
        path,
        triangles=np.array([[0, 1, 2], [1, 3, 2]]),
        region=np.array([0, 1]),
        rest=rest,
        observed=np.stack([rest, rest]),
        fitted=np.stack([rest, rest + np.array([0, 0, 0.5])]),
        distance=np.array([0.0, 0.1, 0.2, 0.3]),
    )
    return path


def drawn(of):
    """The iterates of a record."""
    return iterates_figure(
        f"{of['title']}: {of['row']}", of["parameters"], of["iterates"], of["iterate_std"],
        of["truth"],
    )  # fmt: skip


def test_iterates_band_and_truth_are_drawn() -> None:
    axes = drawn(record()).axes[0]
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    assert list(lines["E_f.anterior"]) == [5.0, 6.1, 6.22, 6.2296]
    band = axes.collections[0].get_paths()[0].vertices
    # First iterate 5.0 with two standard deviations of 0.1.
    at_start = band[band[:, 0] == 0, 1]
    assert at_start.min() == pytest.approx(4.8)
    assert at_start.max() == pytest.approx(5.2)
    levels = [
        line.get_ydata()[0]
        for line in axes.lines
        if line.get_linestyle() == "--" and len(line.get_ydata())
    ]
    assert levels == [6.23, 2.09]


def test_a_run_without_iterates_is_refused() -> None:
    with pytest.raises(InputError, match="nothing to draw"):
        drawn(failed_record())


def test_valve_is_drawn_open_and_closed_from_two_sides(fields) -> None:
    figure = valve_figure(fields)
    titles = [axes.get_title() for axes in figure.axes[:4]]
    assert titles == [
        "open, from the atrium",
        "closed, from the atrium",
        "open, from the side",
        "closed, from the side",
    ]
    assert figure.axes[4].get_ylabel() == "distance, fitted to observed [mm]"
    assert figure.axes[4].get_ylim() == pytest.approx((0.0, 0.3))


def test_unseen_vertices_are_grey(fields) -> None:
    with np.load(fields) as data:
        arrays = dict(data)
    arrays["distance"][arrays["triangles"][0, 0]] = np.nan
    np.savez(fields, **arrays)
    figure = valve_figure(fields)
    closed = figure.axes[1].collections[0].get_facecolor()[:, :3]
    touched = np.any(arrays["triangles"] == arrays["triangles"][0, 0], axis=1)
    grey = np.ptp(closed, axis=1) < 1e-9
    # Faces are drawn by depth; shading keeps grey grey, and the map of distances has no grey.
    assert grey.sum() == touched.sum() < len(grey)


def test_missing_or_damaged_fields_are_named(tmp_path) -> None:
    with pytest.raises(InputError, match="no fields of a valve"):
        valve_figure(tmp_path / "none.npz")
    np.savez(tmp_path / "half.npz", triangles=np.zeros((1, 3)))
    with pytest.raises(InputError, match=r"half\.npz"):
        valve_figure(tmp_path / "half.npz")


def test_files_are_reproducible_and_say_where_they_come_from(tmp_path) -> None:
    names = []
    for base in ("a", "b"):
        names.append(save_figure_with(tmp_path / base, drawn(record()), LINE))
    for first, second in zip(*names, strict=True):
        assert first.read_bytes() == second.read_bytes()
    assert [path.suffix for path in names[0]] == [".png", ".pdf"]
    assert b"configuration cdcdcdcdcdcd" in names[0][0].read_bytes()
    assert not list(tmp_path.glob(".*"))


def test_an_unwritable_place_is_one_clear_error(tmp_path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        save_figure_with(tmp_path / "file" / "a", drawn(record()), LINE)
