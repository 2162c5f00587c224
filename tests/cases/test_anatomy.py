"""A case of one open frame alone: what is there is read, drawn and written; nothing is fitted."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.cases.folder import read_case, write_case
from mvest.cases.tissue import CLOSED_DEPTH, assumed_closure, lay_out_chordae
from mvest.errors import InputError
from mvest.valve.anatomy.dimensions import ChordLayout
from tests.cases.folders import band_of, plain_folder, save, template_case
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
    # Its boundary stays where it is.
    motion = back.valve.motion
    for positions in (motion.annulus, motion.papillary_tips):
        np.testing.assert_array_equal(positions[0], positions[1])


def test_the_closed_frame_is_asked_for_in_one_line(anatomy):
    with pytest.raises(InputError, match=r"case template: no closed frame.*valve=folder") as raised:
        anatomy.frame(Role.CLOSED)
    assert "\n" not in str(raised.value)
    held = replace(template_case(40, 12).frames[1], time=0.5)
    with pytest.raises(InputError, match="0 frames have the role closed"):
        replace(anatomy, frames=(*anatomy.frames, held))


def test_chordae_of_an_open_frame_alone_are_long_enough_to_close_it(tmp_path):
    document = plain_folder(tmp_path / "case", 40, 12)
    document["frames"] = document["frames"][:1]
    del document["chordae"]
    case = read_case(save(tmp_path / "case", document))
    assert any("an assumed closure: the free edges meet" in each for each in case.derived)
    # By the slack that the template gives them at a closure that is intended, as this one is.
    band, frame = band_of(case), case.frames[0]
    goal = assumed_closure(band, frame.annulus, frame.papillary_tips)
    tips = frame.papillary_tips
    expected = lay_out_chordae(band, tips, goal, tips, ChordLayout()).rest_length
    np.testing.assert_allclose(case.chordae.rest_length, expected, rtol=1e-9)


def test_an_assumed_closure_brings_the_edges_together(anatomy):
    band = band_of(anatomy)
    frame = anatomy.frames[0]
    closed = assumed_closure(band, frame.annulus, frame.papillary_tips)
    np.testing.assert_allclose(closed[anatomy.annulus], frame.annulus, atol=1e-9)
    phi = np.linspace(10.0, 170.0, 9)
    moved = replace(band, vertices=closed)
    gap = moved.position(phi, np.ones(9)) - moved.position(360.0 - phi, np.ones(9))
    before = band.position(phi, np.ones(9)) - band.position(360.0 - phi, np.ones(9))
    assert np.linalg.norm(gap, axis=1).max() < 0.5 < 5.0 < np.linalg.norm(before, axis=1).max()
    middle = frame.annulus[:, 2].mean()
    depth = closed[anatomy.free_edge, 2].mean() - middle
    assert depth == pytest.approx(CLOSED_DEPTH * (frame.free_edge[:, 2].mean() - middle), rel=0.02)
