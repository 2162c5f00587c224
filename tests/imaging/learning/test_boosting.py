"""Boosted trees: what they learn, agreement with LightGBM, refusal of malformed text."""

from dataclasses import replace

import lightgbm
import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.learning.boosting import Boosters, BoostSettings, train_boosters

SMALL = BoostSettings(trees=12, leaves=5, rate=0.3, min_leaf_samples=4, share_features=0.8)


def samples(count=120, outputs=2):
    rng = np.random.default_rng(0)
    x = rng.standard_normal((count, 6)).astype(np.float32)
    x[:, 4] = 3.0  # a feature that never changes
    y = np.stack([np.sign(x[:, 0]) * (k + 1.0) + 10 * k for k in range(outputs)], axis=1)
    return x, y


@pytest.fixture(scope="module")
def trained():
    return train_boosters(*samples(), SMALL, 3)


def test_every_output_is_learned_by_its_own_trees(trained):
    # Labels of the first output for all, or outputs in another order.
    x, y = samples()
    found = trained(x)
    assert found.shape == y.shape
    assert np.abs(found - y).mean(axis=0).max() < 0.4


@pytest.mark.parametrize("objective", ["regression", "cross_entropy"])
def test_answers_are_those_of_lightgbm_to_the_last_bit(objective):
    x, _ = samples(400)
    y = 1.0 / (1.0 + np.exp(-x[:, :1].astype(float) * x[:, 1:2]))
    trees = train_boosters(x, y, replace(SMALL, trees=60), 1, objective)
    other = lightgbm.Booster(model_str=trees.texts[0]).predict(3 * x, num_threads=1)
    np.testing.assert_array_equal(trees(3 * x)[:, 0], other)

    if objective == "cross_entropy":
        assert trees(10 * x).min() >= 0
        assert trees(10 * x).max() <= 1


def test_other_numbers_of_features_are_refused(trained):
    x, y = samples()
    with pytest.raises(InputError, match="6 features, found 5"):
        trained(x[:, :5])
    other = train_boosters(x[:, :5], y[:, :1], SMALL, 1)
    for texts in ((), (trained.texts[0], other.texts[0])):
        with pytest.raises(InputError, match="f: trees of"):
            Boosters(texts, "f")


def spoiled(text, key, change):
    """The text with the values of a key changed at its first place, sizes of trees put right."""
    lines = text.split("\n")
    at = next(k for k, line in enumerate(lines) if line.startswith(key + "="))
    before = lines[at]
    lines[at] = f"{key}={change(before.partition('=')[2])}"
    grown = len(lines[at]) - len(before)
    sizes = next(k for k, line in enumerate(lines) if line.startswith("tree_sizes="))
    if at > sizes:
        first, *rest = lines[sizes].partition("=")[2].split()
        lines[sizes] = "tree_sizes=" + " ".join([str(int(first) + grown), *rest])
    return "\n".join(lines)


def first(value):
    return lambda values: " ".join([value, *values.split()[1:]])


CUTS = [
    lambda t: "",
    lambda t: t[: len(t) // 2],
    lambda t: t[: t.index("Tree=3")] + "end of trees\n",
]
FIELDS = [
    ("num_class", lambda v: "3"),
    *(("split_feature", first(index)) for index in ("999999", "-1", "0.5")),
    *(("left_child", first(index)) for index in ("70", "-70", "0")),
    *(("leaf_value", first(value)) for value in ("x", "nan")),
    ("leaf_value", lambda v: v + " 0"),
    *(("num_leaves", lambda v, count=count: count) for count in ("1000000", "-2")),
    ("decision_type", first("1")),
]


@pytest.mark.parametrize("change", [*CUTS, *FIELDS])
def test_a_malformed_text_is_refused(trained, change):
    # Several of these would read beyond arrays, or go round without end.
    text = trained.texts[0]
    bad = spoiled(text, *change) if isinstance(change, tuple) else change(text)
    assert bad != trained.texts[0]
    with pytest.raises(InputError, match=r"^model\.npz, annulus: no trees") as told:
        Boosters((bad,), "model.npz, annulus")
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 200
