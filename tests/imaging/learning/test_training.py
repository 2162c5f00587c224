"""Training: samples of all stages, and the same model however many processes made it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mvest.imaging.detection.frame import features
from mvest.imaging.detection.pose_search import WIDE, search_poses
from mvest.imaging.detection.trained_model import STAGES
from mvest.imaging.learning import training
from mvest.imaging.learning.training import (
    draw_samples,
    taken_for_valves,
    train_model,
    train_stage,
    volume_samples,
)
from tests.imaging.detection.made_up import moving_valve


def test_every_stage_gets_samples_that_its_trees_can_learn_from(
    trained, shape, seen_valve, settings
):
    found = draw_samples(*seen_valve, shape, settings.samples, np.random.default_rng(0))
    assert set(found) == set(STAGES)
    for name, (x, y) in found.items():
        assert len(x) == len(y) > 10, name
        assert x.dtype == y.dtype == np.float32
        assert np.isfinite(x).all(), name
        assert np.isfinite(y).all(), name
        # Trees and samples agree on features and outputs.
        assert trained.boosters[name](x).shape == y.shape, name
        assert x.std(axis=0).max() > 5.0, name


def test_the_boundary_is_a_probability(trained, shape, seen_valve, settings):
    x = draw_samples(*seen_valve, shape, settings.samples, np.random.default_rng(1))["boundary"][0]
    found = trained.boosters["boundary"](x * 3)
    assert found.min() >= 0
    assert found.max() <= 1
    assert "objective=cross_entropy" in trained.boosters["boundary"].texts[0]


def test_a_stage_learns_from_its_samples(shape, seen_valve, settings):
    # More of it than its mean: on the samples themselves, with enough trees.
    found = draw_samples(*seen_valve, shape, settings.samples, np.random.default_rng(0))
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


def learned(valves, settings, seed, given=None, **others):
    """A model from samples that are made one after another."""

    def sampled(numbers, shape, make_draft):
        draft = make_draft() if make_draft else None
        if given is not None:
            given.extend((number, draft is not None) for number in numbers)
        return [
            volume_samples(valves[k % len(valves)], k, shape, settings, seed, draft)
            for k in numbers
        ]

    return train_model(valves, settings, seed, sampled=sampled, **others)


def test_a_model_is_trained_from_valves_in_turn(rendered, settings):
    valves, done = [moving_valve(k) for k in range(5)], []
    model = learned(
        valves,
        replace(settings, volumes=6),
        11,
        trained_on={"why": "a test"},
        progress=lambda: done.append(1),
    )
    assert set(model.boosters) == set(STAGES)
    assert model.trained_on == {"why": "a test"}
    assert model.accuracy is None
    assert [name for name, *_ in rendered] == [f"made up {k}" for k in (0, 1, 2, 3, 4, 0)]
    # Every volume has a seed of its own, and not all are of the same frame.
    assert len({(entropy, key) for *_, entropy, key in rendered}) == 6
    assert len({which for _, which, *_ in rendered}) > 1
    assert len(done) == len(STAGES)


def test_a_draft_of_the_first_volumes_is_searched_with_in_the_others(
    rendered, settings, monkeypatch
):
    # Mistakes of nothing, or of a search that saw the very volume, would be easy ones.
    given, stages = [], []
    stage = training.train_stage

    def one_tree(name, x, y, settings, seed):
        stages.append((name, len(x)))
        return stage(name, x, y, settings, seed)

    monkeypatch.setattr(training, "train_stage", one_tree)
    told = replace(settings, volumes=3, draft_volumes=1)
    learned([moving_valve(k) for k in range(5)], told, 11, given)
    assert given == [(0, False), (1, True), (2, True)]
    assert {name for name, _ in stages[: -len(STAGES)]} == {
        name for name in STAGES if name.startswith("po")
    }
    rows = dict(stages[-len(STAGES) :])
    once = dict(stages[: -len(STAGES)])
    assert rows["pose_coarse"] == 3 * once["pose_coarse"]
    assert rows["pose_fine"] == 3 * once["pose_fine"] + 2 * settings.samples.mistaken


def test_a_drafts_mistakes_are_its_best_and_some_others(trained, seen_valve):
    frame, draft = seen_valve[0], trained.boosters
    found = taken_for_valves(frame, draft, 10, np.random.default_rng(0))
    assert len(found) == 10
    best, ratings = search_poses(frame, draft, 5)
    np.testing.assert_allclose(found.centre[:5], best.centre)
    rated = draft["pose_fine"](features(frame, WIDE, found.centre, found.axes))
    assert rated.max() == pytest.approx(ratings[0])
    assert len(np.unique(found.centre.round(9), axis=0)) > 5


def test_training_depends_on_its_seed_alone(rendered, settings):
    valves = [moving_valve(k) for k in range(5)]
    models = [learned(valves, settings, 3) for _ in range(2)]
    texts = [{name: b.texts for name, b in m.boosters.items()} for m in models]
    assert texts[0] == texts[1]
    # Volume 0 has the same seed among two as among more, and another one with another seed.
    once = rendered[: settings.volumes]
    shape = models[0].shape
    for number, seed in ((0, 3), (0, 4)):
        training.volume_samples(valves[0], number, shape, settings, seed)
    assert rendered[-2] == once[0]
    assert rendered[-1] != once[0]
