"""The detectors that come with the package, on simulated volumes of a valve that they never saw."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.imaging.detection.detect import NoValveError
from mvest.imaging.detection.tracking import detect_valve
from mvest.imaging.detection.trained_model import default_model
from mvest.imaging.layout import ValveLayout
from mvest.imaging.simulator.acquisition import Acquisition, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.observation.surfaces import surface_distance
from tests.made_up_sequence import descending_valve

LAYOUT = ValveLayout(64, 15)


@pytest.fixture(scope="module")
def model():
    return default_model()


@pytest.fixture(scope="module")
def seen():
    """Two open frames of a valve with an anatomy of its own, and where it truly is."""
    moving = descending_valve(LAYOUT)
    probe = draw_probe(np.random.default_rng(5), tilt_deg=(0.0, 25.0))
    return simulate_volume(moving, Acquisition(), probe, 3), true_sequence(moving, probe)


def test_a_valve_is_found_where_it_is(model, seen):
    # Limits are some three times the mean errors of results/imaging.md.
    volume, true = seen
    found = detect_valve(volume, model)
    for k in range(2):
        gap = surface_distance(found.vertices[k], true.vertices[k], LAYOUT.triangles)
        assert gap.mean() < 1.0
        assert np.linalg.norm(found.vertices[k] - true.vertices[k], axis=1).mean() < 3.0
        assert np.linalg.norm(found.tips[k] - true.tips[k], axis=1).mean() < 6.0
    assert found.frame_confidence.min() > 0.3
    assert np.isfinite(found.std_mm).all()


def test_a_volume_without_a_valve_gives_a_verdict_and_no_mesh(model, seen):
    volume, _ = seen
    grey = np.random.default_rng(1).integers(0, 256, volume.frames.shape[1:], dtype=np.uint8)
    noise = replace(volume, frames=grey[None], times=volume.times[:1], source="noise")
    with pytest.raises(NoValveError, match="noise: no valve found") as told:
        detect_valve(noise, model)
    assert "\n" not in str(told.value)
