"""Conversions between the units of users and of the library.

Inside mvest lengths are mm, times s, masses tonne, forces N, stresses and pressures MPa. These are
consistent: 1 N = 1 t mm/s² and 1 MPa = 1 N/mm². A conversion takes a float or an array and returns
the same.

Sources: the conventional millimetre of mercury is 13.5951 g/cm³ × 9.80665 m/s² × 1 mm, which is
133.322387415 Pa exactly (NIST SP 811, 2008, appendix B.8, gives 133.3224). Every other factor
follows from the SI prefixes (BIPM, SI Brochure, 9th ed., table 7).
"""

from typing import Final, TypeVar

from mvest.typing import FloatArray

PA_PER_MMHG: Final = 133.322387415
"""Pascal per conventional millimetre of mercury."""

PA_PER_MPA: Final = 1e6
"""Pascal per megapascal."""

KPA_PER_MPA: Final = 1e3
"""Kilopascal per megapascal."""

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
