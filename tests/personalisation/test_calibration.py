"""The calibration of the moduli: what it changes in a record, when it is refused, and its file."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from mvest.cases.case import Arrival
from mvest.cases.folder import read_case, write_case
from mvest.errors import InputError
from mvest.mechanics.settings import ClosureProtocol
from mvest.personalisation import PaperSettings, calibration, personalise
from mvest.personalisation.calibration import (
    Calibration,
    FoundCalibration,
    MeasuredFor,
    calibrate,
    calibration_for,
    read_calibration,
    settings_digest,
    write_calibration,
)
from mvest.personalisation.record import record_of_case
from mvest.personalisation.settings import PACKAGE
from mvest.problem.record import UNCALIBRATED, EstimateRecord
from mvest.problem.verdict import DOUBTFUL
from tests.calibrated_patients import MODULI, PRIOR, patients
from tests.made_up_closure import MECHANICS, made_up_case, settings, use

OFFSET, SLOPE, SPREAD = (0.05, 0.2), (0.9, 1.2), (1.5, 0.8)


def a_calibration(measured_for, **changes):
    """Known numbers without any uncertainty."""
    numbers = {
        "offset": OFFSET,
        "slope": SLOPE,
        "covariance": np.zeros((4, 4)).tolist(),
        "log_spread": np.log(SPREAD).tolist(),
        "log_spread_covariance": np.zeros((2, 2)).tolist(),
    }
    return Calibration(
        measured_for=measured_for,
        parameters=MODULI,
        simulated=60,
        patients=57,
        seeds=(8001, 8002),
        **numbers | changes,
    )


@pytest.fixture(scope="module")
def fit():
    """A case from a volume, without a calibration."""
    with pytest.MonkeyPatch.context() as patch:
        use(patch)
        case = made_up_case(0.3, 8.0, np.random.default_rng(1))
        case = replace(case, arrival=Arrival("volume", "ab" * 32))
        return personalise(case, settings(moduli_only=True))


@pytest.fixture(scope="module")
def measured_for(fit):
    return MeasuredFor.of(fit.case, fit.settings)


@pytest.fixture(scope="module")
def plain(fit):
    return record_of_case(fit)


@pytest.fixture(scope="module")
def record(fit, measured_for):
    known = FoundCalibration(a_calibration(measured_for), measured_for)
    return record_of_case(replace(fit, calibration=known))


def test_moduli_are_moved_and_widened_about_their_prior_means(plain, record):
    for name, offset, slope, spread in zip(MODULI, OFFSET, SLOPE, SPREAD, strict=True):
        was, now = plain.unknown(name), record.unknown(name)
        expected = PRIOR[name] * np.exp(offset + slope * np.log(was.estimate / PRIOR[name]))
        assert now.estimate == pytest.approx(expected)
        widths = [np.log(one.high / one.low) for one in (was, now)]
        assert widths[1] == pytest.approx(spread * widths[0])
        assert now.std / now.estimate == pytest.approx(spread * was.std / was.estimate)
        of_it = f"E_perp.{now.region}"
        scale = now.estimate / was.estimate
        assert record.unknown(of_it).estimate == pytest.approx(
            scale * plain.unknown(of_it).estimate
        )
    for own in record.parameters:
        if own.name not in MODULI:
            assert own == plain.unknown(own.name)


def test_the_record_keeps_what_was_before(plain, record):
    before = record.alternatives[UNCALIBRATED]
    assert before.moduli == plain.moduli
    assert set(record.alternatives) == {UNCALIBRATED, *plain.alternatives}
    assert record.iterates == plain.iterates
    assert record.detail_rows("calibration")[0]["patients"] == 57
    assert "calibration" in record.verdict.passed
    assert "calibration" in plain.verdict.missing
    assert EstimateRecord.model_validate_json(record.model_dump_json()) == record


def test_the_ratio_follows_from_the_correlation(fit, plain, record):
    """The stated covariance of the two logarithms, scaled by the spreads, is that of the ratio."""
    (was,), (now,) = (
        [row for row in one.detail_rows("known") if row["name"].startswith("ratio")]
        for one in (plain, record)
    )
    own = fit.result.filtered
    at = [own.names.index(name) for name in MODULI]
    d = np.array([1.0, -1.0]) * SPREAD
    std = np.sqrt(d @ own.transformed.covariance[np.ix_(at, at)] @ d)
    anterior, posterior = (record.unknown(name).estimate for name in MODULI)
    assert now["estimate"] == pytest.approx(anterior / posterior)
    assert now["estimate"] != pytest.approx(was["estimate"], rel=0.05)
    assert np.log(now["high"] / now["low"]) == pytest.approx(2 * 1.959964 * std)
    share = np.array(record.correlation)
    np.testing.assert_allclose(share, np.array(plain.correlation), atol=1e-9)


def test_uncertain_numbers_widen_the_interval(fit, measured_for, record):
    """The variance of offset + slope x is that of the offset plus x² times that of the slope."""
    covariance = np.diag([0.1, 0.0, 0.2, 0.0]) ** 2
    wider = a_calibration(measured_for, covariance=covariance.tolist())
    found = record_of_case(replace(fit, calibration=FoundCalibration(wider, measured_for)))
    (row,) = found.detail_rows("calibration")
    x = row["log_estimate"][0]
    stds = [one.unknown(MODULI[0]).std / one.unknown(MODULI[0]).estimate for one in (record, found)]
    assert stds[1] ** 2 == pytest.approx(stds[0] ** 2 + 0.1**2 + (0.2 * x) ** 2)
    assert found.unknown(MODULI[1]) == record.unknown(MODULI[1])


def test_only_what_belongs_to_the_case_changes_no_digest(fit):
    own, case = fit.settings, fit.case
    digest = settings_digest(case, own)
    protocol = ClosureProtocol(pressure_mmHg=95.0)
    same = (
        replace(own, mechanics=replace(own.mechanics, protocol=protocol)),
        replace(own, confirm=True, paper=PaperSettings(), moduli_only=False),
        replace(own, calibration=PACKAGE),
        replace(own, unknowns=own.unknowns[::-1]),
        replace(own, max_iterations=float(own.max_iterations)),
    )
    assert {settings_digest(case, one) for one in same} == {digest}
    tissue = {**MECHANICS.tissue, "anterior": replace(MECHANICS.tissue["anterior"], nu=0.4)}
    first = replace(own.unknowns[0], std=3.0)
    other = (
        replace(own, mechanics=replace(own.mechanics, tissue=tissue)),
        replace(own, mesh=replace(own.mesh, columns=54)),
        replace(own, unknowns=(first, *own.unknowns[1:])),
        replace(own, tolerance=1e-2),
    )
    assert len({digest, *(settings_digest(case, one) for one in other)}) == 5
    sampled = replace(case)
    object.__setattr__(sampled, "error_samples", range(20))
    assert settings_digest(sampled, own) != digest


@pytest.fixture
def packaged(tmp_path, monkeypatch):
    """A package whose calibrations lie in an empty folder."""
    monkeypatch.setattr(calibration, "CALIBRATIONS", tmp_path)
    return tmp_path / "volume.json"


@pytest.mark.parametrize(("change", "says"), [
    ({}, ""),
    ({"made_by": "cd" * 32}, "measured for other detectors (SHA-256 cdcdcdcdcdcd)"),
    ({"settings": "0" * 64}, "measured for other settings of the estimation"),
    ({"way": "surfaces"}, "measured for geometry from surfaces, not from volume"),
])  # fmt: skip
def test_a_calibration_holds_only_for_what_it_was_measured_for(
    fit, plain, measured_for, packaged, change, says
):
    asked = replace(fit.settings, calibration=PACKAGE)
    write_calibration(packaged, a_calibration(measured_for.model_copy(update=change)))
    found = calibration_for(fit.case, asked)
    record = record_of_case(replace(fit, calibration=found))
    if not says:
        assert found.calibration is not None
        assert record.unknown(MODULI[0]).estimate != plain.unknown(MODULI[0]).estimate
        assert calibration_for(fit.case, replace(asked, calibration=str(packaged))) == found
        return
    # Of the package: the moduli stay as they are, and the verdict says why.
    assert found.calibration is None
    assert record.moduli == plain.moduli
    (failed,) = [one for one in record.verdict.failed_checks if one.check == "calibration"]
    assert failed.trust == DOUBTFUL
    assert says in failed.text
    # Given by name: it is an error, before anything is closed.
    named = replace(fit.settings, calibration=str(packaged))
    with pytest.raises(InputError, match=r"volume\.json: measured for"):
        calibration_for(fit.case, named)
    with pytest.MonkeyPatch.context() as patch:
        built = use(patch)
        with pytest.raises(InputError, match="measured for"):
            personalise(fit.case, named)
        assert not any(model.calls for model in built)


def test_without_a_calibration_all_stays_as_it_was(fit, plain, packaged):
    asked = replace(fit.settings, calibration=PACKAGE)
    found = calibration_for(fit.case, asked)
    record = record_of_case(replace(fit, calibration=found))
    assert record.verdict == plain.verdict
    assert record.moduli == plain.moduli
    assert (
        record.detail_rows("calibration")[0]["why"]
        == "the package has none for geometry from volume"
    )
    assert calibration_for(fit.case, fit.settings) == FoundCalibration(case=found.case)
    unknown = replace(fit.case, arrival=None)
    assert calibration_for(unknown, asked) == FoundCalibration()
    with pytest.raises(InputError, match="by which way"):
        calibration_for(unknown, replace(asked, calibration="some.json"))


def test_a_file_is_read_back_and_refused_if_it_was_changed(tmp_path, measured_for):
    path = write_calibration(tmp_path / "one.json", a_calibration(measured_for))
    assert read_calibration(path) == a_calibration(measured_for)
    data = json.loads(path.read_text())
    assert data["measured_for"]["way"] == "volume"
    for key, value, says in (
        ("offset", [0.0, 0.0], "not what was written"),
        ("slope", [1.0], "slope has the shape"),
        ("covariance", (-np.eye(4)).tolist(), "negative variance"),
        ("offset", ["1", None], "offset"),
        ("format", "another", "format"),
    ):
        path.write_text(json.dumps(data | {key: value}))
        with pytest.raises(InputError, match=says):
            read_calibration(path)


def test_a_case_says_by_which_way_its_geometry_arrived(tmp_path, fit):
    place = write_case(tmp_path / "case", fit.case)
    assert read_case(place).arrival == fit.case.arrival
    text = (place / "case.yaml").read_text()
    (place / "case.yaml").write_text(text.replace("way: volume", "way: dream"))
    with pytest.raises(InputError, match=r"arrival\.way: found 'dream'; expected volume"):
        read_case(place)


def test_records_of_patients_make_a_calibration(measured_for):
    known = list(patients(np.random.default_rng(2), 200, measured_for))
    failed = known[0].model_copy(update={"status": "failed"})
    found = calibrate([failed, *known[1:]], {"E_f.anterior": (5.0, 1.0)})
    assert (found.simulated, found.patients, len(found.seeds)) == (200, 199, 199)
    assert found.measured_for == measured_for
    assert found.example == {"E_f.anterior": (5.0, 1.0)}
    np.testing.assert_allclose(found.offset, [0.0, 0.25], atol=0.04)
    np.testing.assert_allclose(found.slope, 1.0, atol=0.1)
    np.testing.assert_allclose(np.exp(found.log_spread), 1.0, atol=0.12)


def test_patients_who_make_no_calibration_are_refused(measured_for):
    known = list(patients(np.random.default_rng(2), 12, measured_for))
    with pytest.raises(InputError, match="9 estimates that may be stated, expected 10"):
        calibrate(known[:9])
    other = measured_for.model_copy(update={"made_by": "other"})
    mixed = [*known, *patients(np.random.default_rng(3), 1, other)]
    with pytest.raises(InputError, match="patient_0 and patient_0: measured for other detectors"):
        calibrate(mixed)
    bare = known[0].model_copy(update={"details": {}})
    with pytest.raises(InputError, match="no detail calibration"):
        calibrate([bare, *known])


def test_the_row_holds_what_is_uncalibrated(fit, plain, record):
    """A calibration made of calibrated records would start again from the plain estimates."""
    before, after = (one.detail_rows("calibration")[0] for one in (plain, record))
    for key in ("log_estimate", "log_covariance", "measured_for"):
        assert before[key] == after[key]
    assert before["measured_for"] == asdict(fit.case.arrival) | {
        "settings": settings_digest(fit.case, fit.settings)
    }
    expected = [np.log(plain.unknown(name).estimate / PRIOR[name]) for name in MODULI]
    np.testing.assert_allclose(before["log_estimate"], expected)
