"""Stored truths: found again, and never in the place of another one."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import experiments
import mvest.cache
import mvest.closure.model
import mvest.files
from experiments.common.building.twin import MADE_BY
from mvest.cache import Sources
from mvest.cases.folder import write_case
from mvest.estimation import Prediction
from mvest.problem.stored import StoredModel, key_of


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


VALUES = {"mesh": {"columns": 72, "rows": 8}, "element": "hex27", "dt_factor": 0.25}


def test_the_key_covers_every_value():
    base = key_of(VALUES, MADE_BY)
    assert key_of(dict(reversed(VALUES.items())), MADE_BY) == base
    others = [
        {**VALUES, "element": "hex18"},
        {**VALUES, "dt_factor": 0.5},
        {**VALUES, "mesh": {"columns": 72, "rows": 9}},
        {**VALUES, "more": None},
    ]
    assert len({base, *(key_of(values, MADE_BY) for values in others)}) == 5
    assert key_of(VALUES, (mvest.closure.model, write_case)) != base


@pytest.fixture
def truth(tmp_path, monkeypatch):
    """A copy of both packages, and a function that asks a new process's store for a truth.

    The function returns whether the truth had to be simulated.
    """
    roots = {}
    for package in (mvest, experiments):
        place = tmp_path / "code" / package.__name__
        kept = shutil.ignore_patterns("__pycache__", "*.npz", "*.nbi", "*.nbc")
        roots[package.__name__] = shutil.copytree(Path(package.__file__).parent, place, ignore=kept)

    def is_simulated() -> bool:
        model = Model()
        with monkeypatch.context() as patched:
            patched.setattr(mvest.cache, "SOURCES", Sources(**roots))
            StoredModel(model, tmp_path / "outputs", key_of(VALUES, MADE_BY))(AT)
        return model.calls == 1

    is_simulated.code = tmp_path / "code"
    assert is_simulated()
    assert not is_simulated()
    return is_simulated


def edit(place: Path, old: str, new: str) -> None:
    text = place.read_text()
    assert old in text, f"{old} in {place}"
    place.write_text(text.replace(old, new))


def test_a_truth_outlives_comments_docstrings_and_layout(truth):
    place = truth.code / "mvest" / "mechanics" / "forces" / "contact.py"
    for old, new in (
        ('"""Whether a point has moved so far', '"""Whether one has moved so far'),
        ("self.skin = skin\n", "self.skin = skin  # why\n\n\n"),
        ("# Pairs still apart", "# Those still apart"),
        ("BARRIER = 0.85", "BARRIER = (0.85)"),
        ("Leaflet contact as", "Contact of leaflets as"),
    ):
        edit(place, old, new)
    assert not truth()


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("mvest/mechanics/forces/contact.py", "BARRIER = 0.85", "BARRIER = 0.86"),
        ("mvest/units.py", "133.322387415", "133.3"),
        ("mvest/valve/mesh/_tetwild_worker.py", "np.int64", "np.int32"),
        ("mvest/valve/mesh/tetwild.py", "ENVELOPE_SHARE = 0.05", "ENVELOPE_SHARE = 0.06"),
    ],
)
def test_a_truth_is_made_anew_after_one_line_of_what_makes_it_was_changed(truth, file, old, new):
    edit(truth.code / file, old, new)
    assert truth()


def test_a_truth_outlives_what_has_no_part_in_it(truth):
    code = truth.code
    edit(code / "mvest" / "estimation" / "filters" / "iterated.py", "max_iterations", "max_loops")
    edit(code / "mvest" / "reporting" / "figures.py", "import", "X = 1\nimport")
    (code / "mvest" / "mechanics" / "another.py").write_text("VISCOSITY = 1.0\n")
    assert not truth()
    # That is, until it is used.
    edit(
        code / "mvest" / "mechanics" / "solver.py",
        "import numpy as np\n",
        "import numpy as np\nfrom mvest.mechanics.another import VISCOSITY\n",
    )
    assert truth()
