"""Importers and exporters: found by name, options in words, one line if wrong."""

import importlib
import sys
import textwrap

import pytest

from experiments import cli, exchange
from mvest.cases.folder import read_case
from tests.made_up_closure import made_up_case

MODULE = '''
    """A valve as another program has it."""
    from dataclasses import dataclass
    from pathlib import Path
    from mvest.cases.case import ValveCase
    from mvest.errors import InputError
    from tests.made_up_closure import made_up_case

    @dataclass(frozen=True, slots=True)
    class OtherOptions:
        """Options.

        Attributes
        ----------
        pressure_mmHg : float or None
            Of the closed frame.
        """

        pressure_mmHg: float | None = None
        tips: tuple[tuple[float, ...], ...] = ()

    def import_other(source: Path, options: OtherOptions) -> ValveCase:
        """Read what the other program wrote."""
        if options.pressure_mmHg is None:
            raise InputError(f"{source}: no pressure; give pressure_mmHg=...")
        return made_up_case()

    def export_other(source: Path, target: Path, options: OtherOptions) -> Path:
        """Write what the other program reads."""
        target.write_text(f"{source.name} {options.tips}")
        return target
    '''


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with one importer and exporter, in place of those that ship."""
    folder = tmp_path / "made_up_exchange"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "other.py").write_text(textwrap.dedent(MODULE))
    (folder / "neighbour.py").write_text('"""No importer."""')
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module("made_up_exchange")
    monkeypatch.setattr(exchange, "importing", module)
    monkeypatch.setattr(exchange, "exporting", module)
    yield
    for name in [name for name in sys.modules if name.startswith("made_up_exchange")]:
        del sys.modules[name]


def test_an_import_writes_a_case_that_can_be_read(package, tmp_path, capsys):
    assert cli.main(["import", "other", "there", "case", "pressure_mmHg=110"]) == 0
    said = capsys.readouterr().out
    assert "next: mvest own-valve case --check" in said
    case = read_case(tmp_path / "case")
    assert case.name == made_up_case().name
    for sentence in case.derived:
        assert f"* {sentence}" in said


def test_an_export_gets_its_options(package, tmp_path):
    assert cli.main(["export", "other", "run", "out.txt", "tips=[[1, 2.5, 3]]"]) == 0
    assert (tmp_path / "out.txt").read_text() == "run ((1.0, 2.5, 3.0),)"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["import", "other", "there", "case"], "there: no pressure; give pressure_mmHg="),
        (["import", "other", "there", "case", "presure=1"], "known are pressure_mmHg, tips"),
        (["import", "other", "there"], "CASE"),
        (["import", "neighbour", "there", "case"], "known: other"),
    ],
)
def test_what_is_wrong_is_one_line(package, tmp_path, capsys, words, said):
    with pytest.raises(SystemExit) as left:
        sys.exit(cli.main(words))
    assert left.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert said in line
    assert not (tmp_path / "case").exists()


def test_an_existing_case_stays_and_nothing_is_read_for_it(package, tmp_path, capsys):
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "mine").touch()
    # Read without a pressure, it would be refused for that.
    assert cli.main(["import", "other", "there", "case"]) == 2
    assert "exists and is not an empty folder" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "case").iterdir()] == ["mine"]


def test_help_lists_importers_and_their_options(package, capsys):
    for words, said in (
        (["import"], "other        A valve as another program has it."),
        (["import", "other", "--help"], "Of the closed frame."),
    ):
        with pytest.raises(SystemExit) as left:
            cli.main(words)
        assert left.value.code == 0
        assert said in capsys.readouterr().out
