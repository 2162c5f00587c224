"""What the documents say of the image step: settings, stages, landmarks, layout, links."""

import re
from dataclasses import fields

import pytest

from experiments.common.cases.own_case import ImagedInput
from experiments.studies.imaging.detectors import ImagingSettings
from tests.places import ROOT

OWN, PAGE = ROOT / "mvest" / "imaging" / "README.md", ROOT / "docs" / "volume.md"
SETTINGS = {"imaged": ImagedInput, "imaging": ImagingSettings}


@pytest.mark.parametrize(
    ("path", "parts"),
    [(OWN, ("imaged", "imaging")), (PAGE, ("imaged",))],
    ids=["imaging", "volume"],
)
def test_settings_that_are_named_exist(path, parts):
    text = path.read_text(encoding="utf-8")
    for part in parts:
        named = set(re.findall(rf"(?<![\w./]){part}\.(\w+)\b", text)) - {"md"}
        assert named, part
        assert named <= {f.name for f in fields(SETTINGS[part])}
