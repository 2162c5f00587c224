"""What the README of the format says is so."""

import re
from pathlib import Path

import meshio
import numpy as np
import pytest

import mvest.cases
from mvest.cases.folder import read_case
from mvest.cases.schema import CaseFile, FrameEntry
from mvest.cases.tissue import BRANCH_COLUMNS, CHORD_COLUMNS
from mvest.valve.anatomy.template import Template
from tests.cases.folders import closing, save, save_frames

README = (Path(mvest.cases.__file__).parent / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```yaml\n(.*?)```", README, flags=re.DOTALL)


def test_every_field_is_in_the_readme_and_no_other():
    documented = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", README, flags=re.MULTILINE)
    names = {name for cell in documented for name in re.findall(r"\w+", cell)}
    assert names == set(CaseFile.model_fields) | set(FrameEntry.model_fields)


def test_the_table_of_branching_chordae_has_all_columns():
    (table,) = re.findall(r"```text\n(.*?)```", README, flags=re.DOTALL)
    head, *rows = (line.split(",") for line in table.splitlines())
    assert tuple(head) == (*CHORD_COLUMNS, *BRANCH_COLUMNS)
    assert [row[-2:] for row in rows] == [["", "A"], ["A", ""], ["A", ""]]


def test_the_smallest_example_is_read(tmp_path):
    save_frames(tmp_path)
    case = read_case(save(tmp_path, EXAMPLES[0]))
    assert [frame.corresponds for frame in case.frames] == [True, True]
    assert len(case.chordae) == len(Template().chordae())


def test_the_example_without_correspondence_is_read(tmp_path):
    # Another mesh in every frame, in cm.
    for name, share, size in (("open", 0.0, 40), ("closing", 0.7, 48), ("closed", 1.0, 56)):
        surface = Template().valve(size, 12).surface
        for number, region in enumerate(surface.region_names):
            x = closing(surface.vertices, share) / 10.0
            file = tmp_path / f"{name}_{region}.stl"
            own = surface.triangles[surface.region == number]
            meshio.Mesh(x, [("triangle", own)]).write(file)
    case = read_case(save(tmp_path, EXAMPLES[1]))
    assert [frame.corresponds for frame in case.frames] == [True, False, False]
    assert [len(frame.annulus) for frame in case.frames] == [40, 40, 40]
    assert case.frames[1].pressure_mmHg == pytest.approx(10.0 / 0.133322387415)
    assert case.frames[2].time == pytest.approx(0.35)
    assert np.ptp(case.surface.vertices[:, 0]) == pytest.approx(36.0, rel=0.01)
    assert case.valve.chordae is case.chordae
