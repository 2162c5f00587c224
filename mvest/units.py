"""Conversions at the boundary between what people write and what the library computes with.

Inside mvest lengths are mm, times s, masses tonne, forces N, stresses and pressures MPa. The set is
consistent: 1 N = 1 t mm/s² and 1 MPa = 1 N/mm². Every conversion is a factor, so it takes a float
or an array of any shape and returns the same.

Sources: the conventional millimetre of mercury is 13.5951 g/cm³ × 9.80665 m/s² × 1 mm, which is
133.322387415 Pa exactly (NIST SP 811, 2008, appendix B.8, gives 133.3224). Every other factor
follows from the SI prefixes (BIPM, SI Brochure, 9th ed., table 7) and 1 l = 1 dm³ (table 8).
"""

from typing import Final, TypeVar

from mvest.typing import FloatArray

PA_PER_MMHG: Final = 133.322387415
"""Pascal per conventional millimetre of mercury."""

PA_PER_MPA: Final = 1e6
"""Pascal per megapascal."""

KPA_PER_MPA: Final = 1e3
"""Kilopascal per megapascal."""

MM3_PER_ML: Final = 1e3
"""Cubic millimetres per millilitre (1 ml = 1 cm³)."""

T_PER_MM3_PER_G_PER_ML: Final = 1e-9
"""Tonne per cubic millimetre in one gram per millilitre: 1e-6 t / 1e3 mm³."""

_Number = TypeVar("_Number", float, FloatArray)


def mmhg_to_mpa(pressure: _Number) -> _Number:
    """Pressure in MPa from mmHg."""
    return pressure * (PA_PER_MMHG / PA_PER_MPA)


def mpa_to_mmhg(pressure: _Number) -> _Number:
    """Pressure in mmHg from MPa."""
    return pressure * (PA_PER_MPA / PA_PER_MMHG)


def kpa_to_mpa(stress: _Number) -> _Number:
    """Stress in MPa from kPa."""
    return stress / KPA_PER_MPA


def mpa_to_kpa(stress: _Number) -> _Number:
    """Stress in kPa from MPa."""
    return stress * KPA_PER_MPA


def ml_to_mm3(volume: _Number) -> _Number:
    """Volume in mm³ from ml."""
    return volume * MM3_PER_ML


def mm3_to_ml(volume: _Number) -> _Number:
    """Volume in ml from mm³."""
    return volume / MM3_PER_ML


def g_per_ml_to_t_per_mm3(density: _Number) -> _Number:
    """Density in t/mm³ from g/ml."""
    return density * T_PER_MM3_PER_G_PER_ML


def t_per_mm3_to_g_per_ml(density: _Number) -> _Number:
    """Density in g/ml from t/mm³."""
    return density / T_PER_MM3_PER_G_PER_ML
