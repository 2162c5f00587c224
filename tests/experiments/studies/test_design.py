"""The study of frames and pressures: what it records, and what its report makes of it."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.common.schema import build
from experiments.common.study import Job
from experiments.studies.design import study
from experiments.studies.design.findings import Findings, Left, Tried
from experiments.studies.design.report import (
    design_answer,
    design_table,
    design_words,
    write_design,
)
from experiments.studies.design.settings import Corner, FramesSettings, Settings
from mvest.errors import ConfigurationError
from mvest.personalisation.design import ERRORS_MMHG, KINDS
from mvest.simulation.virtual_patient import Hidden, VirtualPatient
from tests.experiments.configured import composed, plain
from tests.experiments.studies.made_up import made_up as made_record
from tests.made_up_closure import MESH, TRUE, made_up_case, use
from tests.personalisation.test_fitted_frames import with_fitted


def job(folder, *overrides):
    values = plain(
        composed("experiment=design", "frames.geometry=null", "personal.errors=null", *overrides)
    )
    own = {name: values[name] for name in ("patient", "personal", "frames")}
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
        return VirtualPatient(frames, Hidden({**values, **TRUE}, {}))

    monkeypatch.setattr(study, "simulate_patient", simulate)
    monkeypatch.setattr(study, "build_coarse", lambda *_: type("M", (), {"mesh": MESH}))
    return seen


def test_all_designs_are_recorded_and_some_are_tried(made_up, tmp_path):
    outcome = study.run_design(job(tmp_path))
    found = outcome.findings
    assert found.moduli == ("E_f.anterior", "E_f.posterior")
    assert found.pressures_mmHg == (120.0, 105.0, 90.0, 75.0, 60.0)
    plain_rows = [row for row in found.left if row.kind in KINDS]
    assert len(plain_rows) == len(KINDS) * len(ERRORS_MMHG) * 5
    assert {row.known for row in found.left} == {
        "", "the pressures", "the chordae", "the displacement",
    }  # fmt: skip
    corners = list(dict.fromkeys(row.corner for row in found.tried))
    assert corners[0] == "one frame"
    assert len(corners) == 4
    for row in found.tried:
        assert row.error == pytest.approx(row.error)
        assert row.generic == pytest.approx(
            np.log({"anterior": 6.23, "posterior": 2.09}[row.modulus[4:]] / TRUE[row.modulus])
            / found.prior_std[found.moduli.index(row.modulus)]
        )
    # The same valve in all designs, with pressures as well known as each of them says.
    values = [values for values, _ in made_up]
    assert len({v["E_f.anterior"] for v in values}) == 1
    z = [np.log(v["pressure_scale"]) for v in values]
    assert z[0] == pytest.approx(z[1]) == pytest.approx(5 * z[2]) == pytest.approx(z[3])
    assert len(made_up[3][1].fitted_frames) == 3


def test_a_design_that_is_none_of_the_table_is_refused(made_up, tmp_path):
    asked = job(tmp_path)
    odd = FramesSettings(corners={"odd": Corner(fitted_pressure_mmHg=(100.0,))})
    asked = replace(asked, settings=replace(asked.settings, frames=odd))
    with pytest.raises(ConfigurationError, match=r"expected those of the design of 2 frames: \[60"):
        study.run_design(asked)


def findings(left=lambda kind, mmhg, n: 0.1 + mmhg / 100 / n, tried=()):
    rows = [
        Left(False, kind, mmhg, n, "", (left(kind, mmhg, n),) * 2)
        for kind in KINDS
        for mmhg in ERRORS_MMHG
        for n in range(1, 6)
    ]
    rows += [Left(False, "stated", 0.0, n, "", (0.2, 0.2)) for n in range(1, 6)]
    names = ("E_f.anterior", "E_f.posterior")
    return Findings(
        moduli=names, prior_std=(0.5, 0.5), pressures_mmHg=(120.0,) * 5, left=tuple(rows),
        tried=tried,
    )  # fmt: skip


def test_the_report_has_medians_over_patients_and_every_trial(tmp_path):
    tried = (
        Tried("one frame", "E_f.anterior", 0.25, 0.3, -0.2, 0.9, "converged"),
        Tried("one frame", "E_f.posterior", 0.25, 0.3, 0.4, -0.1, "converged"),
        Tried("none", "E_f.anterior", 0.2, None, None, 0.9, "no equilibrium"),
    )
    records = {
        "a": made_record(findings(tried=tried), table="design"),
        "b": made_record(findings(lambda kind, mmhg, n: 0.3), table="design"),
        "c": made_record(
            findings(lambda kind, mmhg, n: 0.3 if kind == "factor" else 0.1), table="design"
        ),
    }
    table = design_table(records)
    assert len(table) == 3 * 80 * 2
    said = design_answer(records)
    assert "10 to 10 % with exact pressures" in said
    assert "30 to 30 % where a factor" in said
    words = design_words(records)
    assert "| one frame | r | anterior | 25 | 30 | -20 | 90 |" in words
    assert "| none | r | anterior | 20 | no estimate | no estimate | 90 |" in words
    # Root mean squares: sqrt((0.2² + 0.4²) / 2) = 0.316, sqrt((0.9² + 0.1²) / 2) = 0.640.
    assert "| one frame | 25 | 30 | 32 | 64 |" in words
    written = write_design(tmp_path, records, {})
    assert [path.suffix for path in written] == [".csv", ".md", ".png", ".pdf"]
