"""Designs of frames and pressures: they equal what an estimation from such frames expects."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.closure.frames import SCALE
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation import PressureErrors, design_case, expect_case, personalise
from mvest.personalisation.design import errors_of
from mvest.personalisation.geometry import GeometryModes, NuisanceGeometry
from mvest.personalisation.known import EXACTLY, REACH
from tests.made_up_closure import (
    FIELDS,
    PRESSURE,
    PRIORS,
    error_source,
    made_up_case,
    settings,
    shape,
    unknowns,
    use,
)

STATED = PressureErrors(offset_mmHg=4.0, each_mmHg=3.0)
CASE = made_up_case(std_mm=0.6, correlation_length_mm=10.0)


@pytest.fixture
def designs(monkeypatch):
    use(monkeypatch)
    return design_case(CASE, settings(pressures=STATED))


def test_a_design_is_what_an_estimation_of_these_frames_expects(designs):
    assert designs.pressures_mmHg == (100.0, 87.5, 75.0, 62.5, 50.0)
    assert designs.chosen(3) == (0, 2, 4)
    open_, closed, *_ = CASE.frames
    fitted = [
        replace(closed, name=f"{p:g}", role=Role.FITTED, time=closed.time + k, pressure_mmHg=p)
        for k, p in enumerate((75.0, 50.0), start=1)
    ]
    case = replace(CASE, frames=(open_, closed, *fitted))

    def log_std(unknown):
        return np.log(unknown["high"] / unknown["low"]) / (2 * REACH)

    std = designs.std(3)
    for unknown in expect_case(case, settings(pressures=STATED)).unknowns[:5]:
        assert std[unknown["name"]] == pytest.approx(log_std(unknown), rel=1e-6)
    # Known pressures are those of an estimation without errors of pressures.
    calibrated = [replace(u, std=0.02) if u.name == SCALE else u for u in unknowns()]
    known = expect_case(case, settings(*calibrated))
    left = designs.left(3, {"factor": 0.02, "offset": 0.0, "each": 0.0})
    for name, unknown in zip(left, known.unknowns, strict=False):
        assert left[name] == pytest.approx(log_std(unknown) / designs.knowledge[name], rel=1e-6)


def test_frames_determine_an_offset_of_the_pressures_but_no_factor(monkeypatch):
    # Without its loose part the formula depends on pressure over stiffness only.
    rigid = {**FIELDS, "loose": np.zeros_like(FIELDS["loose"])}
    monkeypatch.setattr("tests.made_up_closure.FIELDS", rigid)
    use(monkeypatch)
    sharp = replace(CASE, uncertainty=replace(CASE.uncertainty, std_mm=1e-3))
    found = design_case(sharp, settings(pressures=STATED))
    factor, offset = (
        found.left(5, errors_of(kind, 20.0, PRESSURE))["E_f.anterior"]
        for kind in ("factor", "offset")
    )
    # Two moduli, chordae and pressure have a common factor: 1 / sum of 1 / variance.
    prior = [found.knowledge[name] for name in ("E_f.anterior", "E_f.posterior", "chord_stiffness")]
    common = 1.0 / np.sqrt(sum(1.0 / std**2 for std in (*prior, 0.2)))
    assert factor == pytest.approx(common / prior[0], rel=0.02)
    assert offset < 0.2 * factor


def test_errors_of_the_geometry_are_common_to_all_frames(designs, monkeypatch):
    up = np.tile(np.ones_like(FIELDS["loose"]).reshape(-1, 1), (5, 1))
    source = error_source(up, GeometryModes("one", {"fibres": np.eye(1)}))
    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", lambda *_: (source,))
    wider = design_case(CASE, settings(pressures=STATED, nuisance_geometry=NuisanceGeometry()))
    assert [n for n in wider.names if n.startswith("geometry")] == ["geometry.0"]
    for count in (1, 5):
        own, other = designs.left(count), wider.left(count)
        assert all(other[name] >= own[name] for name in own)
    # All frames determine a common displacement.
    assert wider.std(5)["geometry.0"] < wider.std(1)["geometry.0"]


def test_a_valve_that_does_not_close_has_no_designs(monkeypatch):
    use(monkeypatch, fails_above=1.0)
    assert "no equilibrium" in design_case(CASE, settings(pressures=STATED))


@pytest.mark.parametrize("errors", [None, ErrorBeliefs()])
def test_intervals_are_those_of_an_estimate_of_the_generic_valve(monkeypatch, errors):
    use(monkeypatch)
    case = made_up_case(0.3, displaced=False)
    generic = shape({name: mean for name, (mean, _) in PRIORS.items()})
    frames = [replace(f, vertices=generic) if f.role is Role.CLOSED else f for f in case.frames]
    case = replace(case, frames=tuple(frames))
    expected = expect_case(case, settings(errors=errors))
    fit = personalise(case, settings())
    std = fit.result.filtered.transformed.std
    for k, unknown in enumerate(expected.unknowns):
        assert unknown["name"] == fit.result.parameters[k]
        high, low, generic = unknown["high"], unknown["low"], unknown["generic"]
        found = np.log(high / low) if generic > 0.0 else high - low
        if errors is None:
            assert found / (2 * REACH) == pytest.approx(std[k], rel=1e-4)
        assert unknown["low_before"] < low < generic < high < unknown["high_before"]
        assert 0.0 < unknown["width"] < 1.0
    assert sum(row["share"] for row in expected.shares) == pytest.approx(2.0)
    what = {row["what"].partition(", ")[2] for row in expected.narrower}
    assert what > {EXACTLY, "mean of 4 beats"}


def test_a_valve_that_does_not_close_has_a_reason(monkeypatch):
    use(monkeypatch, fails_above=1.0)
    expected = expect_case(made_up_case(0.3), settings())
    assert expected.unknowns == ()
    assert "no equilibrium" in expected.reason
