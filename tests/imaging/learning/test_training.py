"""Training: samples of all stages, and degraded volumes."""

import numpy as np
import pytest

from mvest.imaging.detection.trained_model import STAGES
from mvest.imaging.learning.training import degrade, draw_samples
from mvest.imaging.volume import VolumeSequence
from tests.imaging.detection.made_up import labelled


@pytest.fixture
def samples(shape, seen_valve, settings):
    """Samples of all stages from the small frame."""
    frame, true = seen_valve

    def draw(draft=None):
        return draw_samples(labelled(true, shape, frame=frame), settings.samples, draft)

    return draw


def test_every_stage_gets_samples_that_its_trees_can_learn_from(trained, samples):
    found = samples()
    assert set(found) == set(STAGES)
    for name, (x, y) in found.items():
        assert len(x) == len(y) > 10, name
        assert np.isfinite(x).all(), name
        assert np.isfinite(y).all(), name
        # Trees and samples agree on features and outputs.
        assert trained.boosters[name](x).shape == y.shape, name
        assert x.std(axis=0).max() > 5.0, name
    # The boundary is a probability.
    p = trained.boosters["boundary"](found["boundary"][0] * 3)
    assert p.min() >= 0
    assert p.max() <= 1
    assert "objective=cross_entropy" in trained.boosters["boundary"].texts[0]


# -- degraded volumes -----------------------------------------------------------------------------
def volume() -> VolumeSequence:
    frames = np.zeros((2, 20, 22, 24), np.uint8)
    frames[:, 5:] = 100
    frames[:, 12] = 220  # a bright sheet
    return VolumeSequence(frames, np.full(3, 0.8), np.eye(3), np.zeros(3), np.array([0.0, 0.1]))


def test_about_half_are_changed_by_every_kind_of_change_and_only_inside():
    given, sheets, noises, cuts, changed = volume(), [], [], [], 0
    for seed in range(100):
        found = degrade(given, np.random.default_rng(seed))
        again = degrade(given, np.random.default_rng(seed))
        np.testing.assert_array_equal(found.frames, again.frames)
        changed += found is not given
        assert found.frames.dtype == np.uint8
        # Noise outside would enlarge the field of view.
        assert not found.frames[:, :5].any()
        grey = found.frames.astype(float)
        sheets.append(grey[:, 12].mean() - grey[:, 7].mean())
        noises.append(grey[:, 16:].std())
        cuts.append(grey[:, 6].mean())
    assert 35 < changed < 65
    assert min(sheets) < 80  # blurred: 120 as it was
    assert max(noises) > 10
    assert min(cuts) < 60
