"""Conversions against numbers worked out by hand."""

import numpy as np
import pytest

from mvest import units


def test_the_millimetre_of_mercury_is_the_weight_of_its_column() -> None:
    # 13.5951 g/cm³ = 13595.1 kg/m³; × 9.80665 m/s² × 1e-3 m = 133.322387415 Pa.
    assert pytest.approx(13595.1 * 9.80665 * 1e-3, rel=1e-15) == units.PA_PER_MMHG


def test_known_values() -> None:
    # 120 mmHg × 133.322387415 Pa = 15998.6864898 Pa; 1 kPa = 1e-3 MPa.
    pressure = np.array([[0.0, 120.0]])
    converted = units.mmhg_to_mpa(pressure)
    np.testing.assert_allclose(converted, [[0.0, 0.0159986864898]], rtol=1e-12)
    np.testing.assert_allclose(units.mpa_to_mmhg(converted), pressure, rtol=1e-15)
    assert units.kpa_to_mpa(60.0) == pytest.approx(0.06)
