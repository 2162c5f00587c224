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
    assert list(found) == ["tips", "annulus"]
    for name, expected in (("tips", TIPS), ("annulus", ANNULUS)):
        assert found[name].labels == expected.labels
        assert found[name].kind == expected.kind
        np.testing.assert_array_equal(found[name].points, expected.points)
    np.testing.assert_array_equal(found["tips"].point("posteromedial"), [4, 5, -6.25])


def test_the_members_that_slicer_reads(tmp_path: Path) -> None:
    content = json.loads(written(tmp_path).read_text())
    assert content["@schema"].endswith("/Markups/Resources/Schema/markups-schema-v1.0.3.json#")
    first = content["markups"][0]
    assert (first["type"], first["name"]) == ("Fiducial", "tips")
    assert (first["coordinateSystem"], first["coordinateUnits"]) == ("LPS", "mm")
    point = first["controlPoints"][1]
    assert point["label"] == "posteromedial"
    assert point["position"] == [4, 5, -6.25]
    assert point["positionStatus"] == "defined"
    assert content["markups"][1]["type"] == "ClosedCurve"
    assert content["markups"][1]["controlPoints"][0]["label"] == "annulus-1"


def test_what_slicer_writes_in_ras(tmp_path: Path) -> None:
    """As Slicer's documentation shows it: no units, no name, no more than positions and labels."""
    path = tmp_path / "a.mrk.json"
    path.write_text(
        '{"@schema": "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/'
        'Markups/Resources/Schema/markups-schema-v1.0.0.json#", "markups": [{"type": "Fiducial", '
        '"coordinateSystem": "RAS", "controlPoints": [{"label": "F-1", "position": [1, 2, 3.5]}]}]}'
    )
    (found,) = read_markups(path).values()
    np.testing.assert_array_equal(found.point("F-1"), [-1, -2, 3.5])


def point(content: Any) -> Any:
    return content["markups"][0]["controlPoints"][1]


Change = Callable[[Any], object]
BAD: dict[str, tuple[Change, str, str]] = {
    "no schema": (lambda c: c.pop("@schema"), "@schema", "text"),
    "another schema": (lambda c: c.update({"@schema": "x"}), "@schema", "markups-schema-v1"),
    "no lists": (lambda c: c.update(markups=[]), "markups", "at least one list"),
    "lists are none": (lambda c: c.update(markups={}), "markups", "a list"),
    "a list is none": (lambda c: c.update(markups=[3]), "markups[0]", "an object"),
    "a plane": (lambda c: c["markups"][0].update(type="Plane"), "markups[0].type", "Fiducial"),
    "no system": (
        lambda c: c["markups"][0].pop("coordinateSystem"),
        "markups[0].coordinateSystem",
        "LPS or RAS",
    ),
    "another system": (
        lambda c: c["markups"][1].update(coordinateSystem="IJK"),
        "markups[1].coordinateSystem",
        "LPS or RAS",
    ),
    "micrometres": (
        lambda c: c["markups"][0].update(coordinateUnits="um"),
        "markups[0].coordinateUnits",
        "mm",
    ),
    "the same name twice": (
        lambda c: c["markups"][1].update(name="tips"),
        "markups[1].name",
        "another name",
    ),
    "no points": (
        lambda c: c["markups"][0].update(controlPoints=[]),
        "markups[0].controlPoints",
        "at least one point",
    ),
    "no label": (
        lambda c: point(c).pop("label"),
        "markups[0].controlPoints[1].label",
        "text",
    ),
    "the same label twice": (
        lambda c: point(c).update(label="anterolateral"),
        "markups[0].controlPoints[1].label",
        "a label that no other point has",
    ),
    "two numbers": (
        lambda c: point(c).update(position=[1, 2]),
        "markups[0].controlPoints[1].position",
        "three numbers",
    ),
    "no number": (
        lambda c: point(c).update(position=[1, 2, True]),
        "markups[0].controlPoints[1].position",
        "three numbers",
    ),
    "not a number": (
        lambda c: point(c).update(position=[1, 2, float("nan")]),
        "markups[0].controlPoints[1].position",
        "three numbers",
    ),
    "not placed": (
        lambda c: point(c).update(positionStatus="undefined"),
        "markups[0].controlPoints[1].positionStatus",
        "a point that was placed",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    change, field, words = BAD[what]
    path = written(tmp_path)
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        read_markups(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: {field}: ")
    assert words in message.partition(", expected ")[2]
    assert "\n" not in message


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path)
    whole = path.read_bytes()
    for end in (len(whole) * n // 10 for n in range(10)):
        path.write_bytes(whole[:end])
        with pytest.raises(InputError, match=r"a\.mrk\.json: content: .*, expected JSON"):
            read_markups(path)


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ends in \.mrk\.json"):
        write_markups(tmp_path / "a.json", {"tips": TIPS})
    with pytest.raises(InputError, match="at least one"):
        write_markups(tmp_path / "a.mrk.json", {})
    with pytest.raises(InputError, match="no such file"):
        read_markups(tmp_path / "a.mrk.json")
    for labels, points in (
        (("a", "a"), np.zeros((2, 3))),
        (("a", ""), np.zeros((2, 3))),
        (("a",), np.zeros((2, 3))),
        (("a",), np.full((1, 3), np.nan)),
    ):
        with pytest.raises(InputError, match="expected"):
            PointList(labels, points)
    with pytest.raises(InputError, match="no point 'x', found anterolateral"):
        TIPS.point("x")
