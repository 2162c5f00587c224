"""What MLflow would be given of a job's folder: found out without a store, which takes seconds."""

from pathlib import Path

from experiments.common.records.record import read_record
from experiments.runner.collecting import comparison
from mvest.reading.documents import read_mapping


def logged(folder: Path) -> dict[str, float]:
    """The metrics of a run at its last step; its settings must be there, too."""
    record = read_record(folder / "result.json")
    config = read_mapping(folder / "config.json")
    assert comparison.parameters(config, record.parameters)
    return {name: value for name, value, _ in comparison.metrics(record)}
