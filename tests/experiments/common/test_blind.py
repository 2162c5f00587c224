"""An estimating process cannot open what its case hides, and is given nothing of it."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.common.cases import blind
from experiments.common.cases.blind import SECRET, estimate_blindly, write_estimate
from experiments.common.records.record import Result
from mvest.errors import InputError
from mvest.problem.record import EstimateRecord, Unknown
from tests.places import ROOT

WAYS = {
    "open": "open(secret)",
    "os.open": "os.open(secret, os.O_RDONLY)",
    "numpy.load": "np.load(str(folder / 'positions.npz'))",
    "relative": "open(os.path.join('hidden', 'hidden.json'))",
    "symlink to the folder": "open(os.path.join('door', 'hidden.json'))",
    "listdir": "os.listdir(folder)",
    "rename the folder": "os.rename(folder, 'elsewhere')",
    "rename what holds it": "os.rename(root, str(root) + '_moved')",
    "symlink": "os.symlink(folder, 'new_door')",
    "write": "open(folder / 'new', 'w')",
    "sqlite": "sqlite3.connect(folder / 'new.db')",
}

ATTEMPT = """
import os, sqlite3, sys
from pathlib import Path
import numpy as np
from experiments.common.cases.blind import seal
root = Path(sys.argv[1]); folder = root / "hidden"; secret = str(folder / "hidden.json")
os.chdir(root)
seal(folder)
for way in sys.stdin.read().splitlines():
    os.chdir(root)
    try:
        eval(way)
    except PermissionError as error:
        print("sealed" if "is sealed" in str(error) else f"refused otherwise: {error}")
    except Exception as error:
        print(f"refused otherwise: {error!r}")
    else:
        print("done")
"""


OTHERS = [
    "open(os.path.join('case', 'hidden.json')).read()",
    "open(os.path.join('hidden_from_nobody', 'hidden.json')).read()",  # only begins alike
    "os.listdir(root)",
    "Path('out.json').write_text('x')",
]
WALK = "print(*[name for _, _, names in os.walk(root) for name in names], file=sys.stderr)"


def test_only_the_sealed_folder_cannot_be_opened_in_any_usual_way(tmp_path):
    root = tmp_path / "root"
    for name in ("hidden", "case", "hidden_from_nobody"):
        (root / name).mkdir(parents=True)
        (root / name / "hidden.json").write_text('{"E_f.anterior": 4.321}')
        (root / name / "positions.npz").write_bytes(b"")
    (root / "door").symlink_to("hidden", target_is_directory=True)
    (root / "window.json").symlink_to(Path("hidden") / "hidden.json")
    ways = [*WAYS.values(), WALK, *OTHERS]
    finished = subprocess.run(
        [sys.executable, "-c", ATTEMPT, str(root)],
        input="\n".join(ways),
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    outcome = dict(zip(ways, finished.stdout.splitlines(), strict=True))
    assert {way: outcome[code] for way, code in WAYS.items()} == dict.fromkeys(WAYS, "sealed")
    assert {outcome[way] for way in (WALK, *OTHERS)} == {"done"}
    assert finished.stderr.split().count("hidden.json") == 2, "a walk does not name what is sealed"
    left = sorted(path.name for path in (root / "hidden").iterdir())
    assert left == ["hidden.json", "positions.npz"]


def a_result():
    moduli = (Unknown(name="E_f.anterior", estimate=5.0), Unknown(name="E_f.posterior"))
    estimate = EstimateRecord(
        case="made_up", status="converged", reason="converged", unknowns=moduli, forward_solves=7
    )
    return Result(estimates=(estimate,), arrays={"rest": np.eye(3)}, row="made_up")


VALUES = {
    "name": "patients",
    "patient": {"moduli": {"E_f.anterior": 4.321}},
    "truth": {"values": [4.321]},
    "valve": {"annulus": {"anteroposterior_diameter": 27.158}},
    "seed": 24680,
    "parameters": ["E_f.anterior"],
    "row": "drawn_24680",
    "personal": {"unknowns": {}},
    "case": None,
}


def test_the_process_is_given_nothing_of_the_patient(monkeypatch, tmp_path):
    heard = []

    def run(command, *, input, env, **options):
        heard.append((input, env))
        write_estimate(tmp_path, a_result())
        return SimpleNamespace(returncode=0, stderr="")

    monkeypatch.setattr(blind, "run", run)
    found = estimate_blindly(VALUES, tmp_path, Path("case"), Path("hidden"))
    ((text, environment),) = heard
    given = json.loads(text)["values"]
    assert not set(SECRET) & set(given)
    for secret in ("4.321", "13.579", "24680"):
        assert secret not in text.replace(str(tmp_path), "")
    assert given["case"] == "case"
    assert given["personal"] == VALUES["personal"]
    assert found.estimates == a_result().estimates
    assert not any("4.321" in value or "24680" in value for value in environment.values())


def test_what_was_configured_of_a_patient_is_sealed(tmp_path):
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "case.yaml").touch()
    values = {"case": None, "personal": {}, "mechanics": {}}
    with pytest.raises(InputError, match=r"\.hydra.* is sealed"):
        estimate_blindly(values, tmp_path, tmp_path / ".hydra", tmp_path / "hidden")
