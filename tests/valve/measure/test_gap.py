"""The gap of a closed valve, on shapes whose gap is known by hand."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.valve.measure.annulus import annulus_plane
from mvest.valve.measure.coaptation import find_gap
from tests.valve.shapes import bands, circle, join, plate

BELOW, FRONT = np.array([0.0, 0.0, 20.0]), np.array([0.0, 30.0, 0.0])


def square(side):
    """Annulus of this side; lines of sight run along z."""
    h = 0.5 * side
    return np.array([[h, -h, 0], [h, h, 0], [-h, h, 0], [-h, -h, 0]], float)


def plates(gap, height):
    """Two plates to either side of y = 0 that reach beyond the annulus, one below the other."""
    one = plate((-15, 0.5 * gap, 0), (30, 0, 0), (0, 15, 0))
    other = plate((-15, -15 - 0.5 * gap, height), (30, 0, 0), (0, 15, 0))
    vertices, triangles, _ = join(one, other)
    return vertices, triangles


@pytest.mark.parametrize("height", [0.0, 6.0])
def test_plates_leave_their_distance_less_the_reach(height):
    # 4 mm apart, 2 mm of which is reach: a strip 2 mm wide over 20 mm, 40 mm^2. Each long edge is
    # counted to a pixel of 0.05 mm: 2 * 0.05 * 20 = 2 mm^2.
    annulus = square(20.0)
    plane = annulus_plane(annulus, BELOW, FRONT)
    gap = find_gap(*plates(4.0, height), annulus, plane, 2.0, 0.05)
    assert gap.area == pytest.approx(40.0, abs=2.0)
    # The strip of 80 mm^2 that no plate covers is gap and slit together.
    assert (gap.open.sum() + gap.slit.sum()) * 0.05**2 == pytest.approx(80.0, abs=2.0)
    assert not np.any(gap.open & gap.slit)


def test_a_hole_in_a_spherical_cap_shrinks_by_half_the_reach():
    # Cap of a sphere of 20 mm from a rim of 15 mm to a hole of 5 mm; leaflets of 1 mm half reach
    # leave pi (5 - 1)^2 = 50.27 mm^2, here within 1 % (pixels of 0.05 mm).
    radii = np.linspace(15.0, 5.0, 30)
    depth = np.sqrt(20.0**2 - radii**2) - np.sqrt(20.0**2 - 15.0**2)
    vertices, triangles = bands([circle(r, 240, z) for r, z in zip(radii, depth, strict=True)])
    annulus = circle(15.0, 240)
    plane = annulus_plane(annulus, BELOW, FRONT)
    gap = find_gap(vertices, triangles, annulus, plane, 2.0, 0.05)
    assert gap.area == pytest.approx(np.pi * 4.0**2, rel=0.015)


def test_a_negative_reach_is_refused():
    annulus = square(10.0)
    plane = annulus_plane(annulus, BELOW, FRONT)
    with pytest.raises(InputError, match="reach of the contact = -1"):
        find_gap(*plates(1.0, 0.0), annulus, plane, -1.0)
