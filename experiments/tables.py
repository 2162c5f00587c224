"""Everything in ``results/`` from its records: ``python -m experiments.tables [FOLDER]``."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.common.cases.tables import write_patient_tables
from experiments.results.page import write_report
from experiments.studies.chord.report import write_chord
from experiments.studies.closure.report import write_closure_tables
from experiments.studies.cycle.report import write_cycle
from experiments.studies.donor.report import write_donor_tables
from experiments.studies.filters.report import write_filter_study
from experiments.studies.gate.report import write_gate_tables
from experiments.studies.identifiability.report import write_identifiability_study
from experiments.studies.imaging.report import write_imaging_study
from experiments.studies.imaging.tables import write_volume_tables
from experiments.studies.joint.report import write_joint
from experiments.studies.law.report import write_law_tables
from experiments.studies.models.report import write_models_tables
from experiments.studies.patch.report import write_patch
from experiments.studies.patient.population import write_population_tables
from experiments.studies.prediction.report import write_prediction_tables
from experiments.studies.twin.publish import RECORDS, regenerate
from experiments.sweeps.report import read_sweeps, write_sweep
from mvest.errors import MvestError

__all__ = ["main"]

OTHER_TABLES = {
    "gate": write_gate_tables,
    "closure": write_closure_tables,
    "joint": write_joint,
    "joint_open": write_joint,
    "cycle": write_cycle,
    "identifiability": write_identifiability_study,
    "filters": write_filter_study,
    "chord": write_chord,
    "patch": write_patch,
    "donor": write_donor_tables,
    "law": write_law_tables,
    "imaging": write_imaging_study,
    "prediction": write_prediction_tables,
    "volume": write_volume_tables,
    "models": write_models_tables,
}
"""Tables of studies with records of their own."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Regenerate the tables and figures; returns the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if len(given) > 1:
        print("error: expected at most one argument, the folder of the results", file=sys.stderr)
        return 2
    try:
        results = Path(given[0] if given else "results")
        sweeps = read_sweeps(results)
        # A folder that holds sweeps alone is complete; an empty one says what to run.
        single = (results / RECORDS).is_dir() or not sweeps
        written = regenerate(results) if single else []
        for name, write in OTHER_TABLES.items():
            record = results / f"{name}.json"
            if record.is_file():
                written += write(results, json.loads(record.read_text(encoding="utf-8")))
        written += write_patient_tables(results)
        written += write_population_tables(results)
        for sweep in sweeps:
            written += write_sweep(results, sweep)
        written.append(write_report(results))
        for path in written:
            print(path)
    except MvestError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
