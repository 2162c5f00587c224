"""A deck and its frames as a case: written, read again, and what is asked for."""

from pathlib import Path

import numpy as np
import pytest

from experiments.doors import import_command
from mvest.cases.case import Role
from mvest.cases.folder import read_case
from mvest.errors import InputError
from mvest.exchange.abaqus.recording import read_recording
from mvest.exchange.importing.abaqus import AbaqusOptions, import_abaqus
from tests.exchange.surfaces.recorded import CASE, NAMES, skirt, write

SETS = {
    "leaflets": tuple(f"{region}:{name}" for region, name in NAMES["leaflets"].items()),
    "annulus": NAMES["annulus"],
    "free_edge": NAMES["free_edge"],
}


@pytest.fixture
def source(tmp_path: Path) -> Path:
    data = skirt(tips_mm=4.0)
    data["pressure"] = 0.0133322  # 100 mmHg from outside: the valve closes
    write(tmp_path, data)
    return tmp_path / CASE


def test_a_closure_becomes_a_case(source: Path, tmp_path: Path, capsys) -> None:
    words = [f"{key}={value}".replace("'", "").replace("(", "[").replace(")", "]").replace(" ", "")
             for key, value in SETS.items()]  # fmt: skip
    assert import_command(["abaqus", str(source), str(tmp_path / "case"), *words]) == 0
    assert "1 mm assumed; std_mm=... states it" in capsys.readouterr().out
    case = read_case(tmp_path / "case")
    valve = read_recording(source, **NAMES).valve
    assert case.simulated
    assert case.surface.region_names == ("anterior", "septal", "posterior")
    assert case.surface.vertices == pytest.approx(valve.surface.vertices, abs=1e-9)
    assert case.surface.fibre == pytest.approx(valve.surface.fibre, abs=1e-6)
    assert np.all(case.surface.thickness == 0.65)
    opened, closed = case.frame(Role.REFERENCE), case.frame(Role.CLOSED)
    assert (opened.pressure_mmHg, closed.pressure_mmHg) == (0, pytest.approx(100, rel=1e-4))
    assert closed.papillary_tips[:, 2] == pytest.approx([-24, -24, -24])
    assert closed.annulus == pytest.approx(0.9 * opened.annulus, abs=1e-6)
    assert case.chordae.rest_length == pytest.approx(valve.chordae.rest_length)
    assert case.chordae.axial_stiffness == pytest.approx(valve.chordae.axial_stiffness)
    assert case.chordae.family_names == (
        "anterior_chordae", "septal_chordae", "posterior_chordae",
    )  # fmt: skip


@pytest.mark.parametrize("name", list(SETS))
def test_what_a_deck_does_not_say_is_asked_for(source: Path, name: str) -> None:
    given = {key: value for key, value in SETS.items() if key != name}
    with pytest.raises(
        InputError, match=rf"give {name}=.*; the deck's sets are ANTERIOR"
    ) as caught:
        import_abaqus(source, AbaqusOptions(**given))
    assert len(str(caught.value).splitlines()) == 1


def test_a_leaflet_without_its_set(source: Path) -> None:
    with pytest.raises(InputError, match="give leaflets="):
        import_abaqus(source, AbaqusOptions(**SETS | {"leaflets": ("anterior",)}))


def test_a_folder_without_a_deck(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no file"):
        import_abaqus(tmp_path, AbaqusOptions(**SETS))
