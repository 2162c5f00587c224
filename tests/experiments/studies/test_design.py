"""Designs of a patient's frames and pressures: what is recorded, and what readers see of it."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.common.schema import build
from experiments.common.study import Job, Results
from experiments.studies import design
from experiments.studies.design import STUDY, TRIED, Settings
from mvest.personalisation.design import ERRORS_MMHG, KINDS
from mvest.reporting.tables import table
from mvest.simulation.virtual_patient import VirtualPatient
from tests.experiments.configured import composed, plain
from tests.experiments.studies.made_up import made_up as made_record
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


def record(row, left, tried=()):
    rows = [
        {"geometry": "exact", "errors": kind, "error": mmhg, "known": "", "frames": n,
         "modulus": modulus, "left": left(kind, mmhg, n)}
        for kind in KINDS for mmhg in ERRORS_MMHG for n in range(1, 6) for modulus in MODULI
    ]  # fmt: skip
    tables = {"": table(rows).plain()}
    if tried:
        names = [*TRIED, "reason"]
        tables["tried"] = table([dict(zip(names, row, strict=True)) for row in tried]).plain()
    return made_record(study="design", table="design", row=row, tables=tables)


def test_readers_see_medians_over_patients_and_root_mean_squares():
    tried = (
        ("one frame", "E_f.anterior", 25.0, 30.0, -20.0, 90.0, "converged"),
        ("one frame", "E_f.posterior", 25.0, 30.0, 40.0, -10.0, "converged"),
        ("none", "E_f.anterior", 20.0, None, None, 90.0, "no equilibrium"),
    )
    results = Results(
        {
            "a": record("a", lambda kind, mmhg, n: 10 + mmhg / n, tried),
            "b": record("b", lambda kind, mmhg, n: 30.0),
            "c": record("c", lambda kind, mmhg, n: 30.0 if kind == "factor" else 10.0),
        }
    )
    assert STUDY.summary is not None
    shown = STUDY.summary(results)
    rows = {(row["errors"], row["error"]): row for row in shown["median_left"].rows}
    assert [rows["factor", 20.0][f"{n} closed"] for n in (1, 5)] == [30.0, 30.0]
    # Of 30, 30 and 10; of 14, 30 and 10.
    assert [rows["offset", 20.0][f"{n} closed"] for n in (1, 5)] == [30.0, 14.0]
    # Root mean squares: sqrt((20² + 40²) / 2) = 31.6, sqrt((90² + 10²) / 2) = 64.0.
    (rms,) = shown["root_mean_squares"].rows
    assert rms["error"] == pytest.approx(np.sqrt(1000))
    assert rms["generic"] == pytest.approx(np.sqrt(4100))
