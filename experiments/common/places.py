"""Where things lie, in a checkout and in an installation."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent.parent

CHECKOUT = _PACKAGE.parent
"""Where ``examples`` and ``results`` lie in a checkout; an installation has neither."""

CONF = next(
    (place for place in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if place.is_dir()),
    _PACKAGE / "conf",
)
"""Hydra's configuration: in the package as it is installed, beside it in a checkout."""

EXPERIMENTS = CONF / "experiment"  # one YAML file an experiment

GATE_RECORDS = CHECKOUT / "results" / "records" / "gate.jsonl"
"""Kept records of the gate in a checkout; an installation has none."""
