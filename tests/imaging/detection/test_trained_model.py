"""The model's file: it comes back as it was, and a wrong one is refused in one line."""

import hashlib
import json
import zipfile

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.imaging.detection.trained_model import STAGES, DetectionModel, load_model, save_model


@pytest.fixture(scope="module")
def path(trained, tmp_path_factory):
    found = tmp_path_factory.mktemp("models") / "made_up.npz"
    save_model(found, trained)
    return found


@pytest.fixture(scope="module")
def loaded(path):
    return load_model(path)


# --- there and back -----------------------------------------------------------------------------


def test_all_trees_say_the_same(trained, loaded):
    # Stages or outputs in another order, or numbers rounded in the text, are seen here.
    rng = np.random.default_rng(0)
    for name in STAGES:
        before, after = trained.boosters[name], loaded.boosters[name]
        x = rng.uniform(0, 255, (20, before.features)).astype(np.float32)
        np.testing.assert_array_equal(after(x), before(x))


def test_shapes_and_accuracy_come_back(trained, loaded):
    assert loaded.shape.layout == trained.shape.layout
    assert loaded.shape.size_mm == trained.shape.size_mm
    np.testing.assert_allclose(loaded.shape.mean, trained.shape.mean, atol=1e-5)
    np.testing.assert_allclose(loaded.shape.modes, trained.shape.modes, atol=1e-6)
    np.testing.assert_array_equal(loaded.shape.std, trained.shape.std)
    np.testing.assert_array_equal(loaded.shape.tips, trained.shape.tips)
    np.testing.assert_array_equal(loaded.accuracy.std_mm, trained.accuracy.std_mm)
    assert loaded.accuracy.correlation_length_mm == 6.5
    for name in ("samples", "tip_samples", "shapes", "tip_shapes"):
        before, after = getattr(trained.accuracy, name), getattr(loaded.accuracy, name)
        np.testing.assert_allclose(after, before, atol=1e-6)
    assert loaded.trained_on == {"seed": 5, "valves": ["a", "b"]}


def test_a_loaded_model_is_saved_as_the_same_file(loaded, path, tmp_path):
    save_model(tmp_path / "again.npz", loaded)
    with np.load(path) as a, np.load(tmp_path / "again.npz") as b:
        assert a.files == b.files
        assert all(np.array_equal(a[name], b[name]) for name in a.files)
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()
    assert loaded.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_model_that_was_never_tested_has_no_accuracy(trained, tmp_path):
    bare = DetectionModel(trained.shape, trained.boosters, {})
    save_model(tmp_path / "bare.npz", bare)
    assert load_model(tmp_path / "bare.npz").accuracy is None


def test_nothing_is_left_behind_and_an_earlier_file_is_replaced(trained, tmp_path):
    target = tmp_path / "model.npz"
    target.write_bytes(b"earlier")
    save_model(target, trained)
    assert [p.name for p in tmp_path.iterdir()] == ["model.npz"]
    load_model(target)
    with pytest.raises(InputError, match="cannot write"):
        save_model(tmp_path / "nowhere" / "model.npz", trained)


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


def one_less(name):
    return lambda a: a.update({name: a[name][..., :-1]})


def without(name):
    return lambda a: a.pop(name)


BAD = [
    (about(lambda a: a.update(format="mvest case")), "'mvest case'"),
    (about(lambda a: a.update(version=99)), "99"),
    (about(lambda a: a.pop("format") and None), "None"),
    (about(lambda a: [1, 2]), "expected"),
    (about(lambda a: a.pop("columns") and None), "columns"),
    (about(lambda a: a.update(columns="many")), "expected"),
    (about(lambda a: a.update(columns=5)), "layout"),
    (about(lambda a: a.update(columns=24)), "shape.mean"),
    (lambda a: a.update(about=text("{")), "expected"),
    (lambda a: a.update(about=np.array([255, 254], np.uint8)), "expected"),
    (lambda a: a.update(about=np.array(3.0)), "expected"),
    (lambda a: a.update({"trees.boundary.0": text("tree")}), "boundary"),
    (lambda a: a.update({"shape.mean": np.full_like(a["shape.mean"], np.nan)}), "shape"),
    *((without(name), name) for name in ("about", "shape.mean", "trees.boundary.0")),
    (without("accuracy.samples"), "accuracy.samples"),
    *((one_less(f"shape.{name}"), "shape") for name in ("std", "tips", "modes")),
    (one_less("accuracy.std_mm"), "accuracy"),
]


@pytest.mark.parametrize(("change", "words"), BAD)
def test_a_wrong_file_is_refused_by_name(path, tmp_path, change, words):
    refused(altered(path, tmp_path, change), words)


def test_pickled_objects_are_not_unpickled(path, tmp_path):
    # Loading with allow_pickle would run whatever the file says.
    ran = tmp_path / "ran"

    class Runs:
        def __reduce__(self):
            return ran.write_text, ("it did",)

    def change(arrays):
        arrays["shape.tips"] = np.array([Runs()], dtype=object)

    refused(altered(path, tmp_path, change), "expected")
    assert not ran.exists()


def test_files_that_are_no_archive_are_refused(path, tmp_path):
    raw = path.read_bytes()
    for k, content in enumerate((b"", b"hello", raw[: len(raw) // 2], raw[:-1], b"PK\x03\x04")):
        target = tmp_path / f"{k}.npz"
        target.write_bytes(content)
        refused(target, "expected")
    np.save(tmp_path / "array.npy", np.zeros(3))
    refused(tmp_path / "array.npy", "expected")
    with zipfile.ZipFile(tmp_path / "other.npz", "w") as archive:
        archive.writestr("about.npy", "no array")
    refused(tmp_path / "other.npz", "expected")


@pytest.mark.parametrize("seed", range(6))
def test_damaged_files_are_refused(path, tmp_path, seed):
    # A checksum or a packed stream that does not fit: whatever the library calls it.
    raw = bytearray(path.read_bytes())
    rng = np.random.default_rng(seed)
    for at in rng.integers(len(raw) // 10, len(raw) // 2, 200):
        raw[at] ^= 0xFF
    target = tmp_path / "damaged.npz"
    target.write_bytes(bytes(raw))
    refused(target, "expected")


def test_a_file_that_is_not_there_and_a_folder_are_refused(tmp_path):
    refused(tmp_path / "none.npz", "is missing")
    refused(tmp_path, "cannot be read")
