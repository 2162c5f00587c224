"""Stored truths: found again, and never in the place of another one."""

import errno
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import experiments.common.truth
import mvest
from experiments.common.truth import FORWARD_MODEL, StoredModel, truth_key
from mvest.errors import InputError
from mvest.estimation import Prediction


class Model:
    """Counts its calls; five numbers that depend on the parameters."""

    def __init__(self, reason=None):
        self.calls, self.reason = 0, reason

    def __call__(self, m):
        self.calls += 1
        if self.reason:
            return Prediction.failed(self.reason)
        return Prediction(np.arange(5) * m[0] + m[1] / 3, np.ones((5, 2)))


AT = np.array([6.23, 2.09])


def test_the_second_call_reads_from_disk(tmp_path):
    model = Model()
    folder = tmp_path / "below" / "truth"
    first = StoredModel(model, folder, "key")(AT)
    # Another object, as another process would have it.
    second = StoredModel(model, folder, "key")(AT.copy())
    assert model.calls == 1
    np.testing.assert_array_equal(second.y, first.y)
    assert second.converged
    assert second.jacobian.shape == (5, 2)
    assert not np.any(second.jacobian)
    assert [path.suffix for path in folder.iterdir() if path.name[0] != "."] == [".npz"]


def test_a_jacobian_is_kept_where_it_is_wanted_and_never_taken_for_one_without(tmp_path):
    model = Model()
    plain = StoredModel(model, tmp_path, "key")
    whole = StoredModel(model, tmp_path, "key", jacobian=True)
    plain(AT)
    assert whole(AT).jacobian.all()
    assert StoredModel(model, tmp_path, "key", jacobian=True)(AT).jacobian.all()
    assert model.calls == 2
    assert not plain(AT).jacobian.any()


@pytest.mark.parametrize("change", [("other", AT), ("key", AT * [1, 1 + 1e-15]), ("key", AT[::-1])])
def test_another_key_or_other_parameters_are_another_truth(tmp_path, change):
    model = Model()
    StoredModel(model, tmp_path, "key")(AT)
    key, m = change
    np.testing.assert_array_equal(StoredModel(model, tmp_path, key)(m).y, Model()(m).y)
    assert model.calls == 2


def test_a_failure_is_not_stored(tmp_path):
    failing = Model("it buckled")
    assert StoredModel(failing, tmp_path, "key")(AT).reason == "it buckled"
    assert not list(tmp_path.glob("*.npz"))
    assert StoredModel(Model(), tmp_path, "key")(AT).converged


def test_what_was_written_half_is_never_read(tmp_path, monkeypatch):
    model = Model()

    def interrupted(file, **arrays):
        file.write(b"PK\x03\x04 half a file")
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(experiments.common.truth.np, "savez", interrupted)
        with pytest.raises(KeyboardInterrupt):
            StoredModel(model, tmp_path, "key")(AT)
    assert not list(tmp_path.glob("*.npz"))
    y = StoredModel(model, tmp_path, "key")(AT).y
    assert model.calls == 2
    np.testing.assert_array_equal(StoredModel(model, tmp_path, "key")(AT).y, y)
    assert model.calls == 2


def test_hits_and_misses_are_counted(tmp_path):
    first, second = (StoredModel(Model(), tmp_path, "key") for _ in range(2))
    first(AT)
    second(AT)
    assert (first.hits, first.misses, second.hits, second.misses) == (0, 1, 1, 0)


def test_one_of_several_simulates_and_the_others_wait(tmp_path):
    # Locks of threads exclude each other as those of processes do: each opens the file anew.
    begun = threading.Barrier(4)

    class Slow(Model):
        def __call__(self, m):
            time.sleep(0.05)
            return super().__call__(m)

    models = [Slow() for _ in range(4)]

    def use(model):
        begun.wait()
        StoredModel(model, tmp_path, "key")(AT)

    threads = [threading.Thread(target=use, args=(model,)) for model in models]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(model.calls for model in models) == 1


def test_leftovers_of_a_killed_writer_are_taken_away(tmp_path):
    StoredModel(Model(), tmp_path, "key")(AT)
    (entry,) = tmp_path.glob("*.npz")
    entry.rename(tmp_path / f"{entry.stem}.0123.part")
    other = tmp_path / "another.0123.part"
    other.touch()
    StoredModel(Model(), tmp_path, "key")(AT)
    assert list(tmp_path.glob("*.part")) == [other]
    assert entry.exists()


def test_a_damaged_entry_is_made_again(tmp_path, capsys):
    y = StoredModel(Model(), tmp_path, "key")(AT).y
    (entry,) = tmp_path.glob("*.npz")
    entry.write_bytes(entry.read_bytes()[:40])
    again = StoredModel(Model(), tmp_path, "key")
    np.testing.assert_array_equal(again(AT).y, y)
    assert again.misses == 1
    assert "damaged" in capsys.readouterr().err


def test_a_full_disk_leaves_no_half_entry(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(experiments.common.truth.os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        StoredModel(Model(), tmp_path, "key")(AT)
    assert [path.suffix for path in tmp_path.iterdir()] == [".lock"]


VALUES = {"mesh": {"columns": 72, "rows": 8}, "element": "hex27", "dt_factor": 0.25}


def test_the_key_covers_every_value():
    base = truth_key(VALUES)
    assert truth_key(dict(reversed(VALUES.items()))) == base
    others = [
        {**VALUES, "element": "hex18"},
        {**VALUES, "dt_factor": 0.5},
        {**VALUES, "mesh": {"columns": 72, "rows": 9}},
        {**VALUES, "more": None},
    ]
    assert len({base, *map(truth_key, others)}) == 5


@pytest.fixture
def library(tmp_path, monkeypatch):
    """A copy of the forward model's source that stands for the library."""
    root = Path(mvest.__file__).parent
    for part in FORWARD_MODEL:
        source = root / part
        if source.is_dir():
            shutil.copytree(source, tmp_path / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, tmp_path / part)
    monkeypatch.setattr(mvest, "__file__", str(tmp_path / "__init__.py"))
    return tmp_path


def test_the_key_ignores_comments_docstrings_and_layout(library):
    base = truth_key(VALUES)
    place = library / "mechanics" / "contact.py"
    text = place.read_text()
    for old, new in (
        ('"""Contact energy in N mm."""', '"""Something else."""'),
        ("self.skin = skin\n", "self.skin = skin  # why\n\n\n"),
        ("# Pairs still apart", "# Those still apart"),
        ("BARRIER = 0.85", "BARRIER = (0.85)"),
    ):
        assert old in text
        text = text.replace(old, new)
    place.write_text(text.replace("Leaflet contact as", "Contact of leaflets as", 1))
    assert truth_key(VALUES) == base


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("mechanics/contact.py", "BARRIER = 0.85", "BARRIER = 0.86"),
        ("mechanics/law.py", " - ", " + "),
        ("valve/template.py", "bulge: float = 0.04", "bulge: float = 0.05"),
        ("units.py", "133.322387415", "133.3"),
        ("mechanics/settings.py", "patch_radius: float = 2.0", "patch_radius: float = 2.5"),
        ("elements.py", "0.445948490915965", "0.445948490915966"),
    ],
)
def test_the_key_changes_with_the_code_of_the_forward_model(library, file, old, new):
    base = truth_key(VALUES)
    place = library / file
    text = place.read_text()
    assert old in text
    place.write_text(text.replace(old, new))
    assert truth_key(VALUES) != base


def test_a_new_file_of_the_forward_model_changes_the_key(library):
    base = truth_key(VALUES)
    (library / "mechanics" / "another.py").write_text("VISCOSITY = 1.0\n")
    assert truth_key(VALUES) != base


def test_the_parts_of_the_forward_model_exist():
    for part in FORWARD_MODEL:
        assert (Path(mvest.__file__).parent / part).exists()
