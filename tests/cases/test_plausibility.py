"""What is hardly so in a case: the example is in order, and each mistake in it is named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.cases.folder import read_case
from mvest.cases.plausibility import implausible_values, require_plausible
from mvest.errors import InputError
from mvest.observation.errors import SpatialCorrelation
from tests.cases.folders import nested

EXAMPLE = Path(__file__).parents[2] / "examples" / "case"


@pytest.fixture(scope="module")
def case():
    return read_case(EXAMPLE)


def with_frame(case, role, **changes):
    frames = (replace(f, **changes) if f.role is role else f for f in case.frames)
    return replace(case, frames=tuple(frames))


def with_surface(case, **changes):
    surface = replace(case.surface, **changes)
    frames = tuple(replace(f, region=surface.region) if f.corresponds else f for f in case.frames)
    return replace(case, surface=surface, frames=frames)


def moved(case, how):
    """The closed frame with its vertices moved, the curves with them."""
    closed = case.frame(Role.CLOSED)
    x = how(closed.vertices)
    loops = {"annulus": x[case.annulus], "free_edge": x[case.free_edge]}
    return with_frame(case, Role.CLOSED, vertices=x, **loops)


def test_the_example_is_in_order(case):
    assert implausible_values(case) == ()
    require_plausible(case)
    with pytest.raises(InputError, match=r"is not plausible: .*kPa.*; .*tip"):
        require_plausible(under(16.0)(tips_away(case)))


def test_a_chord_is_as_long_as_the_way_along_its_branches(case):
    # Its segments are shorter than any chord, its way is about as long as before.
    tips, chordae = case.frame(Role.REFERENCE).papillary_tips, case.chordae
    trees = nested(chordae, tips, 0.95)
    # In the open valve the template's chordae are slack.
    trees = replace(trees, rest_length=1.3 * trees.rest_length)
    assert np.linalg.norm(np.diff(trees.ends(tips), axis=1), axis=2).min() < 1.5
    assert implausible_values(replace(case, chordae=trees)) == ()


@pytest.mark.parametrize("seed", range(2))
def test_errors_of_an_image_are_no_mistake(case, seed):
    """1 mm correlated over 10 mm, or 0.3 mm at each vertex independently."""
    rng = np.random.default_rng(seed)
    n = len(case.surface.vertices)
    factor = SpatialCorrelation(case.surface.vertices, 10.0).factor
    for error in (factor @ rng.standard_normal((n, 3)), 0.3 * rng.standard_normal((n, 3))):
        assert implausible_values(moved(case, lambda x, error=error: x + error)) == ()


def exchanged_frames(case):
    """Open and closed shapes in each other's place."""
    open_, closed = case.frame(Role.REFERENCE), case.frame(Role.CLOSED)
    shapes = ("vertices", "annulus", "free_edge", "papillary_tips")
    other = with_frame(case, Role.REFERENCE, **{k: getattr(closed, k) for k in shapes})
    other = with_frame(other, Role.CLOSED, **{k: getattr(open_, k) for k in shapes})
    return with_surface(other, vertices=closed.vertices)


def shrunken(case):
    """A closed shape made by hand: everything drawn together in the middle of the valve."""
    middle = case.frame(Role.CLOSED).annulus.mean(axis=0)
    return moved(case, lambda x: middle + (x - middle) * [0.5, 0.5, 1.0])


def shuffled(case):
    """Vertices of the closed frame in another order than those of the open one."""
    order = np.random.default_rng(0).permutation(len(case.surface.vertices))
    closed = case.frame(Role.CLOSED)
    return with_frame(case, Role.CLOSED, vertices=closed.vertices[order])


def under(mmhg):
    return lambda case: with_frame(case, Role.CLOSED, pressure_mmHg=mmhg)


def tips_away(case):
    tips = case.frame(Role.CLOSED).papillary_tips
    return with_frame(case, Role.CLOSED, papillary_tips=tips - [0.0, 0.0, 20.0])


@pytest.mark.parametrize(
    ("made", "field", "words", "mistake"),
    [
        (
            lambda case: with_surface(case, region=1 - case.surface.region),
            "regions", "are they exchanged?", True,
        ),
        (exchanged_frames, "frames", "are the frames exchanged?", True),
        (shrunken, "frames.closed.surface", "area of the anterior leaflet", False),
        (shuffled, "frames.closed.surface", "do its vertices correspond?", True),
        (
            lambda case: with_surface(case, thickness=0.1 * case.surface.thickness),
            "thickness", "is it in cm?", True,
        ),
        (under(16.0), "frames.pressure", "is it in kPa?", True),
        (under(40.0), "frames.pressure", "is 40 mmHg, expected 60 to 200 mmHg", False),
        (tips_away, "frames.closed.papillary_tips", "motion of a tip is 20 mm", False),
        (
            lambda case: replace(
                case, chordae=replace(case.chordae, rest_length=2 * case.chordae.rest_length)
            ),
            "frames.closed.papillary_tips", "half of the chordae", False,
        ),
    ],
)  # fmt: skip
def test_each_mistake_is_named(case, made, field, words, mistake):
    found = [v for v in implausible_values(made(case)) if v.field == field and words in v.text]
    assert {value.mistake for value in found} == {mistake}


def test_the_pressure_of_every_fitted_frame_is_checked(case):
    closed = case.frame(Role.CLOSED)
    second = replace(
        closed, name="second", role=Role.FITTED, time=closed.time + 0.01, pressure_mmHg=10.7
    )
    (doubt,) = implausible_values(replace(case, frames=(*case.frames, second)))
    assert (doubt.field, doubt.mistake) == ("frames.second.pressure", True)
    assert "is it in kPa?" in doubt.text
