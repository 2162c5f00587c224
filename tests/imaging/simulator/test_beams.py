import math
from dataclasses import replace

import numpy as np
import pytest

from mvest.imaging.simulator.acquisition import Acquisition
from mvest.imaging.simulator.beams import BeamGrid, losses_of, render_window
from mvest.imaging.simulator.scene import Echoes, cell_volume

QUIET = Acquisition(
    azimuth_deg=36.0, elevation_span_deg=36.0, depth_mm=(30.0, 70.0), beats=1,
    compensation_db_per_cm_mhz=0.15, blood_db=-200.0, electronics_db=-200.0, haze_db=-200.0,
)  # fmt: skip
FLAT = np.zeros((3, 3))


def render(acquisition, echoes, losses=None, seed=0):
    grid = BeamGrid.of(acquisition)
    losses = losses or losses_of(grid, echoes, FLAT)
    rng = np.random.default_rng(seed)
    return grid, render_window(grid, echoes, losses, (0, grid.azimuth.count), rng)


def echoes(points, amplitude=1.0, loss=0.0):
    n = len(points)
    return Echoes(np.asarray(points, float), np.full(n, amplitude), np.full(n, loss))


def block(seed=0, count=None, side=(22.0, 22.0, 22.0)):
    """Homogeneous tissue around 50 mm, of mean power 1; by default 12 scatterers per cell."""
    side = np.array(side)
    count = count or int(12.0 / cell_volume(QUIET, 50.0) * side.prod())
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3)) * side
    points[:, 2] += 50.0
    return echoes(points, math.sqrt(side.prod() / count))


def samples(grid):
    axes = (grid.azimuth, grid.elevation, grid.distance)
    return tuple(x.start + x.step * np.arange(x.count) for x in axes)


def inner(grid, envelope):
    """Samples well within the block."""
    a, e, d = samples(grid)
    within = np.ix_(np.abs(a) < 0.14, np.abs(e) < 0.13, np.abs(d - 50) < 7)
    return envelope[within]


def test_speckle_is_fully_developed():
    # Envelope of a complex Gaussian: mean over standard deviation sqrt(pi / (4 - pi)) = 1.91
    # (Goodman, Speckle Phenomena in Optics). About 1000 independent cells: 3 % sampling error.
    envelope = inner(*render(QUIET, block())).astype(float)
    assert envelope.mean() / envelope.std() == pytest.approx(1.913, abs=0.12)


def test_tissue_of_0_db_has_mean_power_1_at_any_depth_and_angle():
    # A wrong size of the resolution cell would show as a trend; without the Jacobian of the angles,
    # corners would be 20 % off.
    wide = replace(QUIET, azimuth_deg=80.0, elevation_span_deg=70.0)
    grid, envelope = render(wide, block(3, 400_000, (120.0, 100.0, 44.0)))
    power = envelope.astype(float) ** 2
    a, e, d = samples(grid)
    a, e = np.abs(np.rad2deg(a)), np.abs(np.rad2deg(e))
    middle = power[a < 25][:, e < 22]
    assert middle[:, :, (d > 36) & (d < 46)].mean() == pytest.approx(1, rel=0.05)
    assert middle[:, :, (d > 56) & (d < 66)].mean() == pytest.approx(1, rel=0.05)
    corner = power[(a > 28) & (a < 38)][:, (e > 24) & (e < 33)]
    assert corner[:, :, (d > 46) & (d < 60)].mean() == pytest.approx(1, rel=0.08)


def test_a_point_is_as_wide_as_set():
    # In the mean over where the point lies between samples, which changes the width by a tenth.
    acquisition = replace(QUIET, side_lobe_db=-60.0)
    grid = BeamGrid.of(acquisition)
    axes = (grid.azimuth, grid.elevation, grid.distance)
    wanted = (math.radians(1.9), math.radians(2.4), 0.9)
    variances = []
    for offset in np.arange(8) / 8:
        a, e, r = (x.start + x.step * (x.count // 2 + offset) for x in axes)
        sight = np.array([math.tan(a), math.tan(e), 1.0])
        _, envelope = render(acquisition, echoes([r * sight / np.linalg.norm(sight)]))
        peak = np.unravel_index(envelope.argmax(), envelope.shape)
        row = []
        for axis, x in enumerate(axes):
            line = envelope[tuple(slice(None) if k == axis else i for k, i in enumerate(peak))]
            position = x.start + np.arange(x.count) * x.step
            mean = np.average(position, weights=line)
            assert mean == pytest.approx((a, e, r)[axis], abs=0.05 * x.step)
            row.append(np.average((position - mean) ** 2, weights=line))
        variances.append(row)
    # Full width at half maximum of a Gaussian from its second moment.
    width = np.sqrt(8 * math.log(2) * np.mean(variances, axis=0))
    np.testing.assert_allclose(width, wanted, rtol=0.02)


def test_echoes_interfere_with_the_phase_of_the_way_there_and_back():
    # A quarter of the wavelength (0.308 mm at 5 MHz) apart they cancel, half of it apart they add.
    def peak(*depths):
        return render(QUIET, echoes([[0.0, 0.0, z] for z in depths]))[1].max()

    assert peak(50.0, 50.077) < 0.25 * peak(50.0)
    assert peak(50.0, 50.154) == pytest.approx(peak(50.0) + peak(50.154), rel=0.05)


def slab(level):
    """Attenuating tissue from 36 to 46 mm on one side, without echo: a lattice."""
    n, side, corner = np.array([60, 120, 40]), np.array([30, 60, 10]), np.array([-30, -30, 36.0])
    points = (np.indices(n).reshape(3, -1).T + 0.5) * (side / n) + corner
    return Echoes(points, np.zeros(len(points)), np.full(len(points), level * np.prod(side / n)))


def test_attenuation_is_what_the_tissue_is_given_there_and_back():
    # 5 dB/cm over 1 cm, twice: 10 dB; a slanted beam runs through more of it.
    grid = BeamGrid.of(QUIET)
    losses = losses_of(grid, slab(5.0), FLAT)
    a = losses.start[0] + losses.step[0] * np.arange(losses.decibel.shape[0])
    e = losses.start[1] + losses.step[1] * np.arange(losses.decibel.shape[1])
    within = (a < -0.09) & (a > -0.3)
    behind = losses.decibel[within][:, np.abs(e) < 0.3][:, :, -3]
    ta, te = np.tan(a[within])[:, None], np.tan(e[np.abs(e) < 0.3])[None]
    expected = 10 * np.sqrt(1 + ta**2 + te**2)
    np.testing.assert_allclose(behind / expected, 1, atol=0.06)
    assert np.mean(behind / expected) == pytest.approx(1, rel=0.01)
    assert np.abs(losses.decibel[a > 0.09]).max() < 1e-6
    assert np.abs(losses.decibel[:, :, :3]).max() < 1e-6


def change(point, acquisition=QUIET, losses=None):
    """In dB, of the peak of a point's echo."""
    plain, other = (
        render(one, echoes([point]), lost)[1].max()
        for one, lost in ((QUIET, None), (acquisition, losses))
    )
    return 20 * math.log10(other / plain)


@pytest.mark.parametrize(
    ("settings", "within"),
    [
        ({"blood_db": -20.0}, 0.3),
        ({"electronics_db": -20.0, "compensation_db_per_cm_mhz": 0.0}, 0.1),
    ],
)
def test_noise_has_the_levels_set(settings, within):
    noise = render(replace(QUIET, **settings), echoes([[0.0, 0.0, -1.0]]))[1].astype(float)
    assert 10 * math.log10(np.mean(noise**2)) == pytest.approx(-20, abs=within)


def test_there_is_shadow_behind_dense_tissue_and_nowhere_else():
    losses = losses_of(BeamGrid.of(QUIET), slab(10.0), FLAT)
    points = [[-8.0, 0.0, 60.0], [8.0, 0.0, 60.0], [-5.0, 0.0, 33.0]]
    for point, expected in zip(points, (-20.0 * np.hypot(1, 8 / 60), 0.0, 0.0), strict=True):
        assert change(point, losses=losses) == pytest.approx(expected, abs=1.0)


def test_side_lobes_have_the_level_set():
    acquisition = replace(QUIET, side_lobe_db=-20.0)
    grid, envelope = render(acquisition, echoes([[0.0, 0.0, 50.0]]))
    line = envelope.max(axis=(1, 2))
    away = np.abs(grid.azimuth.start + grid.azimuth.step * np.arange(len(line)))
    lobe = line[away > 1.1 * math.radians(acquisition.lateral_deg)].max()
    assert 20 * math.log10(lobe / line.max()) == pytest.approx(-20, abs=2)


def test_compensation_amplifies_with_depth():
    more = replace(QUIET, compensation_db_per_cm_mhz=0.35)
    for z in (40.0, 60.0):
        # 0.2 dB/cm/MHz at 5 MHz there and back.
        assert change([0.0, 0.0, z], more) == pytest.approx(0.2 * z, abs=1e-3)
