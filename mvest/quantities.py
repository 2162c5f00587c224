"""Types of settings: numbers with a unit and an admissible range.

A setting declares its range by its type, such as ``length: Length = 20.0``. pydantic and
`experiments.common.schema` check it; everything else sees a float or an int.
"""

from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

from pydantic import AfterValidator, GetCoreSchemaHandler

from mvest.errors import InputError


class OutsideError(InputError):
    """A number of a setting is outside its range."""


@dataclass(frozen=True, slots=True)
class Within:
    """A range, with both ends admissible, that pydantic checks if it annotates a type."""

    low: float
    high: float
    unit: str
    why: str

    def check(self, value: Any, name: str = "") -> Any:
        """The value, if it is None or all numbers in it are inside; else an OutsideError."""
        for part in value if isinstance(value, list | tuple) else ():
            self.check(part, name)
        if isinstance(value, int | float) and not self.low <= value <= self.high:
            said = f"expected {self.low:.10g} to {self.high:.10g} {self.unit}".rstrip()
            why = f" ({self.why})" if self.why else ""
            raise OutsideError(f"{name} = {value:.10g}, {said}{why}")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        """The hook of pydantic."""
        return AfterValidator(self.check).__get_pydantic_core_schema__(source, handler)


within = Within
"""The range of a type of settings; both ends are admissible."""


# Meshes and points.
PointsAround: TypeAlias = Annotated[int, within(3, 1000, "", "points around the valve")]
PointsAlong: TypeAlias = Annotated[int, within(2, 500, "", "points from annulus to free edge")]
CellsAround: TypeAlias = Annotated[int, within(1, 400, "", "cells around the valve")]
CellsAlong: TypeAlias = Annotated[int, within(1, 60, "", "cells from annulus to free edge")]
Layers: TypeAlias = Annotated[int, within(1, 16, "", "cells through the thickness")]
AxisCount: TypeAlias = Annotated[int, within(1, 1000, "", "cells, points or voxels of an axis")]
Refinement: TypeAlias = Annotated[
    int, within(1, 4, "", "each doubling takes eight times the memory")
]
EdgeLength: TypeAlias = Annotated[float, within(0.1, 20, "mm", "edges of cells of a leaflet")]

# Geometry.
Length: TypeAlias = Annotated[float, within(0, 1000, "mm", "sizes and distances in a body")]
Place: TypeAlias = Annotated[float, within(-1000, 1000, "mm", "coordinates in a body")]
Thickness: TypeAlias = Annotated[float, within(0.01, 10, "mm", "no leaflet is thicker")]
Thicknesses: TypeAlias = Annotated[float, within(0, 20, "", "multiples of the thickness")]
Angle: TypeAlias = Annotated[float, within(-360, 360, "degrees", "once around")]

# Loads and times.
Pressure: TypeAlias = Annotated[
    float, within(-100, 500, "mmHg", "no heart makes more; a negative one opens the valve")
]
PressureError: TypeAlias = Annotated[float, within(0, 100, "mmHg", "errors of pressures")]
BeatTime: TypeAlias = Annotated[float, within(0, 60, "s", "times within heartbeats")]
TimeStep: TypeAlias = Annotated[float, within(1e-5, 10, "s", "time steps of a beat")]

# Tissue and forces.
Modulus: TypeAlias = Annotated[
    float, within(1e-6, 10_000, "MPa", "from 1 Pa, softer than any gel, to what bone has")
]
LawExponent: TypeAlias = Annotated[
    float, within(0, 100_000, "", "exponents of the exponential law, in a list with its scale")
]
Ratio: TypeAlias = Annotated[float, within(0.001, 1000, "", "one modulus over another")]
Stiffening: TypeAlias = Annotated[float, within(0, 1e6, "", "one law over another")]
Stretch: TypeAlias = Annotated[float, within(0, 5, "", "no leaflet is stretched to five times")]
PoissonRatio: TypeAlias = Annotated[float, within(-1, 0.4999, "", "stable and compressible")]
Stiffness: TypeAlias = Annotated[
    float, within(0, 100_000, "N, N/mm or N/mm²", "far stiffer than what it holds")
]
Density: TypeAlias = Annotated[float, within(1e-12, 1e-7, "t/mm³", "water has 1e-9")]
DampingRate: TypeAlias = Annotated[float, within(0, 1000, "1/s or s", "more stops all motion")]

# Statistics and numerics.
Share: TypeAlias = Annotated[float, within(0, 1, "", "shares of a whole")]
Percent: TypeAlias = Annotated[float, within(0, 1000, "%", "shares of a whole, and their errors")]
Factor: TypeAlias = Annotated[float, within(0, 100, "", "factors and exponents")]
Weight: TypeAlias = Annotated[float, within(0, 1000, "", "weights and densities")]
Logarithm: TypeAlias = Annotated[
    float, within(-10, 10, "", "logarithms and standard normal numbers")
]
Tolerance: TypeAlias = Annotated[float, within(1e-15, 1, "", "relative tolerances and steps")]
Value: TypeAlias = Annotated[float, within(-1e12, 1e12, "", "in the units of any model")]
Values: TypeAlias = Annotated[Any, within(-1e12, 1e12, "", "in the units of any model")]
Count: TypeAlias = Annotated[int, within(0, 100_000, "", "things that each take their time")]
Halvings: TypeAlias = Annotated[int, within(0, 60, "", "of a step; then nothing is left of it")]
Repeats: TypeAlias = Annotated[int, within(1, 100_000, "", "observations to estimate from")]
Seed: TypeAlias = Annotated[int, within(0, 2**32 - 1, "", "what random generators take")]

# The simulated scanner.
Decibel: TypeAlias = Annotated[float, within(-200, 200, "dB", "levels, also per cm and MHz")]
Frequency: TypeAlias = Annotated[float, within(0.1, 100, "MHz", "ultrasound")]

# Machines.
Processes: TypeAlias = Annotated[int, within(1, 1024, "", "processes of one machine")]
TimeLimit: TypeAlias = Annotated[float, within(0.01, 2_592_000, "s", "up to 30 days")]
Gigabytes: TypeAlias = Annotated[float, within(0.1, 100_000, "GB", "more than any machine has")]
