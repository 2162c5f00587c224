"""A case from its folder to its moduli."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.closure import mechanics_of, mesh_store
from experiments.common.cases.findings import Findings, fields_of, outcome_of_case
from experiments.common.cases.settings import PersonalSettings
from experiments.common.expectation import noise_words
from experiments.common.progress import SolveBar
from experiments.common.records.record import NOT_GATED, Outcome
from experiments.common.schema import build
from mvest.cases.case import ValveCase
from mvest.cases.folder import read_case
from mvest.cases.plausibility import doubts
from mvest.errors import ConfigurationError
from mvest.mechanics.settings import ExponentialTissue, MechanicsSettings
from mvest.personalisation.chain import personalise_case
from mvest.personalisation.design import design_case, design_text, expect_case
from mvest.personalisation.model import build_model, with_pressures
from mvest.personalisation.settings import PersonaliseSettings, Treatment, Unknown
from mvest.problem.registration import REGISTRATION
from mvest.reporting.case.findings import ImageStep
from mvest.reporting.expectation import expectation_text

__all__ = ["FIELDS", "expect_own", "read_configured", "run_case", "settings_of"]

Values = Mapping[str, Any]

FIELDS = "fields.npz"
"""Arrays of the report, in the folder of a run."""

STIFFENS = "stiffening."
"""How the unknowns begin that say how far a leaflet's tissue stiffens."""

TYPICAL_SOLVES = 8
"""Forward solves of one case; only the progress bar's first guess."""


def settings_of(values: Values, personal: PersonalSettings) -> PersonaliseSettings:
    """How the configuration wants a case to be personalised.

    Raises
    ------
    MvestError
        If a setting is inadmissible.
    """
    known = [treatment.value for treatment in Treatment]
    unknowns = []
    for name, about in personal.unknowns.items():
        if about.treatment not in known:
            raise ConfigurationError(
                f"personal.unknowns.{name}.treatment = {about.treatment!r}, expected one of "
                f"{', '.join(known)}"
            )
        unknowns.append(Unknown(name, about.mean, about.std, Treatment(about.treatment)))
    stiffens = {name.partition(".")[2] for name in personal.unknowns if name.startswith(STIFFENS)}
    curves = personal.considered_law
    return PersonaliseSettings(
        tuple(unknowns),
        _stiffening(mechanics_of(values), {r: curves.get(r) for r in sorted(stiffens)}),
        personal.mesh,
        personal.tolerance,
        personal.max_iterations,
        personal.largest_change,
        personal.paper,
        personal.moduli_only,
        personal.confirm,
        personal.correspondence,
        personal.errors,
        considered_geometry=personal.considered_geometry,
        considered_law={r: curve for r, curve in curves.items() if r not in stiffens},
        pressures=personal.pressures,
    )


def _stiffening(
    mechanics: MechanicsSettings, curves: Mapping[str, ExponentialTissue | None]
) -> MechanicsSettings:
    """The mechanics where linear tissue of some leaflets is on its way to a curve.

    Raises
    ------
    ConfigurationError
        If there is no such leaflet or no curve, or its tissue follows another law.
    """
    tissue = dict(mechanics.tissue)
    for region, curve in curves.items():
        unknown = f"personal.unknowns.{STIFFENS}{region}"
        if region not in tissue or tissue[region].law != "biot":
            own = f"follows the {tissue[region].law} law" if region in tissue else "has no tissue"
            raise ConfigurationError(f"{unknown}: {region} {own}, expected the linear one (biot)")
        if curve is None:
            raise ConfigurationError(
                f"{unknown}: personal.considered_law.{region} is missing, the law that the tissue "
                "is on its way to"
            )
        tissue[region] = replace(tissue[region], law="stiffening", exponential=curve)
    return replace(mechanics, tissue=tissue)


def read_configured(place: str | None) -> ValveCase:
    """The case that a configuration names."""
    if place is None:
        raise ConfigurationError(
            "case is not given; expected case=FOLDER, a folder with case.yaml; "
            "mvest/cases/README.md says what it holds"
        )
    return read_case(Path(place))


def expect_own(values: Values, _folder: Path | None = None) -> str:
    """What ``check=true`` says of a case: the answer of the Fisher information.

    Raises
    ------
    MvestError
        If the case is not in order.
    """
    case = read_configured(values["case"])
    if case.closed is None:
        return f"{case.name}: an open frame alone, from which nothing can be estimated"
    settings = settings_of(values, build(PersonalSettings, values["personal"]))
    model = build_model(case, settings, mesh_store(values))
    with SolveBar(case.name, len(settings.mechanics.protocol.steps()), 1) as bar:
        model.on_step = bar.step
        expected = expect_case(case, settings, model)
        designs = design_case(case, settings, model)
    stated = case.uncertainty
    noise = noise_words("stated", [stated.typical_mm], stated.correlation_length_mm)
    further = (
        f"{case.name}: what further closed frames would tell is not known ({designs})"
        if isinstance(designs, str)
        else design_text(case.name, designs)
    )
    return f"{expectation_text(case.name, expected, noise)}\n{further}"


def run_case(
    values: Values,
    personal: PersonalSettings,
    case: ValveCase,
    folder: Path,
    image_step: ImageStep | None = None,
    gate: str = NOT_GATED,
) -> Outcome[Findings]:
    """Personalise a case, of whose anatomy the gate said so; its arrays go to ``folder``."""
    fields = folder / FIELDS
    # Of an earlier run: there are none where no estimate is reached now.
    fields.unlink(missing_ok=True)
    for sentence in case.derived:
        print(f"derived: {sentence}", file=sys.stderr)
    for doubt in doubts(case):
        print(f"doubtful: {doubt}", file=sys.stderr)
    settings = with_pressures(case, settings_of(values, personal))
    steps = len(settings.mechanics.protocol.steps())
    free = [u.name for u in settings.unknowns if u.treatment is not Treatment.FIXED]
    # As they are estimated: those of the closure first.
    names = sorted(free, key=lambda name: name in REGISTRATION)
    with SolveBar(case.name, steps, TYPICAL_SOLVES, names) as bar:
        fit = personalise_case(
            case, settings, store=mesh_store(values), on_step=bar.step, on_iterate=bar.iterate
        )
    if fit.distances:
        np.savez_compressed(fields, **fields_of(fit))
    shown = {key: dict(values[key]) for key in ("personal", "mechanics")}
    return outcome_of_case(fit, shown, image_step, gate)
