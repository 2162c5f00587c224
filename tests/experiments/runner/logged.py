"""What MLflow would be given of a job's folder: found out without a store, which takes seconds."""

import json
from pathlib import Path

from experiments.runner.collecting import comparison
from experiments.runner.jobs.compared import compared
from mvest.reading.json_file import read_mapping


def logged(folder: Path) -> dict[str, float]:
    """The metrics of a run at its last step; its settings and inputs must be there, too."""
    record = compared(read_mapping(folder / "result.json"), str(folder))
    config = read_mapping(folder / "config.json")
    assert comparison.parameters(config, record.parameters)
    json.dumps(comparison.inputs(config, record))
    return {name: value for name, value, _ in comparison.metrics(record)}
