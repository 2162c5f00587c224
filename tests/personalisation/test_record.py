"""The record of a personalised case: unknowns, frames, errors, and its arrays."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.personalisation import PaperSettings, personalise
from mvest.personalisation.record import arrays_of_case, record_of_case
from mvest.problem.fields import case_fields
from mvest.problem.record import EstimateRecord
from mvest.problem.verdict import NONE, ONE_STATE
from tests.made_up_closure import TISSUE, made_up_case, settings, use


def personalised(*given, fails_above=np.inf, **changes):
    with pytest.MonkeyPatch.context() as patch:
        use(patch, fails_above=fails_above)
        case = made_up_case(0.3, 8.0, np.random.default_rng(1))
        return personalise(case, settings(*given, **changes))


@pytest.fixture(scope="module")
def fit():
    return personalised(moduli_only=True, paper=PaperSettings())


@pytest.fixture(scope="module")
def record(fit):
    return record_of_case(fit)


def test_it_is_plain_data_without_a_truth(fit, record):
    text = json.dumps(record.model_dump(mode="json"), allow_nan=False)
    assert EstimateRecord.model_validate_json(text) == record
    assert (record.case, record.simulated, record.status) == ("made_up", True, "converged")
    free = [row for row in record.unknowns if row.kind != "derived"]
    assert tuple(row.name for row in free) == fit.result.parameters
    assert [row.estimate for row in free] == fit.result.estimate.tolist()
    assert [(row.prior_mean, row.prior_std) for row in free[:2]] == [(6.23, 3.1), (2.09, 1.05)]
    for one in (record, *record.alternatives.values()):
        assert all(row.truth is None for row in one.unknowns)
    assert all(frame.personalised_to_truth is None for frame in record.frames)
    assert np.diag(record.correlation) == pytest.approx(np.ones(len(fit.result.parameters)))


def test_a_truth_is_added_to_all_moduli_and_alternatives(record):
    known = record.with_truth({"E_f.posterior": 3.0, "shift.x": 0.1})
    truth = {one.name: one.truth for one in known.unknowns if one.truth is not None}
    assert truth.pop("G.posterior") == pytest.approx(3.0 / (2 * 1.488))
    assert truth == {
        "E_f.posterior": 3.0,
        "E_perp.posterior": pytest.approx(3.0 / TISSUE["posterior"].ratio),
        "shift.x": 0.1,
    }
    assert set(known.alternatives) == {"moduli_only", "paper"}
    for other in known.alternatives.values():
        assert other.unknown("E_f.posterior").truth == 3.0


def test_every_frame_is_measured_as_observed_and_as_predicted(record):
    rows = record.details["measurements"]
    assert len(rows) == 1 + 2 * 3
    # The template's annulus is 36 mm wide, and contracts by a few per cent at most.
    for row in rows:
        assert row["commissural_diameter_mm"] == pytest.approx(36, rel=0.05)
    assert rows[0]["orifice_mm2"] > 100


def test_gate_and_images_count_in_the_verdict(fit, record):
    assert ONE_STATE in record.verdict.missing
    assert ONE_STATE in record_of_case(fit, gate=True).verdict.passed
    failed = record_of_case(fit, gate=False).verdict
    assert [failed.check for failed in failed.failed_checks if failed.check == ONE_STATE]
    step = {"image_step": ({"unlike": "the volume is unlike those of training"},)}
    unlike = record_of_case(fit, images=step)
    assert any("unlike those of training" in failed.text for failed in unlike.verdict.failed_checks)
    assert unlike.details["image_step"] == step["image_step"]


def test_a_failed_estimation_has_a_record_too():
    fit = personalised(fails_above=4.0, moduli_only=True)
    record = record_of_case(fit)
    assert (record.status, record.frames, record.correlation) == ("failed", (), ())
    assert [row.name for row in record.unknowns] == list(fit.result.parameters)
    assert all(row.estimate is row.low is None for row in record.unknowns)
    assert record.unknowns[0].prior_mean == 6.23
    assert not record.alternatives["moduli_only"].converged
    assert not {"narrower", "errors", "known"} & set(record.details)
    assert record.verdict.trust == NONE
    assert record.reason in record.verdict.failed_checks[0].text
    assert arrays_of_case(fit) == {}


@pytest.mark.parametrize("corresponds", [True, False])
def test_arrays_are_those_that_a_report_reads(tmp_path, fit, corresponds):
    frames = [replace(o, frame=replace(o.frame, corresponds=corresponds)) for o in fit.frames]
    fit = replace(fit, frames=tuple(frames))
    arrays = arrays_of_case(fit)
    # Studies compare all three closed valves with the truth.
    assert {"generic", "registered", "fitted"} <= arrays.keys()
    np.savez(tmp_path / "fields.npz", **arrays)
    fields = case_fields(tmp_path / "fields.npz")
    # The tips lie below the annulus, however the valve lies.
    for turn in Rotation.random(6, rng=1).as_matrix():
        turned = {
            name: values @ turn
            if values.dtype.kind == "f" and values.shape[-1:] == (3,)
            else values
            for name, values in arrays.items()
            if not name.startswith("distance")
        }
        assert case_fields(turned).tips[..., 2].max() < 0.0
    assert fields.frames == ("closed", "late")
    assert fields.seen.tolist() == [True, False]
    if corresponds:
        distance = np.linalg.norm(fields.fitted - fields.observed, axis=2)
        np.testing.assert_allclose(distance, fields.distance_fitted, atol=1e-4)
    else:
        assert fields.observed is None
        assert set(fields.observed_points) == {"closed", "late"}
