"""A small program of one's own, in plain Python without mvest, and how it is asked."""

import sys
from pathlib import Path

import numpy as np

from mvest.exchange.external.contract import Command
from mvest.exchange.external.model import ProcessModel

SPRINGS = '''
"""Two springs in a row, pulled by 2 N: x1 = 2 / k1, x2 = x1 + 2 / k2 (mm), y and z are constant."""
import csv, json, pathlib, sys, time
request, folder, *how = sys.argv[1:]
data = json.loads(pathlib.Path(request).read_text())
folder = pathlib.Path(folder)
k1, k2 = (p["value"] for p in data["parameters"])
with open(folder / "count.txt", "a") as stream:
    stream.write("ran\\n")
if how == ["crash"]:
    sys.exit("out of licences")
if how == ["sleep"]:
    time.sleep(60)
if min(k1, k2) <= 0:
    answer = {"status": "failed", "reason": f"k1 = {k1}: expected > 0"}
else:
    x1 = 2 / k1
    rows = [[x1, 0, 0], [x1 + 2 / k2, 0, data["settings"].get("height", 1)]]
    with open(folder / "observation.csv", "w", newline="") as stream:
        csv.writer(stream).writerows([["x", "y", "z"], *rows])
    if how == ["exact"]:
        d1, d2 = -2 / k1**2, -2 / k2**2
        table = [["k1", "k2"], [d1, 0], [0, 0], [0, 0], [d1, d2], [0, 0], [0, 0]]
        with open(folder / "jacobian.csv", "w", newline="") as stream:
            csv.writer(stream).writerows(table)
    answer = {"status": "converged", "reason": ""}
answer |= {"format": "mvest-external", "version": 1}
if how == ["refuse"]:
    answer |= {"status": "failed", "reason": "material data missing in deck"}
(folder / "response.json").write_text(json.dumps(answer))
if how == ["refuse"]:
    sys.exit(1)
'''

NAMES = ("k1", "k2")


def springs(k1, k2):
    """What the program predicts, and its derivatives, by hand."""
    y = np.array([2 / k1, 0, 0, 2 / k1 + 2 / k2, 0, 1.0])
    jacobian = np.zeros((6, 2))
    jacobian[[0, 3], 0] = -2 / k1**2
    jacobian[3, 1] = -2 / k2**2
    return y, jacobian


def model(folder: Path, *how: str, source: str = SPRINGS, limit: float = 30.0, **more):
    """The program as an observation model, its runs kept below ``folder``."""
    program = folder / "program.py"
    program.write_text(source)
    arguments = (sys.executable, "-I", "-S", str(program))
    command = Command((*arguments, "{request}", "{folder}", *how), time_limit_s=limit)
    return ProcessModel(command, folder / "runs", NAMES, 2, units=("N/mm", "N/mm"), **more)
