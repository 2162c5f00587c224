"""Stored truths: found again, and never in the place of another one."""

import numpy as np
import pytest

import mvest.cache
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


VALUES = {"mesh": {"columns": 72, "rows": 8}, "element": "hex27", "dt_factor": 0.25}


def test_a_truth_is_made_anew_after_a_change_of_the_code(tmp_path, monkeypatch):
    def is_simulated() -> bool:
        model = Model()
        StoredModel(model, tmp_path / "outputs", key_of(VALUES, "experiments"))(AT)
        return model.calls == 1

    assert is_simulated()
    assert not is_simulated()
    monkeypatch.setattr(mvest.cache, "code_digest", lambda folder: folder.name)
    assert is_simulated()
