"""A case from its folder to its moduli, its record and its report."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import mechanics_of
from experiments.common.cases.record import case_record, fields_of
from experiments.common.cases.settings import PersonalSettings
from experiments.common.progress import SolveBar
from experiments.common.schema import build
from mvest.cases.case import ValveCase
from mvest.cases.folder import read_case
from mvest.errors import ConfigurationError
from mvest.personalise.chain import personalise_case
from mvest.personalise.settings import PersonaliseSettings, Treatment, Unknown
from mvest.problem.registration import REGISTRATION

__all__ = [
    "read_configured",
    "run_case",
    "settings_of",
]

Values = Mapping[str, Any]

TYPICAL_SOLVES = 8
"""Forward solves of one case; only the progress bar's first guess."""


def settings_of(config: Values) -> PersonaliseSettings:
    """How the configuration wants a case to be personalised.

    Raises
    ------
    MvestError
        If a setting is inadmissible.
    """
    personal = build(PersonalSettings, config["personal"])
    known = [treatment.value for treatment in Treatment]
    unknowns = []
    for name, about in personal.unknowns.items():
        if about.treatment not in known:
            raise ConfigurationError(
                f"personal.unknowns.{name}.treatment = {about.treatment!r}, expected one of "
                f"{', '.join(known)}"
            )
        unknowns.append(Unknown(name, about.mean, about.std, Treatment(about.treatment)))
    return PersonaliseSettings(
        tuple(unknowns),
        mechanics_of(config),
        personal.mesh,
        personal.tolerance,
        personal.max_iterations,
        personal.largest_change,
        personal.paper,
        personal.moduli_only,
        personal.confirm,
        personal.correspondence,
    )


def read_configured(config: Values) -> ValveCase:
    """The case that the configuration names."""
    if config["case"] is None:
        raise ConfigurationError(
            "case is not given; expected case=FOLDER, a folder with case.yaml; "
            "mvest/cases/README.md says what it holds"
        )
    return read_case(Path(config["case"]))


def run_case(
    config: Values,
    config_hash: str,
    folder: Path,
    started: float,
    about: Values | None = None,
) -> tuple[dict[str, Any], list[Path]]:
    """Read a case and personalise it: its record; fields and report are written.

    ``about`` is added to the record, before the report is.
    """
    from mvest.reporting.case.report import write_case_report

    fields = folder / "fields.npz"
    # Of an earlier run: there are none where no estimate is reached now.
    fields.unlink(missing_ok=True)
    case = read_configured(config)
    for sentence in case.derived:
        print(f"derived: {sentence}", file=sys.stderr)
    settings = settings_of(config)
    steps = len(settings.mechanics.protocol.steps())
    store = Path(config["paths"]["outputs"]) / "meshes"
    free = [u.name for u in settings.unknowns if u.treatment is not Treatment.FIXED]
    # As they are estimated: those of the closure first.
    names = sorted(free, key=lambda name: name in REGISTRATION)
    with SolveBar(case.name, steps, TYPICAL_SOLVES, names) as bar:
        personalised = personalise_case(
            case, settings, store=store, on_step=bar.step, on_iterate=bar.iterate
        )
    record = {**case_record(config, personalised, config_hash, started), **(about or {})}
    files: list[Path] = []
    if personalised.distances:
        np.savez_compressed(fields, **fields_of(personalised))
        files.append(fields)
        if config["figures"]:
            files += write_case_report(folder, {**record, "parameters": record["unknowns"]}, fields)
    return record, files
