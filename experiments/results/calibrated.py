"""``mvest calibrate``: the calibration that published virtual patients give, as a file."""

from pathlib import Path

from experiments.results.published import records_of
from mvest.personalisation.calibration import Calibration, calibrate, write_calibration


def calibration_of(results: Path, table: str) -> Calibration:
    """The calibration of a table of published records; an `InputError` says why there is none."""
    records = records_of(results, table).records.values()
    return calibrate([one for record in records for one in record.estimates])


def calibrate_command(results: Path, table: str, target: Path) -> list[Path]:
    """Write the calibration of a table of published records, for ``personal.calibration=FILE``."""
    return [write_calibration(target, calibration_of(results, table))]
