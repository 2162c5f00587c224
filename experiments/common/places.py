"""Where things lie, in a checkout and in an installation."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent.parent

# With ``examples`` and ``results`` in a checkout; an installation has neither.
CHECKOUT = _PACKAGE.parent
# Hydra's configuration: in the package as it is installed, next to it in a checkout.
CONF = next(filter(Path.is_dir, (_PACKAGE / "conf", CHECKOUT / "conf")), _PACKAGE / "conf")
EXPERIMENTS = CONF / "experiment"  # one YAML file an experiment
GATE_RECORDS = CHECKOUT / "results" / "records" / "gate.jsonl"  # published records of the gate
