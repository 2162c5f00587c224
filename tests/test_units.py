"""Conversions against numbers worked out by hand."""

import numpy as np
import pytest

from mvest import units


def test_the_millimetre_of_mercury_is_the_weight_of_its_column() -> None:
    # 13.5951 g/cm³ = 13595.1 kg/m³; × 9.80665 m/s² × 1e-3 m = 133.322387415 Pa.
    assert pytest.approx(13595.1 * 9.80665 * 1e-3, rel=1e-15) == units.PA_PER_MMHG


@pytest.mark.parametrize(
    ("convert", "given", "expected"),
    [
        # 120 mmHg × 133.322387415 Pa = 15998.6864898 Pa.
        (units.mmhg_to_mpa, 120.0, 0.0159986864898),
        (units.mpa_to_mmhg, 0.0159986864898, 120.0),
        # 1 kPa = 1e3 Pa = 1e-3 MPa.
        (units.kpa_to_mpa, 60.0, 0.06),
        (units.mpa_to_kpa, 0.06, 60.0),
        # 1 ml = 1 cm³ = (10 mm)³.
        (units.ml_to_mm3, 0.5, 500.0),
        (units.mm3_to_ml, 500.0, 0.5),
        # Water: 1 g/ml = 1e-6 t / 1e3 mm³.
        (units.g_per_ml_to_t_per_mm3, 1.0, 1e-9),
        (units.t_per_mm3_to_g_per_ml, 1e-9, 1.0),
    ],
)
def test_known_values(convert, given: float, expected: float) -> None:
    assert convert(given) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("there", "back"),
    [
        (units.mmhg_to_mpa, units.mpa_to_mmhg),
        (units.kpa_to_mpa, units.mpa_to_kpa),
        (units.ml_to_mm3, units.mm3_to_ml),
        (units.g_per_ml_to_t_per_mm3, units.t_per_mm3_to_g_per_ml),
    ],
)
def test_arrays_keep_their_shape_and_come_back(there, back) -> None:
    values = np.array([[0.0, -3.5], [120.0, 1e6]])
    converted = there(values)
    assert converted.shape == values.shape
    np.testing.assert_allclose(back(converted), values, rtol=1e-15)


def test_the_internal_units_are_consistent() -> None:
    # Water 1 m high presses with 9806.65 Pa, also when computed from t/mm³, mm/s² and mm.
    density = units.g_per_ml_to_t_per_mm3(1.0)
    assert density * 9806.65 * 1000.0 == pytest.approx(9806.65 / units.PA_PER_MPA, rel=1e-14)
