"""The page on adding a study, followed literally in a copy of the checkout."""

import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from tests.places import ROOT

SECTION = (ROOT / "docs" / "adding.md").read_text(encoding="utf-8").partition("## A study")[2]
SECTION = SECTION.partition("\n## ")[0]
NAME = re.compile(r"`((?:experiments|conf)/[\w/]+\.(?:py|yaml))`")
COMMAND = re.compile(r"^    mvest run (experiment=\w+)$", re.MULTILINE)


@pytest.mark.slow
def test_the_page_on_adding_a_study_works_literally(tmp_path):
    for name in ("experiments", "conf"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    # Text, block, text, ...: a block is of the file that was named last before it.
    parts = SECTION.split("```")
    files = {
        NAME.findall(said)[-1]: block.partition("\n")[2]
        for said, block in zip(parts[::2], parts[1::2], strict=False)
    }
    assert set(files) == {"experiments/studies/tenting.py", "conf/experiment/tenting.yaml"}
    lines = [line for content in files.values() for line in content.splitlines() if line.strip()]
    assert len(lines) <= 40
    for place, content in files.items():
        path = tmp_path / place
        assert not path.exists(), f"{place} is no new file"
        path.write_text(content, encoding="utf-8")
    (command, *_) = COMMAND.findall(SECTION)
    subprocess.run(
        [sys.executable, "-m", "experiments.run", command],
        cwd=tmp_path,
        check=True,
        capture_output=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
    )
    results = tmp_path / "outputs" / "results"
    table = pd.read_csv(results / "tenting.csv", comment="#")
    assert list(table["pressure [mmHg]"]) == [80.0, 100.0, 120.0]
    # A higher pressure pushes the leaflets further towards the atrium.
    assert (np.diff(table["height [mm]"]) < 0).all()
    assert (results / "tenting.png").stat().st_size > 10_000
    assert f"| {table['height [mm]'][0]:.2f} |" in (results / "tenting.md").read_text()
