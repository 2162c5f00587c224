"""The folder of a job: what an attempt leaves for the next one."""

from experiments.runner.jobs.folder import DONE, RESULT, clear
from mvest.files import PREFIX


def test_what_an_earlier_attempt_left_is_taken_away_and_nothing_else(tmp_path):
    kept = {".lock", ".hidden.png", "config.json", "valve.png"}
    for name in (*kept, DONE, RESULT, f"{PREFIX}1-result.json", f"{PREFIX}2-valve.png"):
        (tmp_path / name).touch()
    (tmp_path / f"{PREFIX}3-case").mkdir()
    (tmp_path / f"{PREFIX}3-case" / "case.yaml").touch()
    clear(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == kept
