"""Designs of observations in a size that takes seconds, and what ``check=true`` says of studies."""

import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.common.records.record import read_record
from experiments.run import main
from mvest.closure.model import ClosureModel
from mvest.estimation import Design
from mvest.observation.vertices import vertex_sets

COLUMNS, ROWS = 16, 5
SMALL = (
    "mesh.columns=12",
    "mesh.rows=2",
    f"observation.columns={COLUMNS}",
    f"observation.rows={ROWS}",
    "mechanics.contact_points.columns=24",
    "mechanics.contact_points.rows=6",
    "mechanics.protocol.pressure_mmHg=5",
    "mechanics.protocol.ramp=0.1",
    "mechanics.protocol.dt=0.1",
    "mechanics.protocol.end=0.1",
    "mechanics.protocol.equilibrium=false",
    "tracking.enabled=false",
)
TINY = (
    "designs.pressures_mmHg=[4.0]",
    "designs.cycle_times=[0.05,0.1]",
    "designs.cycle_dt=0.05",
    "designs.known=[chord_stiffness,pressure_scale]",
    "publish=false",
)
BELIEVED = {"chord_rest_length": 0.02, "pressure_scale": 0.1, "chord_stiffness": 0.2}


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
    return read_record(place / "here" / "result.json"), place / "here", seen


def rows_of(record, **wanted):
    """What designs that are like this tell of each modulus."""
    rows = record.table_of().rows
    return [row for row in rows if all(row[k] == v for k, v in wanted.items())]


def test_the_open_frame_adds_nothing_and_a_second_pressure_does(made):
    record, _, _ = made
    labels = ("closed", "open and closed", "closed at 4 and 5 mmHg", "whole cycle, 2 frames")
    closed, both, more, cycle = (rows_of(record, frames=frames) for frames in labels)
    assert len(closed) == len(both) == len(more) == 5 * 2 * 5 * 2
    for one, other, further in zip(closed, both, more, strict=True):
        for column in (name for name in one if name.startswith("std at")):
            std = one[column]
            assert other[column] == (None if std is None else pytest.approx(std, rel=1e-6))
            assert std is None or further[column] < std
    counts = [{row["number of frames"] for row in rows} for rows in (closed, both, cycle)]
    assert counts == [{1}, {2}, {2}]


def test_a_row_is_the_design_of_its_vertices_and_frames(made):
    record, _, seen = made
    assert [pressure for pressure, _, _ in seen[:2]] == [4.0, 5.0]
    halves = [H[len(H) // 2 :] for _, _, H in seen[:2]]
    members = np.repeat(vertex_sets(COLUMNS, ROWS)["free edge"], 3)
    H = np.concatenate([half[members] for half in halves])
    design = Design.of(H, 1.0, seen[0][1], record.parameters)
    (row,) = rows_of(
        record, vertices="free edge", errors="independent", frames="closed at 4 and 5 mmHg",
        parameter="E_f.posterior", **{"knowledge of the nuisances": "all else half known"},
    )  # fmt: skip
    assert row["number of vertices"] == COLUMNS
    expected = 100 * design.std("E_f.posterior", 0.25, BELIEVED)
    assert row["std at 0.25 mm"] == pytest.approx(expected)
    needed = row["noise for 5 %"]
    assert needed == 0.0 or design.std("E_f.posterior", needed, BELIEVED) == pytest.approx(0.05)


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
    rows = [line.split() for line in said.out.splitlines() if line.strip().startswith("E_f ")]
    assert [row[1] for row in rows] == ["anterior", "posterior"]
    assert [row[3] for row in rows] == ["5", "3"]  # the filter's start, not the truth
    assert "No estimation was run." in said.out
    assert not list(Path(tmp_path).rglob("result.json"))
