"""Collected sweeps: their file, what is published of them, and what is refused."""

import json

import pytest

from experiments.sweeps.collected import Sweep, read_sweep, write_sweep_file
from experiments.sweeps.report import write_sweep
from mvest.errors import InputError
from tests.experiments.sweeps.made_up_sweeps import TRUTH, job, lost, run, sweep

HOSTILE = r"<b>x</b> | 5 % & $y$ \input{z}_1"


def small() -> Sweep:
    jobs = [
        job({"filter": name}, [run(1, TRUTH * 1.01, [0.1, 0.1])] if name != "c" else [], "dead")
        for name in "abc"
    ]
    return sweep("filter", jobs)


def contents(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("whole", [small(), lost(small()), sweep("x", [job({}, [])])])
def test_a_sweep_comes_back_from_its_file(tmp_path, whole):
    write_sweep_file(tmp_path / "a.json", whole)
    back = read_sweep(tmp_path / "a.json")
    assert [one.hash for one in back.jobs] == [one.hash for one in whole.jobs]
    for ours, theirs in zip(back.records, whole.records, strict=True):
        assert (ours.status, ours.row, ours.factors) == (theirs.status, theirs.row, theirs.factors)
        assert [one.unknowns for one in ours.estimates] == [
            one.unknowns for one in theirs.estimates
        ]
    write_sweep_file(tmp_path / "b.json", back)
    assert contents(tmp_path)["a.json"] == contents(tmp_path)["b.json"]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda s: s.pop("jobs"), "jobs: .*Field required"),
        (lambda s: s.update(version=2), "version"),
        (lambda s: s.update(jobs=[3]), r"there\.json: jobs\.0: 3, expected"),
        (lambda s: s.update(title="Better"), "content is not what was written"),
    ],
)
def test_a_damaged_sweep_is_named(tmp_path, damage, words):
    path = tmp_path / "there.json"
    write_sweep_file(path, small())
    data = json.loads(path.read_text())
    damage(data)
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=words):
        read_sweep(path)


def test_hostile_names_act_in_no_file(tmp_path):
    whole = sweep("filter", [job({"filter": HOSTILE}, [], HOSTILE, row=HOSTILE)])
    write_sweep(tmp_path, whole)
    markdown = (tmp_path / "sweep_filter.md").read_text(encoding="utf-8")
    assert "<b>" not in markdown
    rows = [line for line in markdown.splitlines() if line.startswith("|")]
    assert len({line.replace(r"\|", "").count("|") for line in rows}) == 1
    tex = (tmp_path / "sweep_filter_table.tex").read_text(encoding="utf-8")
    body = "\n".join(line for line in tex.splitlines() if not line.startswith("%"))
    assert r"\input" not in body
    assert r"\textbackslash input\{z\}\_1" in body


def test_a_picture_that_no_longer_holds_is_taken_away(tmp_path):
    write_sweep(tmp_path, small())
    assert (tmp_path / "sweep_filter.png").exists()
    write_sweep(tmp_path, lost(small()))
    assert not list(tmp_path.glob("*.png"))
    assert ".png" not in (tmp_path / "sweep_filter.md").read_text(encoding="utf-8")


def test_a_sweep_cannot_write_elsewhere_and_says_where_it_cannot(tmp_path):
    with pytest.raises(InputError, match="letters, digits"):
        write_sweep(tmp_path, small().model_copy(update={"name": "../x"}))
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        write_sweep(tmp_path / "file", lost(small()))
