"""The study of designs in a size that takes seconds, and what ``check=true`` says of studies."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from experiments.common.records.record import read_record
from experiments.run import main
from experiments.studies.identifiability.figures import designs_figure
from experiments.studies.identifiability.findings import Findings
from experiments.studies.identifiability.observed_sets import SETS, vertex_set
from experiments.studies.identifiability.report import write_identifiability
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.estimation import Design, Prediction
from tests.experiments.studies.test_gate_study import SMALL

COLUMNS, ROWS = 16, 5
TINY = (
    "designs.pressures_mmHg=[4.0]",
    "designs.cycle_times=[0.05,0.1]",
    "designs.cycle_dt=0.05",
    "designs.points=2",
    "designs.followed=[{vertices: all, pressures_mmHg: [4.0, 5.0], label: two}]",
    "designs.known=[chord_stiffness,pressure_scale]",
    "publish=false",
)


def call(folder, monkeypatch, capsys, *arguments):
    monkeypatch.chdir(folder)
    flags = [a for a in arguments if a.startswith("--")]
    settings = [a for a in arguments if not a.startswith("--")]
    monkeypatch.setattr(sys, "argv", ["experiments.run", *flags, *SMALL, *settings])
    status = main()
    return status, capsys.readouterr()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The record of a small run, its folder, and the Jacobians that models gave on the way."""
    place = tmp_path_factory.mktemp("study")
    seen = []
    original = ClosureModel.__call__

    def watched(self, m):
        found = original(self, m)
        if self.mesh.element_type == "hex18":
            seen.append((self.settings.protocol.pressure_mmHg, np.array(m), found.jacobian))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setattr(ClosureModel, "__call__", watched)
        patch.setattr(
            sys, "argv",
            ["run", *SMALL, "experiment=identifiability", *TINY, "hydra.run.dir=here"],
        )  # fmt: skip
        assert main() == 0
    record = read_record(place / "here" / "result.json", Findings)
    return record, place / "here", seen


def rows_of(record, **wanted):
    """What designs that are like this tell of each modulus."""
    return [
        one
        for design in record.findings.designs
        if all(getattr(design, k) == v for k, v in wanted.items())
        for one in design.moduli
    ]


def designs_of(record, **wanted):
    designs = record.findings.designs
    return [d for d in designs if all(getattr(d, k) == v for k, v in wanted.items())]


def test_the_open_frame_adds_nothing_and_a_second_pressure_does(made):
    record, _, _ = made
    closed = rows_of(record, frames="closed")
    both = rows_of(record, frames="open and closed")
    more = rows_of(record, frames="closed at 4 and 5 mmHg")
    assert len(closed) == len(both) == len(more) == len(SETS) * 2 * 5 * 2
    for one, other, further in zip(closed, both, more, strict=True):
        for noise, std in one.std.items():
            assert other.std[noise] == (None if std is None else pytest.approx(std, rel=1e-6))
            assert std is None or further.std[noise] < std
    counts = [
        {d.frame_count for d in designs_of(record, frames=frames)}
        for frames in ("closed", "open and closed", "whole cycle, 2 frames")
    ]
    assert counts == [{1}, {2}, {2}]


def test_a_row_is_the_design_of_its_vertices_and_frames(made):
    record, _, seen = made
    pressures = [pressure for pressure, _, _ in seen[:2]]
    assert pressures == [4.0, 5.0]
    halves = [H[len(H) // 2 :] for _, _, H in seen[:2]]
    members = np.repeat(vertex_set("edge", COLUMNS, ROWS), 3)
    H = np.concatenate([half[members] for half in halves])
    design = Design.of(H, 1.0, np.array(record.findings.assumed), record.parameters)
    (found,) = designs_of(
        record, vertices="edge", errors="independent", frames="closed at 4 and 5 mmHg"
    )
    (row,) = (
        one
        for one in found.moduli
        if (one.knowledge, one.parameter) == ("all else half known", "E_f.posterior")
    )
    believed = {"chord_rest_length": 0.02, "pressure_scale": 0.1, "chord_stiffness": 0.2}
    assert found.points == COLUMNS
    assert row.std["0.25"] == pytest.approx(design.std("E_f.posterior", 0.25, believed))
    needed = row.needed_noise_mm
    assert needed == 0.0 or design.std("E_f.posterior", needed, believed) == pytest.approx(0.05)


def test_profiles_start_at_the_truth_and_hold_what_is_known(made):
    record, _, seen = made
    assert [p.parameter for p in record.findings.profiles] == [
        "E_f.anterior", "E_f.posterior", "chord_rest_length",
    ]  # fmt: skip
    for found in record.findings.profiles:
        path = np.array(found.path)
        at = int(np.argmin(found.deviance))
        np.testing.assert_allclose(path[at], record.findings.assumed[:3], rtol=1e-6)
        assert found.deviance[at] == 0.0
        held = path[:, record.parameters.index(found.parameter)]
        assert np.all(np.diff(held) > 0)
    # The models of profiles were given three parameters: the others are no unknowns of theirs.
    assert {m.size for _, m, _ in seen[2:]} <= {3, 5}


def test_tables_and_figures_come_from_the_record_alone(made, tmp_path):
    record, folder, _ = made
    names = {path.name for path in folder.iterdir()}
    assert {"identifiability.csv", "identifiability.md", "identifiability.tex"} <= names
    assert {f"identifiability_{n}.png" for n in ("designs", "profiles", "valley")} <= names
    written = write_identifiability(tmp_path, {"identifiability": record}, {})
    for path in written:
        if path.suffix in (".csv", ".md", ".tex"):
            assert path.read_text() == (folder / path.name).read_text()
    table = pd.read_csv(tmp_path / "identifiability.csv", comment="#")
    assert len(table) == len(rows_of(record))
    text = (tmp_path / "identifiability.md").read_text()
    assert "How well the pressure must be known" in text
    assert "nan" not in text.lower().replace("annulus", "")


def test_the_figure_of_designs_shows_each_deviation_and_counts_those_within_the_target(made):
    record, _, _ = made
    figure = designs_figure(record.findings)
    # The open frame adds nothing: it is shown together with the closed one.
    rows = [
        one
        for design in record.findings.designs
        if design.frames != "open and closed"
        for one in design.moduli
        if one.parameter == "E_f.anterior"
    ]
    assert sum(len(axes.texts) for axes in figure.axes) == len(rows)
    for axes in figure.axes:
        *words, counted = axes.get_title().split("\n")
        own = [r.std["0.5"] for r in rows if r.knowledge == " ".join(words)]
        within = sum(std is not None and std <= record.findings.settings.target for std in own)
        assert counted == f"{within} of {len(own)}"


def test_a_valve_that_does_not_close_is_a_failed_record(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(ClosureModel, "__call__", lambda *_: Prediction.failed("no equilibrium"))
    status, said = call(
        tmp_path, monkeypatch, capsys, "experiment=identifiability", *TINY, "hydra.run.dir=here"
    )
    assert status == 1
    assert "closed at 4 mmHg: no equilibrium" in said.err
    record = read_record(tmp_path / "here" / "result.json", Findings)
    assert record.status == "failed"
    assert record.findings.designs == ()


def test_sets_of_vertices():
    # Vertices row by row, the annulus first.
    rows = {name: vertex_set(name, 12, 7).reshape(7, 12) for name in SETS}
    assert rows["all"].all()
    assert [int(r.any()) for r in rows["belly"]] == [0, 0, 1, 1, 1, 0, 0]
    assert [int(r.any()) for r in rows["edge"]] == [0, 0, 0, 0, 0, 0, 1]
    assert [int(r.any()) for r in rows["annulus and edge"]] == [1, 0, 0, 0, 0, 0, 1]
    assert rows["landmarks"].sum(axis=1).tolist() == [0, 0, 0, 10, 0, 0, 10]
    with pytest.raises(ConfigurationError, match="expected one of all, belly"):
        vertex_set("trigone", 12, 7)


def test_a_check_tells_of_a_twin_and_estimates_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        "mvest.problem.estimate.estimate", lambda *a, **k: pytest.fail("something was estimated")
    )
    status, said = call(
        tmp_path, monkeypatch, capsys, "experiment=table1", "check=true", "filter.R=0.0004",
        "observation.dropout_mm=0.0",
    )  # fmt: skip
    assert status == 0, said.err
    assert "480 numbers of open, closed; 0.02 mm of noise assumed, independent" in said.out
    rows = [line.split() for line in said.out.splitlines() if line.strip().startswith("E_f.")]
    assert [row[0] for row in rows] == ["E_f.anterior", "E_f.posterior"]
    assert [row[2] for row in rows] == ["5", "3"]  # the filter's start, not the truth
    assert "No estimation was run." in said.out
    assert not list(Path(tmp_path).rglob("result.json"))


def test_jobs_of_a_sweep_that_begin_alike_share_a_closure(tmp_path, monkeypatch, capsys):
    calls = []
    original = ClosureModel.__call__

    def counted(self, m):
        calls.append(np.array(m))
        return original(self, m)

    monkeypatch.setattr(ClosureModel, "__call__", counted)
    status, said = call(
        tmp_path, monkeypatch, capsys, "--multirun", "experiment=table1", "check=true",
        "filter.R=0.01,0.04", "hydra.sweep.dir=sweep",
    )  # fmt: skip
    assert status == 0, said.err
    assert len(calls) == 1
    # Twice the noise, twice the deviation from the data alone.
    stds = [
        [float(line.split()[4]) for line in part.splitlines() if "E_f." in line and "MPa" in line]
        for part in said.out.split("what the data will tell")[1:]
    ]
    assert np.array(stds[1]) == pytest.approx(2 * np.array(stds[0]), rel=0.06)
    assert not list(Path(tmp_path).rglob("result.json"))
