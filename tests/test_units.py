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
    ],
)
def test_known_values(convert, given: float, expected: float) -> None:
    assert convert(given) == pytest.approx(expected, rel=1e-14)


def test_arrays_keep_their_shape_and_come_back() -> None:
    values = np.array([[0.0, -3.5], [120.0, 1e6]])
    converted = units.mmhg_to_mpa(values)
    assert converted.shape == values.shape
    np.testing.assert_allclose(units.mpa_to_mmhg(converted), values, rtol=1e-15)
