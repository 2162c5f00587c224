import csv
import json
from dataclasses import asdict, replace

import pytest

from experiments.sweeps.collected import Sweep
from experiments.sweeps.report import read_sweeps, write_sweep
from mvest.errors import InputError
from mvest.provenance import sealed
from tests.experiments.sweeps.synthetic_sweeps import (
    ALL,
    TRUTH,
    all_failed,
    empty,
    job,
    noise,
    run,
    sweep,
)

HOSTILE = r"<b>x</b> | 5 % & $y$ \input{z}_1"


def small() -> Sweep:
    jobs = [
        job({"filter": name}, [run(1, TRUTH * 1.01, [0.1, 0.1])] if name != "c" else [], "dead")
        for name in "abc"
    ]
    return sweep("filter", jobs)


def contents(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_everything_of_a_sweep_stands_side_by_side(tmp_path) -> None:
    written = write_sweep(tmp_path, small())
    assert {path.name for path in written} == set(contents(tmp_path)) == {
        "sweep_filter.csv", "sweep_filter_table.csv", "sweep_filter_table.md",
        "sweep_filter_table.tex", "sweep_filter_cost.csv", "sweep_filter.png", "sweep_filter.pdf",
        "sweep_filter_cost.png", "sweep_filter_cost.pdf",
    }  # fmt: skip
    with (tmp_path / "sweep_filter.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    assert [row["reason"] for row in rows][2] == "dead"
    assert b"simulated" in (tmp_path / "sweep_filter.png").read_bytes()


def test_equal_sweeps_give_equal_files_whenever_they_ran(tmp_path) -> None:
    first = small()
    # What may differ between an undisturbed sweep and one that was killed and taken up again.
    source = replace(first.provenance, finished="2031-01-01T00:00:00Z", cpu_count=99, machine="x")
    second = replace(first, truth_hits=7, truth_misses=9, provenance=source)
    for name, whole in (("a", first), ("b", second)):
        (tmp_path / name).mkdir()
        write_sweep(tmp_path / name, whole)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    third = replace(
        second,
        cost=tuple(replace(entry, seconds_total=1e3) for entry in second.cost),
        jobs=tuple(
            replace(job, runs=tuple(replace(run, seconds=1e3) for run in job.runs))
            for job in second.jobs
        ),
    )
    write_sweep(tmp_path / "b", third)
    before, after = contents(tmp_path / "a"), contents(tmp_path / "b")
    changed = {name for name in before if before[name] != after[name]}
    assert "sweep_filter_cost.csv" in changed
    assert all("_cost" in name for name in changed)


def test_hostile_names_act_in_no_file(tmp_path) -> None:
    whole = sweep("filter", [job({"filter": HOSTILE}, [], HOSTILE, row=HOSTILE)], title=HOSTILE)
    write_sweep(tmp_path, whole)
    markdown = (tmp_path / "sweep_filter_table.md").read_text(encoding="utf-8")
    assert "<b>" not in markdown
    assert len({line.replace(r"\|", "").count("|") for line in markdown.splitlines()
                if line.startswith("|")}) == 1  # fmt: skip
    tex = (tmp_path / "sweep_filter_table.tex").read_text(encoding="utf-8")
    body = "\n".join(line for line in tex.splitlines() if not line.startswith("%"))
    assert r"\input" not in body
    assert r"\textbackslash{}input\{z\}\_1" in body
    with (tmp_path / "sweep_filter.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    assert rows[0]["filter"] == HOSTILE


@pytest.mark.parametrize("kind", list(ALL))
@pytest.mark.parametrize("whole", [empty, all_failed])
def test_sweeps_without_any_result_stay_readable(tmp_path, kind: str, whole) -> None:
    written = {path.name for path in write_sweep(tmp_path, whole(kind))}
    assert f"sweep_{kind}.csv" in written
    text = (tmp_path / f"sweep_{kind}_table.md").read_text(encoding="utf-8")
    said = "The sweep has no jobs" if whole is empty else "None of the "
    assert said in text
    assert "nan" not in text
    header = (tmp_path / f"sweep_{kind}.csv").read_text(encoding="utf-8").splitlines()[2]
    assert "reason" in header


def test_a_picture_that_no_longer_holds_is_taken_away(tmp_path) -> None:
    write_sweep(tmp_path, small())
    assert (tmp_path / "sweep_filter.png").exists()
    write_sweep(tmp_path, empty("filter"))
    assert not list(tmp_path.glob("*.png"))
    assert not list(tmp_path.glob("*.pdf"))


def test_a_sweep_cannot_write_elsewhere(tmp_path) -> None:
    whole = replace(small(), sweep={"name": "../x", "kind": "filter"})
    with pytest.raises(InputError, match="letters, digits"):
        write_sweep(tmp_path, whole)


def test_an_unwritable_place_is_one_clear_error(tmp_path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        write_sweep(tmp_path / "file", empty("filter"))


def test_published_sweeps_are_read_back_and_damage_is_named(tmp_path) -> None:
    assert read_sweeps(tmp_path) == []
    (tmp_path / "sweeps").mkdir()
    (tmp_path / "sweeps" / "noise.json").write_text(json.dumps(sealed(asdict(noise(2)))))
    assert read_sweeps(tmp_path) == [noise(2)]
    changed = sealed(asdict(noise(2))) | {"title": "Better"}
    (tmp_path / "sweeps" / "noise.json").write_text(json.dumps(changed))
    with pytest.raises(InputError, match=r"noise\.json: its content is not what was written"):
        read_sweeps(tmp_path)
    (tmp_path / "sweeps" / "a.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"a\.json is not JSON"):
        read_sweeps(tmp_path)
    (tmp_path / "sweeps" / "a.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match=r"a\.json is no collected sweep: it lacks schema"):
        read_sweeps(tmp_path)
