import pytest
from matplotlib.figure import Figure

from mvest.errors import InputError
from mvest.reporting.figures import iterates_figure, save_figure_with

LINE = "table1: mvest 0.1.0, commit 0123456789ab, configuration cdcdcdcdcdcd, seed 1"


def drawn(iterates=((5.0, 3.0), (6.1, 2.3), (6.22, 2.1), (6.2296, 2.0901))):
    """A figure of four iterates with standard deviations of 0.1."""
    names, std = ("E_f.anterior", "E_f.posterior"), [(0.1, 0.1)] * len(iterates)
    return iterates_figure("Moduli: same model", names, iterates, std, (6.23, 2.09))


def test_iterates_band_and_truth_are_drawn() -> None:
    axes = drawn().axes[0]
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
        drawn(())


def test_files_are_reproducible_and_say_where_they_come_from(tmp_path) -> None:
    names = []
    for base in ("a", "b"):
        names.append(save_figure_with(tmp_path / base, drawn(), LINE, pdf=True))
    for first, second in zip(*names, strict=True):
        assert first.read_bytes() == second.read_bytes()
    assert [path.suffix for path in names[0]] == [".png", ".pdf"]
    assert b"configuration cdcdcdcdcdcd" in names[0][0].read_bytes()
    assert not list(tmp_path.glob(".*"))


def test_an_unwritable_place_is_one_clear_error(tmp_path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        save_figure_with(tmp_path / "file" / "a", drawn(), LINE)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a" * 150 + "\n" + "b" * 150, "a" * 150 + "\n" + "b" * 150),
        ("a" * 161, "a" * 20 + "…"),
        ("\n".join("abcdefghijklmno"), "a\nb\nc\nd\ne\nf\ng\nh\ni\nj\n…"),
    ],
)
def test_a_note_of_two_lines_is_whole_and_an_endless_one_is_cut(tmp_path, text, shown) -> None:
    figure = Figure()
    note = figure.text(0, 0, text)
    save_figure_with(tmp_path / "figure", figure, "line")
    assert note.get_text() == shown
