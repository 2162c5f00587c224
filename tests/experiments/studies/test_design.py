"""Designs of a patient's frames and pressures: expected intervals, and estimates for some."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.common.schema import build
from experiments.common.study import Job
from experiments.studies import design
from experiments.studies.design import Settings
from mvest.personalisation.design import ERRORS_MMHG, KINDS
from mvest.simulation.virtual_patient import VirtualPatient
from tests.experiments.configured import composed, plain
from tests.made_up_closure import MESH, TRUE, made_up_case, use
from tests.personalisation.test_fitted_frames import with_fitted

MODULI = ("E_f.anterior", "E_f.posterior")


def job(folder, *overrides):
    values = plain(
        composed("experiment=design", "frames.geometry=null", "personal.errors=null", *overrides)
    )
    own = {name: values[name] for name in ("designs", "patient", "personal", "frames")}
    return Job(values, build(Settings, own), folder)


@pytest.fixture
def made_up(monkeypatch):
    """Patients are the formula; their frames are as a design has them."""
    use(monkeypatch)
    seen = []

    def simulate(name, description, template, values, simulation, mechanics, rng):
        seen.append((values, simulation))
        case = made_up_case(std_mm=0.3, noise=rng)
        pressures = {f"at {p:g}": (p, p) for p in simulation.fitted_pressure_mmHg}
        frames = with_fitted(case, **pressures, closed=(120.0, 120.0)) if pressures else case
        frames = replace(
            frames,
            frames=tuple(replace(f, pressure_mmHg=120.0) if f.name == "closed" else f
                         for f in frames.frames),
        )  # fmt: skip
        return VirtualPatient(frames, {**values, **TRUE}, {})

    monkeypatch.setattr(design, "simulate_patient", simulate)
    monkeypatch.setattr(design, "build_coarse", lambda *_: type("M", (), {"mesh": MESH}))
    return seen


def test_all_designs_are_recorded_and_some_are_tried(made_up, tmp_path):
    result = design.run(job(tmp_path))
    left = result.table_of().rows
    assert {row["modulus"] for row in left} == set(MODULI)
    plain_rows = [row for row in left if row["errors"] in KINDS]
    assert len(plain_rows) == len(KINDS) * len(ERRORS_MMHG) * 5 * 2
    assert {row["known"] for row in left} == {
        "", "the pressures", "the chordae", "the displacement",
    }  # fmt: skip
    tried = result.table_of("tried").rows
    corners = list(dict.fromkeys(row["design"] for row in tried))
    assert corners[0] == "one frame"
    assert [one.case for one in result.estimates] == corners
    assert len(corners) == 4
    for row, estimate in zip(tried[::2], result.estimates, strict=True):
        own = estimate.unknown(row["modulus"])
        assert own.truth == TRUE[row["modulus"]]
        # In percent of the prior's standard deviation of the logarithm.
        ratio = np.log(own.estimate / own.truth) / np.log(own.prior_mean / own.truth)
        assert row["error"] / row["generic"] == pytest.approx(ratio)
        off = 100 * np.log(own.prior_mean / own.truth) / (own.prior_std / own.prior_mean)
        assert row["generic"] == pytest.approx(off, rel=0.01)
        assert row["reported"] / row["error"] == pytest.approx(
            own.std / own.estimate / np.log(own.estimate / own.truth)
        )
    # The same valve in all designs, with pressures as well known as each of them says.
    values = [values for values, _ in made_up]
    assert len({v["E_f.anterior"] for v in values}) == 1
    z = [np.log(v["pressure_scale"]) for v in values]
    assert z[0] == pytest.approx(z[1]) == pytest.approx(5 * z[2]) == pytest.approx(z[3])
    assert made_up[3][1].fitted_pressure_mmHg == (90.0, 60.0)
