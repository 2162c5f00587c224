"""What MLflow would be given of a job's folder: found out without a store, which takes seconds."""

import json
from pathlib import Path

from experiments.common.plain import flat
from experiments.runner import comparison


def logged(folder: Path) -> dict[str, float]:
    """The metrics of a run at its last step; its settings and inputs must be there, too."""
    record = flat(json.loads((folder / "result.json").read_text()))
    config = json.loads((folder / "config.json").read_text())
    assert comparison.parameters(config, record)
    json.dumps(comparison.inputs(config, record))
    return {name: value for name, value, _ in comparison.metrics(record)}
