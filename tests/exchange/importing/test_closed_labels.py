"""A closed label map whose leaflets touch, beside the open one of the same small valve."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from mvest.cases.case import Role, ValveCase
from mvest.errors import InputError
from mvest.exchange.importing.leaflets import LeafletsOptions, import_leaflets
from mvest.valve.geometry.proximity import closest_points
from tests.exchange.importing.voxelised import COLUMNS, ROWS, small_valve, voxelised


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> LeafletsOptions:
    folder = tmp_path_factory.mktemp("maps")
    for closed, name in ((False, "open.nii.gz"), (True, "closed.nii.gz")):
        SimpleITK.WriteImage(voxelised(small_valve(closed), 0.8), str(folder / name))
    # Leaflets that are as tall as each other are not recognised.
    return LeafletsOptions(
        anterior=1,
        posterior=2,
        tips=(-8.0, 0.0, -20.0, 8.0, 0.0, -20.0),
        closed=str(folder / "closed.nii.gz"),
        pressure_mmHg=100.0,
        observer_mm=0.0,
        edge_mm=0.8,
    )


@pytest.fixture(scope="module")
def case(options: LeafletsOptions) -> ValveCase:
    return import_leaflets(_opened(options), options)


def _opened(options: LeafletsOptions) -> Path:
    assert options.closed is not None
    return Path(options.closed).with_name("open.nii.gz")


def test_leaflets_that_touch_are_two_midsurfaces(case: ValveCase) -> None:
    closed, true = case.frame(Role.CLOSED), small_valve(closed=True)
    there = closest_points(closed.vertices, true.vertices, true.triangles).distance
    # The free edge is found to half a thickness.
    above = true.vertices[: 12 * COLUMNS]
    back = closest_points(above, closed.vertices, closed.triangles).distance
    assert np.sqrt(np.mean(there**2)) < 0.3
    assert np.sqrt(np.mean(back**2)) < 0.4
    # The pockets beside the commissures stay.
    commissures = true.vertices.reshape(ROWS, COLUMNS, 3)[:11, [0, COLUMNS // 2]].reshape(-1, 3)
    away = closest_points(commissures, closed.vertices, closed.triangles).distance
    assert away.max() < 0.5
    (line,) = (line for line in case.derived if "cut apart" in line)
    assert "where they touch, over" in line
    centres = closed.vertices[closed.triangles].mean(axis=1)
    nearest = closest_points(centres, true.vertices, true.triangles)
    assert (true.region[nearest.triangle] == closed.region).mean() > 0.97


def test_leaflets_that_are_as_tall_are_asked_for(options: LeafletsOptions) -> None:
    with pytest.raises(InputError, match=r"give anterior=N posterior=N"):
        import_leaflets(_opened(options), LeafletsOptions(tips=options.tips))
