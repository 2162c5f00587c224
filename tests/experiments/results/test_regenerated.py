"""Everything in a folder of results, made again from its records and sweeps."""

from experiments.cli import main
from experiments.results.published import publish
from experiments.studies.twin import STUDY
from experiments.sweeps.collected import Sweep, write_sweep_file
from experiments.sweeps.report import write_sweep
from tests.experiments.studies.made_up import made_up_twin
from tests.experiments.sweeps.made_up_sweeps import TRUTH, job, run, sweep


def publish_sweep(results, whole: Sweep) -> None:
    (results / "sweeps").mkdir(exist_ok=True)
    write_sweep_file(results / "sweeps" / f"{whole.name}.json", whole)
    write_sweep(results, whole)


def small(**changes) -> Sweep:
    jobs = [job({"filter": name}, [run(1, TRUTH * 1.02, [0.1, 0.1])]) for name in ("ekf", "iekf")]
    return sweep("filter", [*jobs, job({"filter": "lost"}, [], "killed (signal 9)")], **changes)


def test_tables_are_made_again_from_published_sweeps_alone(tmp_path, capsys) -> None:
    publish_sweep(tmp_path, small())
    before = {path.name: path.read_bytes() for path in tmp_path.glob("sweep_*")}
    for name in before:
        (tmp_path / name).unlink()
    assert main(["tables", str(tmp_path)]) == 0
    assert before == {path.name: path.read_bytes() for path in tmp_path.glob("sweep_*")}
    publish(STUDY, tmp_path, {"table1": (made_up_twin(), tmp_path / "no such folder")})
    assert main(["tables", str(tmp_path)]) == 0
    page = tmp_path / "table1.md"
    assert str(page) in capsys.readouterr().out
    assert page.is_file()
    (tmp_path / "sweeps" / "filter.json").write_text("{", encoding="utf-8")
    assert main(["tables", str(tmp_path)]) == 2
    assert "filter.json is not JSON" in capsys.readouterr().err


def test_an_empty_folder_still_says_what_to_run(tmp_path, capsys) -> None:
    assert main(["tables", str(tmp_path)]) == 2
    assert "experiment=table1" in capsys.readouterr().err
