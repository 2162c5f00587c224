"""A truth that is extrapolated to zero mesh size."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.common.building.twin import build_twin
from mvest.errors import ConfigurationError
from mvest.estimation.prediction import Prediction
from mvest.problem.stored import Extrapolated, StoredModel
from tests.experiments.configured import composed, plain


def stored(folder: Path, size: float, converged: bool = True) -> StoredModel:
    def model(m: Any) -> Prediction:
        if not converged:
            return Prediction.failed("does not close")
        return Prediction(np.array([2.0, -1.0]) * m[0] + size**2 * np.array([1.0, 3.0]), np.eye(2))

    return StoredModel(model, folder, f"cells of {size:g}")


def test_what_is_quadratic_in_the_size_of_cells_comes_out_at_size_zero(tmp_path: Path) -> None:
    truth = Extrapolated(stored(tmp_path, 0.2), stored(tmp_path, 0.3), 0.2 / 0.3)
    at = np.array([5.0, 0.0])
    np.testing.assert_allclose(truth(at).y, [10.0, -5.0], atol=1e-12)
    np.testing.assert_allclose(truth.correction(at), [-0.04, -0.12], atol=1e-12)


@pytest.mark.parametrize("failing", [0, 1])
def test_a_mesh_on_which_the_valve_does_not_close_fails_it(tmp_path: Path, failing: int) -> None:
    fine, coarse = (stored(tmp_path, 0.1 * (k + 1), k != failing) for k in range(2))
    prediction = Extrapolated(fine, coarse, 0.5)(np.ones(2))
    assert not prediction.converged
    assert prediction.reason == "does not close"


def twin_values(*overrides: str) -> dict[str, Any]:
    return plain(composed("experiment=debug", "truth=converged", *overrides))


def test_the_truth_is_made_on_both_meshes(tmp_path: Path) -> None:
    values = twin_values(
        "truth.columns=30", "truth.rows=5", "truth.extrapolated_from=[24,4]", "truth.element=tet4"
    )
    values["paths"]["outputs"] = str(tmp_path)
    source = build_twin(values).source
    assert isinstance(source, Extrapolated)
    assert source.share == pytest.approx(0.8)
    assert source.fine.key != source.coarse.key


@pytest.mark.parametrize("coarser", ["[90]", "[126,14]", "[90,9]"])
def test_meshes_that_are_no_pair_are_refused(coarser: str) -> None:
    with pytest.raises(ConfigurationError, match="extrapolated_from"):
        build_twin(twin_values(f"truth.extrapolated_from={coarser}"))
