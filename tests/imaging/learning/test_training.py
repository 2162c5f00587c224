"""Training: samples of all stages, and volumes that are made worse."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mvest.imaging.detection.pose_search import search_poses
from mvest.imaging.detection.trained_model import STAGES
from mvest.imaging.learning import training
from mvest.imaging.learning.training import degrade, draw_samples, train_stage, volume_samples
from mvest.imaging.volume import VolumeSequence
from tests.imaging.detection.made_up import labelled, moving_valve


def test_every_stage_gets_samples_that_its_trees_can_learn_from(
    trained, shape, seen_valve, settings
):
    frame, true = seen_valve
    found = draw_samples(labelled(true, shape, frame=frame), settings.samples)
    assert set(found) == set(STAGES)
    for name, (x, y) in found.items():
        assert len(x) == len(y) > 10, name
        assert np.isfinite(x).all(), name
        assert np.isfinite(y).all(), name
        # Trees and samples agree on features and outputs.
        assert trained.boosters[name](x).shape == y.shape, name
        assert x.std(axis=0).max() > 5.0, name


def test_the_boundary_is_a_probability(trained, shape, seen_valve, settings):
    frame, true = seen_valve
    x = draw_samples(labelled(true, shape, 1, frame), settings.samples)["boundary"][0]
    found = trained.boosters["boundary"](x * 3)
    assert found.min() >= 0
    assert found.max() <= 1
    assert "objective=cross_entropy" in trained.boosters["boundary"].texts[0]


def test_a_stage_learns_from_its_samples(shape, seen_valve, settings):
    # More of it than its mean: on the samples themselves, with enough trees.
    frame, true = seen_valve
    found = draw_samples(labelled(true, shape, frame=frame), settings.samples)
    more = replace(settings, boosting=replace(settings.boosting, trees=60))
    for name in ("position", "pose_refine_0", "annulus"):
        x, y = found[name]
        said = train_stage(name, x, y, more, 1)(x)
        assert np.abs(said - y).mean() < 0.6 * np.abs(y - y.mean(axis=0)).mean(), name


@pytest.fixture
def rendered(monkeypatch, seen_valve):
    """No volume is simulated: every valve is seen in the same small frame."""
    calls = []

    def render(valve, which, base, spread, seed, *, degraded):
        assert degraded
        assert spread == "training"
        assert 0 <= which < len(valve.times)
        calls.append((valve.name, which, seed.entropy, seed.spawn_key))
        true = seen_valve[1]
        return None, SimpleNamespace(vertices=true.vertices[None], tips=true.tips[None])

    monkeypatch.setattr(training, "render_frame", render)
    monkeypatch.setattr(training, "standard_frame", lambda volume, k: seen_valve[0])
    return calls


def test_a_drafts_mistakes_are_its_best_and_some_others(trained, shape, seen_valve, settings):
    (frame, true), draft, count = seen_valve, trained.boosters, settings.samples.mistaken
    without, found = (
        draw_samples(labelled(true, shape, frame=frame), settings.samples, trees)["pose_fine"]
        for trees in (None, draft)
    )
    assert len(found[0]) == len(without[0]) + count
    rated = draft["pose_fine"](found[0][-count:])[:, 0]
    _, ratings = search_poses(frame, draft, count // 2)
    np.testing.assert_allclose(rated[: count // 2], ratings)
    assert len(np.unique(rated.round(9))) > 2


def test_a_volume_has_samples_of_its_own_seed(rendered, shape, settings):
    valve = moving_valve(3)
    samples = [
        volume_samples(valve, k, shape, settings, seed) for k, seed in ((0, 3), (0, 3), (1, 3))
    ]
    volume_samples(valve, 0, shape, settings, 4)
    assert set(samples[0]) == {f"{name}.{axis}" for name in STAGES for axis in "xy"}
    assert all(array.dtype == np.float32 for array in samples[0].values())
    first, again, other = (each["position.x"] for each in samples)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    # Every volume is rendered by a stream of its own, whatever the number of volumes.
    streams = [(entropy, key) for *_, entropy, key in rendered]
    assert streams[0] == streams[1]
    assert len(set(streams)) == 3


# -- degraded volumes -----------------------------------------------------------------------------
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
