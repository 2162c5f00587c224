"""Markups as Slicer and slicerio write them; what Slicer reads is read, the rest is refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.exchange.markups import PointList, read_markups, write_markups

TIPS = PointList(("anterolateral", "posteromedial"), np.array([[1.5, -2, 3], [4, 5, -6.25]]))
ANNULUS = PointList.numbered("annulus", np.arange(12.0).reshape(4, 3), "ClosedCurve")


def written(folder: Path) -> Path:
    return write_markups(folder / "a.mrk.json", {"tips": TIPS, "annulus": ANNULUS})


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    found = read_markups(written(tmp_path))
    theirs = json.loads(written(tmp_path).read_text())["markups"]
    assert list(found) == ["tips", "annulus"] == [item["name"] for item in theirs]
    for item, (name, expected) in zip(theirs, (("tips", TIPS), ("annulus", ANNULUS)), strict=True):
        assert found[name].labels == expected.labels
        assert found[name].kind == expected.kind == item["type"]
        np.testing.assert_array_equal(found[name].points, expected.points)
        assert (item["coordinateSystem"], item["coordinateUnits"]) == ("LPS", "mm")
        assert [k["position"] for k in item["controlPoints"]] == expected.points.tolist()


def changed(path: Path, change: Callable[[Any], object]) -> Path:
    content = json.loads(path.read_text())
    change(content["markups"][0])
    path.write_text(json.dumps(content))
    return path


def first(item: Any) -> Any:
    return item["controlPoints"][0]


READ: dict[str, tuple[Callable[[Any], object], list[list[float]], tuple[str, ...]]] = {
    "a coded unit": (
        lambda c: c.update(coordinateUnits=["cm", "UCUM", "centimeter"]),
        (10 * TIPS.points).tolist(),
        (),
    ),
    # As Slicer writes a point that was listed and never placed.
    "not placed": (
        lambda c: first(c).update(position="", positionStatus="undefined"),
        [[4, 5, -6.25]],
        ("anterolateral",),
    ),
    "the name of another list": (lambda c: c.update(name="annulus"), TIPS.points.tolist(), ()),
}


@pytest.mark.parametrize("what", READ)
def test_what_slicer_reads_is_read(tmp_path: Path, what: str) -> None:
    change, expected, unplaced = READ[what]
    found = list(read_markups(changed(written(tmp_path), change)).values())
    assert len(found) == 2
    np.testing.assert_allclose(found[0].points, np.reshape(expected, (-1, 3)))
    assert found[0].unplaced == unplaced
    np.testing.assert_array_equal(found[1].points, ANNULUS.points)


BAD: dict[str, tuple[Callable[[Any], object], str]] = {
    "another system": (lambda c: c.update(coordinateSystem="IJK"), "markups.0.coordinateSystem"),
    "another unit": (lambda c: c.update(coordinateUnits="inch"), "markups.0.coordinateUnits"),
    "two numbers": (lambda c: first(c).update(position=[1, 2]), "markups.0.controlPoints.0"),
    "nan": (lambda c: first(c).update(position=[1, float("nan"), 2]), "markups.0.controlPoints.0"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_list_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    change, field = BAD[what]
    path = changed(written(tmp_path), change)
    with pytest.raises(InputError) as caught:
        read_markups(path)
    assert str(caught.value).startswith(f"{path}: {field}")
    assert "\n" not in str(caught.value)


HEAD = "# Markups fiducial file version = {}\n# CoordinateSystem = {}\n"
COLUMNS = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
ROWS = 'F-1,1.5,-2,3,0,0,0,1,1,1,0,"A, P",,\n\nF-2,4,5,-6.25,0,0,0,1,1,1,0,AL,,vtkMRMLScalar\n'


def test_fcsv_with_quotes_and_without_a_header(tmp_path: Path) -> None:
    (tmp_path / "F.fcsv").write_bytes(ROWS.replace("\n", "\r\n").encode())
    found = read_markups(tmp_path / "F.fcsv")["F"]
    assert found.labels == ("A, P", "AL")
    np.testing.assert_array_equal(found.points, TIPS.points * [-1, -1, 1])

    for axes, sign in (("0", [-1, -1, 1]), ("1", [1, 1, 1])):  # before Slicer 4.11
        (tmp_path / "F.fcsv").write_text(HEAD.format("4", axes) + COLUMNS + ROWS)
        points = read_markups(tmp_path / "F.fcsv")["F"].points
        np.testing.assert_array_equal(points, TIPS.points * sign)
    whole = HEAD.format("5", "LPS") + COLUMNS + ROWS
    for old, new, words in (
        ("= LPS", "= IJK", "CoordinateSystem"),
        ("4,5,", "4,x,", "position of"),
    ):
        (tmp_path / "F.fcsv").write_text(whole.replace(old, new))
        with pytest.raises(InputError, match=rf"F\.fcsv: {words}"):
            read_markups(tmp_path / "F.fcsv")


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ends in \.mrk\.json"):
        write_markups(tmp_path / "a.json", {"tips": TIPS})
    with pytest.raises(InputError, match="at least one"):
        write_markups(tmp_path / "a.mrk.json", {})
    with pytest.raises(InputError, match=r"markups\.0\.controlPoints\.0"):
        write_markups(tmp_path / "a.mrk.json", {"a": PointList(("a",), np.full((1, 3), np.nan))})
