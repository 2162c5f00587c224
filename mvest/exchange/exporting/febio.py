"""A case, or what was estimated of it, as input of FEBio (file format 4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvest.cases.case import ValveCase
from mvest.cases.folder import read_case
from mvest.closure.model import ClosureModel
from mvest.errors import InputError
from mvest.exchange.febio.valve import FebioOptions, differences, valve_document
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.problem.registration import REGISTRATION
from mvest.reading.documents import read_mapping
from mvest.valve.mesh.given import GivenValve

GENERIC = {
    "E_f": {"anterior": 6.23, "posterior": 2.09},
    "ratio": {"anterior": 6.23 / 2.35, "posterior": 2.09 / 1.89},
}
"""E_f (MPa) and E_f over E_perp of the method paper (ISBI 2013)."""
CONTACT_COLUMNS, CONTACT_ROWS = 144, 32
"""Points at which the valve is sampled for patches of chordae and the annulus."""
MAX_RECORD = 1 << 28
"""Bytes of a run's record that are read."""


def export_febio(source: Path, target: Path, options: FebioOptions) -> Path:
    """Write the closure of a case folder, or of the folder of a run of one, for FEBio.

    Run it with ``febio4 -i TARGET``. The positions of all nodes at every step are then in
    ``TARGET_positions.csv``, and all else in FEBio's own plot file. What is not the same in FEBio
    stands at the head of the file.

    Raises
    ------
    InputError, GeometryError, MaterialError
        If the source is not such a folder, or the valve cannot be meshed or has no counterpart.
    """
    if target.suffix.lower() != ".feb":
        raise InputError(f"{target}: expected a name that ends in .feb")
    values: dict[str, float] = {}
    tissue: dict[str, TissueSettings] = {}
    if (source / "result.json").is_file():
        folder, values, tissue = read_run(source)
        place = Path(options.case or folder)
        if not place.is_dir():
            raise InputError(f"{source}: its case is not at {str(place)!r}; give case=FOLDER")
        source = place
    case = read_case(source)
    model = model_of_case(case, options, values, tissue)
    document = valve_document(model, np.zeros(0), options)
    head = f"{case.name}: closure under {model.settings.protocol.pressure_mmHg:g} mmHg."
    return document.write(target, [head, *differences(model, options)])


def read_run(folder: Path) -> tuple[str, dict[str, float], dict[str, TissueSettings]]:
    """What the run of a case left: the folder of the case, its parameters and its tissue.

    Returns
    -------
    case : str
    values : dict
        Parameter -> estimate, or what it was held at.
    tissue : dict
        Region -> its tissue.

    Raises
    ------
    InputError
        If it is no such run.
    """
    record = folder / "result.json"
    try:
        found = read_mapping(record, MAX_RECORD)["findings"]["case"]
        values = {
            str(row["name"]): float(
                row["prior_mean"] if row["estimate"] is None else row["estimate"]
            )
            for row in found["unknowns"]
            if row["name"] not in REGISTRATION
        }
        tissue = {
            str(name): TissueSettings(float(own["ratio"]), float(own["nu"]), str(own["reading"]))
            for name, own in found["settings"]["mechanics"]["tissue"].items()
        }
        case = read_mapping(folder / "config.json", MAX_RECORD)["case"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{record}: no run that estimated a case") from error
    return str(case), values, tissue


def model_of_case(
    case: ValveCase,
    options: FebioOptions,
    values: Mapping[str, float],
    tissue: Mapping[str, TissueSettings],
) -> ClosureModel:
    """The closure of a case with everything at its value: nothing in it is a parameter.

    Parameters
    ----------
    case : ValveCase
    options : FebioOptions
        What they state goes before ``values`` and ``tissue``.
    values : mapping
        Parameter -> value.
    tissue : mapping
        Region -> its tissue.
    """
    names = case.surface.region_names
    unlike = [name for name in values if name.startswith(("stiffening.", "prestretch."))]
    if unlike:
        raise InputError(
            f"{', '.join(unlike)}: the file has no law for such tissue; export a run without it"
        )
    # What has another part is an error of a frame's pressure.
    kinds = ("E_f", "G", "ratio", "chord_stiffness", "chord_rest_length")
    fixed = {name: values[name] for name in values if name.partition(".")[0] in kinds
             or "." not in name}  # fmt: skip
    estimated = {
        "E_f": {name.removeprefix("E_f."): fixed[name] for name in fixed},
        "ratio": {name: own.ratio for name, own in tissue.items()},
    }
    chosen: dict[str, dict[str, float]] = {}
    for what, given in (("E_f", options.E_f), ("ratio", options.ratio)):
        if given is not None and len(given) != len(names):
            raise InputError(
                f"{what}: {len(given)} values, expected one of each of {', '.join(names)}"
            )
        stated = {} if given is None else dict(zip(names, given, strict=True))
        chosen[what] = GENERIC[what] | estimated[what] | stated
        if missing := [name for name in names if name not in chosen[what]]:
            raise InputError(f"no {what} of leaflet {missing[0]!r}; give {what}=[...]")
    fixed |= {f"E_f.{name}": chosen["E_f"][name] for name in names}
    usual = TissueSettings(1.0, options.nu, options.reading)
    settings = {
        name: replace(tissue.get(name, usual), ratio=chosen["ratio"][name]) for name in names
    }
    pressure = options.pressure_mmHg
    if pressure is None:
        if case.closed is None:
            raise InputError(f"case {case.name}: no closed frame; give pressure_mmHg=...")
        pressure = case.closed.pressure_mmHg
    valve = GivenValve(case.valve)
    if options.mesh == "structured":
        mesh = valve.layers("hex18", options.columns, options.rows)
    else:
        mesh = valve.tetrahedra(options.edge_length, "tet10", None)
    contact = valve.valve(CONTACT_COLUMNS, CONTACT_ROWS)
    mechanics = MechanicsSettings(settings, ClosureProtocol(pressure_mmHg=pressure))
    return ClosureModel(case.valve, contact, mesh, mechanics, (), fixed)
