"""What a virtual patient leaves: its published record, true strains, and the size of its errors.

Tables for readers are those of `tests.experiments.studies.test_published_tables`.
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from experiments.common.records.record import Record
from experiments.results.published import publish, records_of
from experiments.studies.patient import study
from experiments.studies.patient.study import KEPT_ARRAYS, STUDY
from mvest.cases.case import Role
from mvest.problem.record import EstimateRecord, FrameFit, Spread, Unknown
from tests.experiments.studies.made_up import made_up
from tests.experiments.studies.made_up_patients import moduli
from tests.made_up_closure import made_up_case
from tests.reporting.case.made_up_case import arrays


def distances(frame: str, seen: bool, generic: float, registered: float, own: float) -> FrameFit:
    """Distances of these means, and of half of them from the truth."""
    means = {"generic": generic, "registered": registered, "personalised": own}
    off = {name: Spread(mean=mean, std=0.1, max=3 * mean) for name, mean in means.items()}
    true = {f"{n}_to_truth": Spread(mean=m / 2, std=0.1, max=1.5 * m) for n, m in means.items()}
    return FrameFit(frame=frame, seen=seen, **off, **true)


def patient(name: str = "normal_small") -> Record:
    """A patient whose moduli were estimated with and without nuisances."""
    estimate = EstimateRecord(
        case=name,
        simulated=True,
        status="converged",
        reason="converged",
        unknowns=moduli(5.8, 2.1),
        alternatives={
            key: EstimateRecord(status="converged", reason="converged", unknowns=moduli(5.7, 3.1))
            for key in ("moduli_only", "paper")
        },
        frames=(distances("closed", True, 2.0, 1.5, 0.5), distances("late", False, 1.0, 0.4, 0.8)),
        details={"measurements": ({"frame": "open", "annulus_area_mm2": 800.0},)},
    )
    numbers = {"scenario": "reference", "nees": 1.0, "unknowns": 2}
    numbers |= {"paper_generic_mm": 1.5, "paper_personalised_mm": 1.47}
    return made_up(
        study="patient", experiment="patients", table="patients", row=name, numbers=numbers,
        status="converged", reason="converged", estimates=(estimate,),
    )  # fmt: skip


def test_publishing_keeps_a_patient_and_writes_the_tables_again(tmp_path, monkeypatch):
    monkeypatch.setattr("mvest.reporting.figures.DPI", 20)
    folder = tmp_path / "run"
    folder.mkdir()
    stored = arrays(np.random.default_rng(1))
    known = {k: np.nan_to_num(v, nan=1.0) for k, v in stored.items() if k.startswith("distance")}
    np.savez(folder / "fields.npz", **stored | known)
    written = publish(STUDY, tmp_path, "patients", {"patients-normal-small": (patient(), folder)})
    names = {path.name for path in written}
    # The paper has Tables 2 and 3.
    printed = {"patients_table_2.tex", "patients_table_3.tex", "patients_figure_3.pdf"}
    assert {*printed, "patients_table_2.csv", "patients_distances.csv", "patients.md"} <= names
    kept = records_of(tmp_path, "patients")
    assert kept is not None
    (estimate,) = kept.first.estimates
    assert estimate.unknowns == patient().estimates[0].unknowns
    assert not estimate.details
    with np.load(tmp_path / "records" / "patients" / "patients-normal-small.npz") as found:
        assert set(found.files) <= set(KEPT_ARRAYS)
    publish(STUDY, tmp_path, "patients", {"patients-prolapse": (patient("prolapse"), folder)})
    assert "prolapse" in (tmp_path / "patients_table_2.csv").read_text()


RATIO, STRAIN = "ratio of E_f anterior to posterior", "strain of the {} leaflet {} its fibres"
STRAINS = [STRAIN.format(*two) for two in product(("anterior", "posterior"), ("along", "across"))]


def test_true_strains_are_those_of_the_true_valve():
    case = made_up_case(0.02)
    rest, seen = case.surface.vertices, case.frame(Role.CLOSED)
    closed = [replace(f, vertices=1.2 * rest) if f is seen else f for f in case.frames]
    known = tuple({"name": name, "generic": 2.5} for name in (RATIO, *STRAINS))
    estimate = patient().estimates[0].model_copy(update={"details": {"known": known}})
    numbers = study._true_quantities(
        estimate, replace(case, frames=tuple(closed)), {seen.name: 1.1 * rest}
    )
    assert (numbers[f"true {RATIO}"], numbers[f"else {RATIO}"]) == pytest.approx((3.0, 2.5))
    for name in STRAINS:
        assert (numbers[f"true {name}"], numbers[f"else {name}"]) == pytest.approx((10.0, 20.0))


@pytest.mark.parametrize(
    ("z", "correlation", "nees"), [((1, 2.5), 0.0, 3.625), ((1, 1), 0.5, 2 / 3)]
)
def test_errors_are_measured_in_the_posterior_s_covariance(z, correlation, nees):
    # z^T C^-1 z / 2: (1 + 6.25) / 2, and with C^-1 = 4/3 (1, -1/2; -1/2, 1) two thirds.
    sd, reach = 0.1, np.exp(1.959964 * 0.1)
    unknowns = []
    for leaflet, off in zip(("anterior", "posterior"), z, strict=True):
        x = float(5.0 * np.exp(-off * sd))
        unknowns.append(
            Unknown(
                name=f"E_f.{leaflet}", unit="MPa", prior_mean=6.0, prior_std=3.0, estimate=x,
                std=sd * x, low=x / reach, high=x * reach, truth=5.0,
            )
        )  # fmt: skip
    estimate = EstimateRecord(
        status="converged",
        reason="converged",
        unknowns=tuple(unknowns),
        correlation=((1.0, correlation), (correlation, 1.0)),
    )
    assert study._nees(estimate) == pytest.approx(nees, rel=1e-5)
