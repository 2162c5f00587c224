"""The calibrations of the package, which detectors and estimator may not outlive.

A calibration holds the uncalibrated estimate of the example volume at its time. It must be that of
``golden.json``: whoever renews that number, because the estimator is another one, must simulate the
patients again (``experiment=volumes_calibration``) and ship what they give::

    python -m tests.test_shipped_calibration
"""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.common.cases.own_case import PersonalSettings, settings_of
from experiments.common.config import plain
from experiments.common.schema import build
from experiments.results.calibrated import calibration_of
from mvest.imaging.detection.trained_model import default_model
from mvest.personalisation.calibration import (
    CALIBRATIONS,
    Calibration,
    read_calibration,
    settings_digest,
    write_calibration,
)
from mvest.personalisation.settings import PACKAGE, default_settings
from tests.experiments.configured import composed
from tests.places import ROOT
from tests.test_golden import GOLDEN, TOLERANCE

SHIPPED = sorted(CALIBRATIONS.glob("*.json"))
TABLES = {"volume": "volume_calibration"}
"""Way of a geometry -> published records that it is calibrated with."""
GUARDS = {"volume": "volume"}
"""Way of a geometry -> a run of ``golden.json``."""


def example(way: str) -> dict[str, tuple[float, ...]]:
    """The uncalibrated numbers of ``golden.json``."""
    values = json.loads(GOLDEN.read_text(encoding="utf-8"))[GUARDS[way]]["values"]
    found = values.get("uncalibrated", values["estimate"])
    return {name: tuple(pair) for name, pair in found.items()}


def changed(calibration: Calibration, now: dict[str, tuple[float, ...]]) -> list[str]:
    """The moduli whose estimate or standard deviation is not what it was."""
    return [
        name
        for name in calibration.parameters
        for was, found in zip(calibration.example[name], now[name], strict=True)
        if abs(found - was) > TOLERANCE * abs(was)
    ]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_shipped_calibration_is_that_of_this_estimator(path: Path) -> None:
    found = read_calibration(path)
    assert found.measured_for.way == path.stem
    assert changed(found, example(path.stem)) == [], "simulate the patients of the calibration anew"
    if path.stem == "volume":
        assert found.measured_for.made_by == default_model().digest


def test_another_estimate_of_the_example_is_seen() -> None:
    now = {"E_f.anterior": (5.0, 1.0), "E_f.posterior": (2.0, 0.4)}
    known = Calibration.model_construct(parameters=tuple(now), example=now)
    assert changed(known, now) == []
    assert changed(known, now | {"E_f.posterior": (2.0, 0.41)}) == ["E_f.posterior"]
    assert changed(known, now | {"E_f.anterior": (5.00001, 1.0)}) == ["E_f.anterior"]


def test_patients_are_estimated_as_volumes_of_users_are() -> None:
    """Otherwise no volume would have the digest that the calibration is for."""
    case = SimpleNamespace(error_samples=range(200))
    used = [default_settings(case)]
    for name in ("volume", "volumes", "volumes_calibration"):
        values = plain(composed(f"experiment={name}"))
        used.append(settings_of(values, build(PersonalSettings, values["personal"])))
    assert len({settings_digest(case, one) for one in used}) == 1
    assert [one.calibration for one in used] == [PACKAGE, PACKAGE, PACKAGE, None]


def ship() -> None:
    """Write every calibration of the package again, from ``results/``."""
    CALIBRATIONS.mkdir(exist_ok=True)
    for way, table in TABLES.items():
        known = calibration_of(ROOT / "results", table)
        now = {name: example(way)[name] for name in known.parameters}
        path = CALIBRATIONS / f"{way}.json"
        print(write_calibration(path, known.model_copy(update={"example": now})))


if __name__ == "__main__":
    ship()
