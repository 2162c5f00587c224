"""What lies in ``examples``: the case is one, and the gallery's scripts name what exists."""

import re
import runpy
import sys
from importlib import import_module

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.cases.folder import read_case
from tests.places import ROOT

EXAMPLES = ROOT / "examples"
GALLERY = sorted((EXAMPLES / "gallery").glob("plot_*.py"))
QUICK = ("plot_1_template", "plot_6_own_model")
"""Those that take a second; all run whenever the documentation is built."""


def test_the_case_is_read_and_says_what_was_derived():
    case = read_case(EXAMPLES / "case")
    assert case.simulated
    assert [frame.pressure_mmHg for frame in case.frames] == [0.0, 120.0]
    assert [sentence.partition(":")[0] for sentence in case.derived] == [
        "annulus and free edge",
        "thickness",
        "fibre",
        "chordae",
    ]
    opened, closed = case.frame(Role.REFERENCE), case.frame(Role.CLOSED)
    assert closed.corresponds
    # The leaflets come down by their own size, the annulus hardly.
    moved = np.linalg.norm(closed.vertices - opened.vertices, axis=1)
    assert moved[case.free_edge].mean() > 5 * moved[case.annulus].mean() > 0


OWN = [path for path in (*EXAMPLES.glob("*.py"), *GALLERY) if path.stem != "open_in_slicer"]
"""Scripts for this project's Python; the one that is left out is for that of 3D Slicer."""


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.stem)
def test_a_script_names_what_exists_and_is_short(path):
    text = path.read_text(encoding="utf-8")
    names = re.findall(r"^from (mvest[\w.]*) import ([\w, ]+)$", text, flags=re.MULTILINE)
    found = [(module, name) for module, listed in names for name in listed.split(", ")]
    found += [("mvest", name) for name in re.findall(r"\bmvest\.([A-Za-z]\w*)\(", text)]
    assert found
    for module, name in found:
        assert hasattr(import_module(module), name), f"{module}.{name}"
    if path in GALLERY:
        code = [line for line in text.splitlines() if line and not line.startswith("#")]
        assert len(code) <= 60
        assert re.match(r'"""\n.+\n=+\n\n', text), "no title"


@pytest.mark.parametrize("name", QUICK)
def test_a_quick_script_draws_its_figure(name, monkeypatch, capsys):
    folder = EXAMPLES / "gallery"
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setitem(sys.modules, "drawing", None)
    monkeypatch.delitem(sys.modules, "drawing")
    mpl.use("Agg")
    try:
        names = runpy.run_path(f"{name}.py")
        figure = names["figure"]
        assert all(axes.has_data() for axes in figure.axes)
    finally:
        plt.close("all")
