"""Exports of virtual patients against shapes that are known exactly."""

import numpy as np
import SimpleITK

from mvest.valve.anatomy.valve import band_grid
from tests.exchange.importing.voxelised import THICKNESS, on_grid, voxelised


def test_voxels_have_no_facets():
    # A tube of 16 columns of facets: these lie 0.06 mm within it on average.
    radius, grid = 9.0, band_grid(16, 6)
    turn = np.radians(grid.phi)
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), -10.0 * grid.s], axis=1)
    image = voxelised(on_grid(points, grid), 0.25)
    labels = SimpleITK.GetArrayFromImage(image)
    inside = np.argwhere(labels > 0)[:, ::-1]
    places = np.array([image.TransformContinuousIndexToPhysicalPoint(p.tolist()) for p in inside])
    away = np.hypot(places[:, 0], places[:, 1])[np.abs(places[:, 2] + 5.0) < 3.0]
    # The mean over a ring is farther out than its middle.
    assert np.abs(away.mean() - (radius + THICKNESS**2 / (12.0 * radius))) < 0.015
