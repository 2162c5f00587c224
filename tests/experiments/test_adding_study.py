"""The page on adding a study, followed to the letter in a copy of the checkout."""

import os
import re
import shutil
import subprocess
import sys

import pandas as pd

from tests.places import ROOT

PAGE = ROOT / "docs" / "adding_study.md"
FILE = re.compile(r"```\{code-block\} \w+\n:caption: (\S+)\n(.*?)```", re.DOTALL)
COMMAND = re.compile(r"^\$ python (.*)$", re.MULTILINE)


def test_the_page_on_adding_a_study_works_to_the_letter(tmp_path):
    text = PAGE.read_text(encoding="utf-8")
    for name in ("experiments", "conf"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    files = FILE.findall(text)
    assert {place.split("/")[0] for place, _ in files} == {"experiments", "conf"}
    rooms = {place.rpartition("/")[0] for place, _ in files}
    assert rooms == {"experiments/studies/sizes", "conf/experiment"}
    for place, content in files:
        path = tmp_path / place
        assert not path.exists(), f"{place} is no new file"
        path.parent.mkdir(exist_ok=True)
        path.write_text(content, encoding="utf-8")
    commands = [command.split() for command in COMMAND.findall(text)]
    assert len(commands) == 2
    for command in commands:
        subprocess.run(
            [sys.executable, *command],
            cwd=tmp_path,
            check=True,
            capture_output=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
        )
    results = tmp_path / "results"
    assert (results / "records" / "sizes" / "sizes.json").is_file()
    assert list(pd.read_csv(results / "sizes.csv", comment="#")["rows"]) == [6, 12, 24]
    assert (results / "sizes.png").stat().st_size > 10_000
    page = (results / "report.html").read_text(encoding="utf-8")
    assert "Areas of the leaflets (simulated)" in page
    assert "With 6 rows the anterior leaflet is" in page
