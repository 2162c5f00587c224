"""Numbers that no refactoring may change: estimates and standard deviations of whole runs.

Every run goes through the public command into an empty folder. ``golden.json`` holds, for each, the
command, the commit that made the values, and the estimate and standard deviation of every unknown.
A number may differ by `TOLERANCE` of its size, or of its standard deviation where that is larger
(a displacement may be zero). After an intended change of an estimator, write them again::

    python -m tests.test_golden [NAME ...]

Results published before such a change are stale: `mvest.provenance.NUMBERS` counts the changes of
each kind of run, and `mvest.provenance.GOLDEN` holds the digest that tells them.

The runs named ``*_coarse`` take seconds on coarse meshes, without relinearising. They guard the
same code as the full ones, which are ``slow``.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from experiments.common.records.record import read_record
from experiments.common.study import load_study, study_names
from experiments.sweeps.collected import read_sweep
from mvest.problem.record import EstimateRecord
from mvest.provenance import GOLDEN as DIGESTS
from mvest.provenance import NUMBERS
from tests.places import ROOT

GOLDEN = Path(__file__).with_name("golden.json")
TOLERANCE = 1e-6
"""Relative. On one machine, runs with as many threads agree to the last digit, and so do sweeps on
one and on two processes; two threads change Table 1 by 3e-13 and an own valve not at all."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

Values = dict[str, dict[str, list[float]]]
"""By run or job, and by unknown: estimate and standard deviation."""


ALTERNATIVES = {
    "moduli_only": "without_nuisances",
    "paper": "as_in_the_paper",
    "uncalibrated": "uncalibrated",
}


def read_values(outputs: Path) -> Values:
    """What a command wrote of its estimates. Nothing else here knows how a record is laid out."""

    def pairs(estimate: EstimateRecord) -> dict[str, list[float]]:
        rows = [one for one in estimate.unknowns if one.kind != "derived"]
        return {one.name: [one.estimate, one.std] for one in rows}

    sweeps = list(outputs.glob("*/sweep.json"))
    if sweeps:
        return {job.record.row: pairs(job.runs[0]) for job in read_sweep(sweeps[0]).jobs}
    (file,) = outputs.glob("*/*/result.json")
    first = read_record(file).estimates[0]
    others = {ALTERNATIVES[name]: pairs(other) for name, other in first.alternatives.items()}
    return {"estimate": pairs(first), **others}


@dataclass(frozen=True, slots=True)
class Run:
    """One command; ``slow`` where it takes more than about 15 seconds of CPU."""

    kind: str  # in `NUMBERS`
    overrides: tuple[str, ...]
    slow: bool = False

    @property
    def command(self) -> str:
        """As it is typed."""
        return " ".join(("python -m experiments.run", *self.overrides))


COARSE = (
    "personal.mesh.source=structured",
    "personal.mesh.columns=16",
    "personal.mesh.rows=2",
    "personal.mesh.guide_columns=12",
    "personal.mesh.guide_rows=2",
    "personal.mesh.contact_columns=60",
    "personal.mesh.contact_rows=16",
    "personal.confirm=false",
)
SMALL_PATIENT = (
    "patient.simulation.columns=16",
    "patient.simulation.rows=2",
    "patient.simulation.dt_factor=1",
    "patient.simulation.contact_columns=60",
    "patient.simulation.contact_rows=16",
    "patient.simulation.seen_columns=32",
    "patient.simulation.seen_rows=9",
    "patient.simulation.held_pressure_mmHg=[]",
    "patient.simulation.held_relaxation=[]",
)
PATIENT = ("experiment=patients", "patient=normal_small", "hydra.mode=RUN")
VOLUME = ("experiment=volume", "volume=examples/volume.seq.nrrd", "imaged.pressure_mmHg=120")
FEWER = ("imaged.error_samples=20", "personal.nuisance_geometry=null", "personal.moduli_only=false")
OWN = ("experiment=own_valve", "case=examples/case")
# The default rounds the columns up to a multiple of the leaflets.
STRUCTURED = "personal.mesh.source=structured"

RUNS = {
    "table1": Run("twin", ("experiment=table1",)),
    "table1_independent": Run("twin", ("experiment=table1_independent",), slow=True),
    "sweep": Run(
        "twin",
        ("sweep=debug", "filter.initial=[5,3],[4,2]", "seed=1,2,3,4", "observation.noise_mm=0.05"),
    ),
    "own_valve_coarse": Run("case", (*OWN, "personal=carried", *COARSE)),
    "own_valve": Run("case", (*OWN, STRUCTURED), slow=True),
    "patients_coarse": Run("patient", (*PATIENT, "personal=nuisances", *SMALL_PATIENT, *COARSE)),
    "patients": Run("case", PATIENT, slow=True),
    "population": Run(
        "patient",
        ("experiment=population", "patient=drawn", "seed=601", "hydra.mode=RUN"),
        slow=True,
    ),
    "volume_coarse": Run("volume", (*VOLUME, *COARSE, *FEWER)),
    "volume": Run("volume", VOLUME, slow=True),
}


def run(name: str, outputs: Path) -> Values:
    """Run a command of `RUNS` into an empty folder and read what it found."""
    settings = (f"paths.outputs={outputs}", f"paths.results={outputs}/published")
    quiet = ("tracking.enabled=false", "figures=false")
    subprocess.run(
        [sys.executable, "-m", "experiments.run", *RUNS[name].overrides, *settings, *quiet],
        cwd=ROOT,
        env={**os.environ, **dict.fromkeys(THREADS, "1"), "PYTHONPATH": str(ROOT)},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return read_values(outputs)


def differences(found: Values, expected: Values) -> list[str]:
    """One line for every number that is not as expected."""
    lines = []
    for row in sorted(found.keys() | expected.keys()):
        here, there = found.get(row, {}), expected.get(row, {})
        for name in sorted(here.keys() | there.keys()):
            if name not in here or name not in there:
                lines.append(f"{row}, {name}: found {here.get(name)}, expected {there.get(name)}")
                continue
            (a, a_std), (b, b_std) = here[name], there[name]
            if not abs(a - b) <= TOLERANCE * max(abs(b), b_std):
                lines.append(f"{row}, {name}: found {a!r}, expected {b!r}")
            if not abs(a_std - b_std) <= TOLERANCE * b_std:
                lines.append(f"{row}, {name}, std: found {a_std!r}, expected {b_std!r}")
    return lines


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.slow] if one.slow else []) for n, one in RUNS.items()],
)
def test_estimates_are_what_they_were(name, tmp_path):
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))[name]
    assert golden["command"] == RUNS[name].command, "renew golden.json"
    found = differences(run(name, tmp_path), golden["values"])
    assert not found, "\n".join([f"not as at {golden['commit'][:7]}:", *found])


def digest(kind: str, golden: dict) -> str:
    """Twelve digits that change with the golden numbers of a kind of run, not with its command."""
    values = {name: golden[name]["values"] for name, one in RUNS.items() if one.kind == kind}
    # Six digits, as many as `TOLERANCE` holds.
    numbers = json.loads(json.dumps(values), parse_float=lambda text: f"{float(text):.5e}")
    return hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()[:12]


@pytest.mark.parametrize("kind", NUMBERS)
def test_a_change_of_golden_numbers_makes_published_results_stale(kind):
    found = digest(kind, json.loads(GOLDEN.read_text(encoding="utf-8")))
    assert found == DIGESTS[kind], (
        f"the golden numbers of the kind {kind!r} are other ones: in mvest/provenance.py raise "
        f"NUMBERS[{kind!r}] to {NUMBERS[kind] + 1} and set GOLDEN[{kind!r}] to {found!r}; "
        "`mvest results` then lists what is stale"
    )


def test_every_study_follows_known_kinds_of_golden_runs():
    assert {one.kind for one in RUNS.values()} == set(NUMBERS) == set(DIGESTS)
    for name in study_names():
        assert set(load_study(name).golden) <= set(NUMBERS) != set(), name


def renew(names: list[str]) -> None:
    """Run these again and write what they find into ``golden.json``."""
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.strip()
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            values = run(name, Path(folder))
        known = json.loads(GOLDEN.read_text(encoding="utf-8")) if GOLDEN.is_file() else {}
        known[name] = {"command": RUNS[name].command, "commit": commit, "values": values}
        ordered = {key: known[key] for key in RUNS if key in known}
        GOLDEN.write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    renew(sys.argv[1:] or list(RUNS))
