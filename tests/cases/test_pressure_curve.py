import numpy as np
import pytest

from mvest.cases.folder import ATRIUM, VENTRICLE, generic_curve, pressure_curve
from mvest.errors import InputError


@pytest.mark.parametrize(
    ("time", "pressure"),
    # Where both curves have a point: 6 - 7, 14 - 5, 120 - 7 mmHg.
    [(0.40, -1.0), (0.53, 9.0), (0.58, 113.0)],
)
def test_the_generic_curve_is_ventricle_minus_atrium(time, pressure):
    assert generic_curve()(time) == pytest.approx(pressure, abs=1e-9)


def test_the_generic_curve_rises_once_and_stays():
    curve = generic_curve()
    rise = [curve(t) for t in np.linspace(0.53, 0.58, 40)]
    assert (np.diff(rise) > 0).all()
    plateau = [curve(t) for t in np.linspace(0.58, 0.70, 40)]
    assert min(plateau) > 110
    assert max(plateau) < 125


@pytest.mark.parametrize("time", [0.39, 0.701, 0.75, -1.0])
def test_no_curve_is_continued_beyond_its_ends(time):
    # The atrium is known up to 0.70 s only, the ventricle up to 0.80 s.
    assert ATRIUM[-1][0] < VENTRICLE[-1][0]
    with pytest.raises(InputError, match=r"outside the pressure curve, which runs from 0.4 to 0.7"):
        generic_curve()(time)


@pytest.mark.parametrize(
    ("time", "pressure", "message"),
    [
        ([0.0], [1.0], "two or more"),
        ([0.0, 1.0], [1.0], "pressures: shape"),
        ([0.0, np.nan], [1.0, 2.0], "finite"),
        ([0.0, 1.0, 1.0], [1.0, 2.0, 3.0], "time 1 s of point 2"),
    ],
)
def test_a_curve_that_is_none(time, pressure, message):
    with pytest.raises(InputError, match=message):
        pressure_curve(np.array(time), np.array(pressure))
