"""The detection model's file: round trip, and refusal of damaged files."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.detection.trained_model import load_model, save_model


@pytest.fixture(scope="module")
def path(trained, tmp_path_factory):
    found = tmp_path_factory.mktemp("models") / "made_up.npz"
    save_model(found, trained)
    return found


@pytest.fixture(scope="module")
def loaded(path):
    return load_model(path)


# --- there and back -----------------------------------------------------------------------------


def test_a_model_comes_back_as_it_was_saved(trained, loaded, path, tmp_path):
    save_model(tmp_path / "again.npz", loaded)
    with np.load(path) as a, np.load(tmp_path / "again.npz") as b:
        assert a.files == b.files
        assert all(np.array_equal(a[name], b[name]) for name in a.files)
    assert loaded.shape.layout == trained.shape.layout
    assert (loaded.shape.size_mm, loaded.trained_on) == (trained.shape.size_mm, trained.trained_on)
    np.testing.assert_allclose(loaded.shape.modes, trained.shape.modes, atol=1e-6)
    assert loaded.accuracy.correlation_length_mm == 6.5
    for name in ("std_mm", "samples", "tip_samples", "shapes", "tip_shapes"):
        before, after = getattr(trained.accuracy, name), getattr(loaded.accuracy, name)
        np.testing.assert_allclose(after, before, atol=1e-6)
    assert loaded.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_digest_is_of_what_affects_a_detection_and_its_errors(loaded):
    assert replace(loaded, trained_on={"seed": 99}, sha256="").digest == loaded.digest
    accuracy = replace(loaded.accuracy, like_from=0.123)
    trees = {**loaded.boosters, "annulus": loaded.boosters["free_edge"]}
    others = [replace(loaded, accuracy=accuracy), replace(loaded, boosters=trees)]
    assert len({loaded.digest, *(other.digest for other in others)}) == 3


# --- refused ------------------------------------------------------------------------------------


def refused(path, words):
    with pytest.raises(InputError) as told:
        load_model(path)
    message = str(told.value)
    assert str(path) in message
    assert words in message
    assert "\n" not in message
    assert len(message) < 300 + len(str(path))


def altered(path, tmp_path, change):
    """A copy of the model's file whose arrays `change` has changed."""
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    change(arrays)
    target = tmp_path / "altered.npz"
    np.savez(target, **arrays)
    return target


def text(words):
    return np.frombuffer(words.encode(), np.uint8)


def about(change):
    """A change of the part of the file that says what it is."""

    def of(arrays):
        stated = json.loads(bytes(arrays["about"]).decode())
        arrays["about"] = text(json.dumps(change(stated) or stated))

    return of


BAD = [
    (about(lambda a: a.update(format="mvest case")), "'mvest case'"),
    (about(lambda a: a.update(version=99)), "99"),
    (about(lambda a: a.pop("columns") and None), "columns"),
    (about(lambda a: a.update(columns=24)), "shape.mean"),
    (lambda a: a.update({"trees.boundary.0": text("tree")}), "boundary"),
    (lambda a: a.update({"shape.mean": np.full_like(a["shape.mean"], np.nan)}), "shape"),
    *((lambda a, name=name: a.pop(name), name) for name in ("shape.mean", "trees.boundary.0")),
    (lambda a: a.update({"accuracy.std_mm": a["accuracy.std_mm"][:-1]}), "accuracy"),
]


@pytest.mark.parametrize(("change", "words"), BAD)
def test_a_wrong_file_is_refused_by_name(path, tmp_path, change, words):
    refused(altered(path, tmp_path, change), words)
