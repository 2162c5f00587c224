"""Which published results are stale; and renewing them makes these and no others."""

import sys
from contextlib import closing
from pathlib import Path

import pytest

from experiments import cli
from experiments.cli import comment_of
from experiments.common.records.record import Record, read_record, write_record
from experiments.results.published import records_of, write_records
from experiments.results.renewal import (
    Configured,
    chosen,
    published,
    share,
    status_of,
    without_records,
)
from experiments.runner import engine, sweep
from experiments.runner.jobs import mark_done
from experiments.runner.sweep import share_of
from mvest.provenance import NUMBERS
from tests.places import ROOT

FAKE = str(Path(__file__).parents[1] / "runner" / "fake_worker.py")
RESULTS, TABLE = Path("results"), "mesh_independence"


@pytest.fixture
def mvest(tmp_path, monkeypatch, capsys):
    """``mvest results`` in an empty folder, with jobs that take no time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(engine, "WORKER", (sys.executable, FAKE))
    monkeypatch.setattr("experiments.results.published.write_results", lambda *_: [])

    def call(*words: str) -> tuple[int, str]:
        status = cli.main(["results", *words])
        said = capsys.readouterr()
        return status, said.out + said.err

    return call


def runs() -> int:
    place = Path("runs")
    return len(place.read_text().split()) if place.exists() else 0


def found(name: str = TABLE) -> tuple[int, int, int, str]:
    (one,) = (one for one in published() if one.name == name)
    status = status_of(one, RESULTS)
    return status.present, status.missing, status.stale, status.why


def changed(name: str, **source) -> Record:
    """Change the provenance of a published record."""
    records = dict(records_of(RESULTS, TABLE).records)
    before = records[name].provenance
    records[name] = records[name].model_copy(
        update={"provenance": before.model_copy(update=source)}
    )
    write_records(RESULTS, TABLE, records)
    return records[name]


def names() -> list[str]:
    return sorted(name for name in records_of(RESULTS, TABLE).records if "hex18" in name)


def test_what_is_missing_or_stale_is_made_and_nothing_twice(mvest):
    assert found() == (0, 5, 0, "")
    # A table may have several configurations.
    assert mvest(TABLE, "--run")[0] == 0
    assert (runs(), found(), found(f"{TABLE}_unstructured")[0]) == (6, (5, 0, 0, ""), 1)
    assert mvest(TABLE, "--run")[0] == 0
    assert runs() == 6

    first, second, *_ = names()
    changed(first, config_hash="0" * 64)
    assert found() == (4, 0, 1, "configuration")
    old = changed(second, numbers={"twin": NUMBERS["twin"] - 1})
    assert found() == (3, 0, 2, "numbers and configuration")
    # What was run with the numbers of before is no finished run either.
    (place,) = Path("outputs").glob(f"*/{old.provenance.config_hash[:16]}/result.json")
    write_record(place, read_record(place).model_copy(update={"provenance": old.provenance}))
    mark_done(place.parent)
    status, said = mvest(TABLE, "--run")
    assert status == 0
    assert "2 stale" not in said
    assert (runs(), found()) == (7, (5, 0, 0, ""))


def test_a_record_of_no_job_is_stale_and_goes_with_its_renewal(mvest):
    assert mvest(TABLE, "--run")[0] == 0
    records = dict(records_of(RESULTS, TABLE).records)
    write_records(RESULTS, TABLE, {**records, "gone": records[names()[0]]})
    assert found() == (5, 0, 1, "configuration")
    assert mvest(TABLE, "--run")[0] == 0
    assert (runs(), found(), "gone" in records_of(RESULTS, TABLE).records) == (
        6,
        (5, 0, 0, ""),
        False,
    )


def test_a_failed_job_is_named_and_tried_again(mvest):
    Path("raise-1").touch()
    status, said = mvest("sweep_truths", "--run")
    assert status == 1
    assert "failed: " in said
    assert "it broke" in said
    # A sweep is published with its failures.
    assert found("sweep_truths") == (4, 0, 0, "")


def test_a_study_without_its_data_publishes_nothing(mvest, monkeypatch):
    monkeypatch.setenv("MVEST_TRIVALVE", "nowhere")
    status, said = mvest("donor_diseased", "--run")
    assert status == 1
    assert "failed: donor_diseased: donor.recording = nowhere: there is no folder" in said
    assert (runs(), RESULTS.exists()) == (0, False)


def test_shards_end_in_one_sweep(mvest):
    counts = []
    for k in (1, 2):
        assert found("sweep_truths") == (0, 4, 0, "")
        assert mvest("sweep_truths", "--run", "--shard", f"{k}/2")[0] == 0
        counts.append(runs())
    assert counts == [2, 4]
    assert found("sweep_truths") == (4, 0, 0, "")
    assert mvest("sweep_truths", "--run", "--shard", "2/2")[0] == 0
    assert runs() == 4


def interrupt_after_one(monkeypatch):
    real = sweep.run_jobs

    def interrupted(*given):
        with closing(real(*given)) as ends:  # its workers stop, as they do for a user's interrupt
            yield next(ends)
            raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "run_jobs", interrupted)
    return real


def test_new_records_are_never_published_beside_stale_ones(mvest, monkeypatch):
    assert mvest(TABLE, "--run")[0] == 0
    for name in names():
        changed(name, config_hash="0" * 64, numbers={"twin": NUMBERS["twin"] - 1})
    assert found() == (0, 0, 5, "numbers")
    engine._idle.clear()
    interrupt_after_one(monkeypatch)
    for place in Path("outputs").glob("*/*/done"):
        place.unlink()
    assert mvest(TABLE, "--run")[0] == 130
    present, missing, stale, _ = found()
    assert (present + missing, stale) == (5, 0)
    assert present >= 1


def test_an_interrupt_leaves_what_is_finished(mvest, monkeypatch):
    real = interrupt_after_one(monkeypatch)
    assert mvest(TABLE, "--run")[0] == 130
    done = {path: path.stat().st_mtime_ns for path in Path("outputs").glob("*/*/done")}
    assert found()[0] == len(done) >= 1
    monkeypatch.setattr(sweep, "run_jobs", real)
    engine._idle.clear()  # its workers were stopped for good
    assert mvest(TABLE, "--run")[0] == 0
    assert found()[0] == 5
    assert {path: path.stat().st_mtime_ns for path in done} == done


def test_a_job_that_was_cut_off_is_not_published_as_failed(mvest, monkeypatch):
    Path("raise-1").touch()
    real = sweep.run_jobs

    def interrupted(*given):
        list(real(*given))
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(sweep, "run_jobs", interrupted)
    # All have the seed 1, so one has failed.
    assert mvest(TABLE, "--run")[0] == 130
    assert found()[:2] == (4, 1)


def test_shards_partition_the_jobs_of_everything_published():
    every = [(one.name, k) for one in published() for k in range(one.jobs)]
    parts = [
        [
            (one.name, k)
            for one in published()
            for k in share(one, range(one.jobs), share_of(f"{n}/3"))
        ]
        for n in (1, 2, 3)
    ]
    assert sorted(one for part in parts for one in part) == sorted(every)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("name", ["sweep_truths", "mesh_independence_unstructured", "surfaces"])
def test_jobs_are_counted_without_composing_them(name, tmp_path):
    (one,) = (one for one in published() if one.name == name)
    plan = one.plan(tmp_path)
    assert one.jobs == len(plan.jobs)
    assert {job.values["table"] for job in plan.jobs} == {one.table}
    assert all(job.publish_as for job in plan.jobs) or plan.publish
    assert Path(plan.common["paths"]["results"]) == tmp_path


def test_nothing_is_composed_for_records_of_other_numbers(mvest, monkeypatch):
    assert mvest(f"{TABLE}_unstructured", "--run")[0] == 0
    changed(f"{TABLE}_unstructured", numbers={})
    monkeypatch.setattr(Configured, "plan", None)
    assert found(f"{TABLE}_unstructured") == (0, 0, 1, "numbers")


def test_every_page_of_results_is_published_or_known_to_be_without_records():
    pages = {path.stem for path in (ROOT / "results").glob("*.md")}
    tables = {one.table for one in published()}
    assert pages - tables == set(without_records(ROOT / "results"))
    # A study that was never run has neither page nor records.
    records = ROOT / "results" / "records"
    assert not [one for one in tables - pages if (records / f"{one}.jsonl").exists()]
    # The mode is inherited, the seeds are its own.
    (one,) = chosen(["volumes_calibration"])
    assert (one.jobs, one.has_many) == (60, True)
    with_names = [one.name for one in published()]
    assert len(set(with_names)) == len(with_names)
    assert {one.name for one in chosen(["table1"])} > {"table1", "table1_tet4"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing"], "nothing: no published study; known: calibration, "),
        (["--shard=3/2"], "shard 3/2"),
    ],
)
def test_a_wrong_request_is_refused_in_one_line(words, message, mvest):
    status, said = mvest(*words)
    assert status == 2
    (line,) = said.splitlines()
    assert line.startswith(f"error: {message}")


def test_a_comment_is_read_without_its_package():
    assert comment_of("# @package _global_\n# One,\n# two.\nname: a\n# three\n") == "One, two."
