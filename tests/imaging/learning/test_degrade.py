"""Training volumes are made worse: by an amount that shows, and never outside the field of view."""

import numpy as np

from mvest.imaging.learning.training import degrade
from mvest.imaging.volume import VolumeSequence


def volume() -> VolumeSequence:
    frames = np.zeros((2, 20, 22, 24), np.uint8)
    frames[:, 5:] = 100
    frames[:, 12] = 220  # a bright sheet
    return VolumeSequence(
        frames, np.full(3, 0.8), np.eye(3), np.zeros(3), np.array([0.0, 0.1]), source="made up"
    )


def test_about_half_are_changed_and_the_others_are_as_they_were():
    given = volume()
    changed = [degrade(given, np.random.default_rng(k)) is not given for k in range(100)]
    assert 35 < sum(changed) < 65


def test_what_lies_outside_stays_outside_and_grey_values_stay_in_their_range():
    # Noise outside would enlarge the field of view.
    for seed in range(30):
        found = degrade(volume(), np.random.default_rng(seed)).frames
        assert found.dtype == np.uint8
        assert not found[:, :5].any()


def test_every_kind_of_change_occurs():
    sheets, noises, cuts = [], [], []
    for seed in range(60):
        found = degrade(volume(), np.random.default_rng(seed)).frames.astype(float)
        sheets.append(found[:, 12].mean() - found[:, 7].mean())
        noises.append(found[:, 16:].std())
        cuts.append(found[:, 6].mean())
    assert min(sheets) < 80  # blurred: 120 as it was
    assert max(noises) > 10
    assert min(cuts) < 60


def test_the_same_generator_gives_the_same_volume():
    first, second = (degrade(volume(), np.random.default_rng(3)).frames for _ in range(2))
    np.testing.assert_array_equal(first, second)
