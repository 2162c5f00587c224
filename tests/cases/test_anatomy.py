"""A case of one open frame alone: what is there is read, drawn and written; nothing is fitted."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.run import main
from mvest.cases.case import Role
from mvest.cases.folder import read_case
from mvest.cases.plausibility import doubts
from mvest.cases.writer import write_case
from mvest.errors import InputError
from tests.cases.folders import plain_folder, save, template_case
from tests.cases.test_folder import assert_equal


@pytest.fixture
def anatomy():
    case = template_case(40, 12)
    return replace(case, frames=case.frames[:1], derived=())


def test_an_open_frame_alone_comes_back_as_it_was_written(tmp_path, anatomy):
    back = read_case(write_case(tmp_path / "case", anatomy))
    assert_equal(back, anatomy, "sha256")
    assert back.closed is None
    assert str(back).splitlines()[2] == "frames: open (reference, -0.333 mmHg)"


def test_its_boundary_stays_where_it_is(anatomy):
    motion = anatomy.valve.motion
    for positions in (motion.annulus, motion.papillary_tips):
        np.testing.assert_array_equal(positions[0], positions[1])


def test_the_closed_frame_is_asked_for_in_one_line(anatomy):
    with pytest.raises(InputError, match=r"case template: no closed frame.*valve=folder") as raised:
        anatomy.frame(Role.CLOSED)
    assert "\n" not in str(raised.value)
    held = replace(template_case(40, 12).frames[1], time=0.5)
    with pytest.raises(InputError, match="0 frames with the role closed"):
        replace(anatomy, frames=(*anatomy.frames, held))


def test_what_is_there_is_judged(anatomy):
    assert {doubt.field for doubt in doubts(anatomy)} == set()
    exchanged = replace(anatomy.surface, region=1 - anatomy.surface.region)
    assert "regions" in {doubt.field for doubt in doubts(replace(anatomy, surface=exchanged))}


def test_chordae_are_laid_out_by_the_open_frame_alone(tmp_path):
    document = plain_folder(tmp_path / "case", 40, 12)
    document["frames"] = document["frames"][:1]
    del document["chordae"]
    case = read_case(save(tmp_path / "case", document))
    reach = np.linalg.norm(
        case.chordae.insertion - case.frames[0].papillary_tips[case.chordae.tip], axis=1
    )
    np.testing.assert_allclose(case.chordae.rest_length, 1.035 * reach)
    assert any("there is no closed one" in sentence for sentence in case.derived)


def test_it_is_checked_and_no_estimate_is_made_of_it(tmp_path, anatomy, monkeypatch, capsys):
    folder = write_case(tmp_path / "case", anatomy)
    command = ["run", "experiment=own_valve", f"case={folder}", f"paths.outputs={tmp_path / 'out'}"]
    command += ["tracking.enabled=false", "personal.mesh.source=structured"]
    monkeypatch.setattr("sys.argv", [*command, "check=true"])
    assert main() == 0
    said = capsys.readouterr().out
    assert "In order; drawn in" in said
    assert "an open frame alone, from which nothing can be estimated" in said
    assert list((tmp_path / "out").rglob("case.svg")) or list((tmp_path / "out").rglob("case.png"))
    monkeypatch.setattr("sys.argv", command)
    assert main() == 2
    assert "no closed frame, so there is nothing to estimate from" in capsys.readouterr().err
