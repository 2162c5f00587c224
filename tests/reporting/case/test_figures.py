"""Pictures of one case. Fields are made up; see `tests.reporting.case.made_up_case`."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PolyCollection, QuadMesh

from mvest.problem.fields import as_stored, case_fields, chord_fields, turn_of, valve_fields
from mvest.reporting.case.drawing import (
    LINE_PIECES,
    leak_of,
)
from mvest.reporting.case.figures import case_figure, estimates_figure, frames_figure, shapes_figure
from mvest.reporting.case.view import states_of
from mvest.reporting.figures import ATRIUM, SIDE
from mvest.valve.anatomy.template import Template
from tests.closure.branching import branching
from tests.made_up_closure import TEMPLATE, VALVE
from tests.made_up_closure import made_up_case as case_of_frames
from tests.reporting.case.made_up_case import COLUMNS, made_up_case

STRAIGHT = Template(TEMPLATE.parameters.changed({"chordae.branches": 1})).chordae()
BRANCHED = branching(STRAIGHT, VALVE.papillary_tips)
NAMES = ("anterior", "posterior")
LINES = 2 * COLUMNS * LINE_PIECES
"""Pieces of the annulus and of the free edge."""


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return made_up_case(tmp_path_factory.mktemp("case"))


@pytest.fixture(scope="module")
def fields(case):
    return case_fields(case[1])


def faces(axes):
    (drawn,) = (c for c in axes.collections if isinstance(c, PolyCollection))
    return drawn


def leaks(axes):
    return [drawn for drawn in axes.collections if isinstance(drawn, QuadMesh)]


def pieces(axes, fields) -> int:
    """Into how many parts each triangle is drawn."""
    each, rest = divmod(len(faces(axes).get_paths()) - LINES, len(fields.triangles))
    assert rest == 0
    return each


def test_a_valve_is_turned_the_same_way_however_it_lies(case, fields) -> None:
    turn = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    with np.load(case[1]) as stored:
        arrays = dict(stored)
    shapes = ("rest", "observed", "generic", "registered", "fitted", "truth", "tips")
    for name in (*shapes, "chord_junction"):
        arrays[name] = arrays[name] @ turn.T + [50.0, -20.0, 300.0]
    turned = case_fields(arrays)
    for name in ("rest", "observed", "tips", "chord_junction"):
        np.testing.assert_allclose(getattr(turned, name), getattr(fields, name), atol=1e-9)
    # The atrium is above and the first leaflet in front, and nothing is mirrored: the template's
    # first commissure, at phi = 0, lies at positive x.
    assert fields.tips[..., 2].max() < fields.rest[fields.annulus][:, 2].min()
    assert fields.rest[fields.vertex_region == 0].mean(axis=0)[1] > 2.0
    assert fields.rest[fields.annulus[0], 0] > 10.0
    np.testing.assert_allclose(ATRIUM.axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(SIDE.axes) == pytest.approx(1)
    assert SIDE.axes[2, 1] > 0.9


def test_both_panels_of_figure_3_have_one_scale(fields) -> None:
    """2 mm everywhere next to 1 mm: each on a scale of its own, they would look alike."""
    two = np.full_like(fields.distance_generic, 2.0)
    same_shape = replace(
        fields, fitted=fields.generic, distance_generic=two, distance_fitted=two / 2
    )
    figure = case_figure(same_shape)
    (bar,) = [axes for axes in figure.axes if axes.get_ylabel().endswith("[mm]")]
    assert bar.get_ylim() == (0.0, 2.0)
    left, right = (faces(axes).get_facecolor() for axes in figure.axes[:2])
    different = np.abs(left - right).max(axis=1) > 0.2
    # All but the lines.
    assert different.sum() == len(fields.triangles) * pieces(figure.axes[0], fields)


def test_figure_3_draws_the_frame_that_was_shown_to_the_filter_and_greys_the_unseen(fields) -> None:
    for k, seen in enumerate(([True, False], [False, True])):
        figure = case_figure(replace(fields, seen=np.array(seen)))
        off = fields.distance_generic[k]
        title = f"generic stiffness\n{np.nanmean(off):.2f} ± {np.nanstd(off):.2f} mm"
        assert figure.axes[0].get_title() == title
        assert figure.axes[1].get_title().startswith("personalised stiffness")
        touched = np.isnan(off)[fields.triangles].any(axis=1).sum()
        # Lines have equal red, green and blue as well, but are darker.
        colour = faces(figure.axes[0]).get_facecolor()
        grey = (np.ptp(colour[:, :3], axis=1) < 1e-9) & (colour[:, 0] > 0.3)
        assert grey.sum() == touched * pieces(figure.axes[0], fields) > 0


def marked(axes, marker) -> list[float]:
    """Places of the markers that are drawn."""
    drawn = [line.get_xdata() for line in axes.lines if line.get_marker() == marker]
    return [x for places in drawn for x in places if np.isfinite(x)]


def test_intervals_are_those_of_the_record(case) -> None:
    moduli, nuisances = estimates_figure(case[0]).axes
    lines = [ends for drawn in moduli.collections for ends in drawn.get_segments()]
    ends = {tuple(np.round(line[:, 0], 3)) for line in lines}
    # Prior 4 ± 1.96 x 2 and estimate 5.8 ± 1.96 x 0.8.
    assert {(0.08, 7.92), (4.232, 7.368)} <= ends
    assert marked(moduli, "x") == [6.2, 2.1]
    # In standard deviations: slack 0.026 over 0.02; the pressure is fixed and has no estimate.
    assert marked(nuisances, "o") == pytest.approx([1.3])


@pytest.mark.parametrize("corresponds", [True, False])
def test_every_frame_of_a_case_is_drawn_from_two_sides_on_one_scale(corresponds):
    figure = frames_figure(case_of_frames(0.3, corresponds=corresponds), reach_mm=2.0)
    titles = [axes.get_title() for axes in figure.axes[:3]]
    assert titles[1] == "closed (closed)\n0.3 s, 100 mmHg"
    assert titles[2].startswith("late (held out)")
    for row in (figure.axes[:3], figure.axes[3:]):
        assert len({np.round(np.ptp(axes.get_xlim()), 6) for axes in row}) == 1
    # The gap is drawn of the closed frame alone.
    assert [len(leaks(axes)) for axes in figure.axes] == [0, 1, 0, 0, 0, 0]
    # Chordae are drawn in every frame whose vertices are those of the reference frame.
    opened, closed, _ = (len(faces(axes).get_paths()) for axes in figure.axes[3:])
    assert (opened == closed) is corresponds


def test_branching_chordae_are_drawn_where_they_follow_tips_and_leaflets():
    # Stored with a case, in another frame, and turned as the valve is.
    valve = replace(VALVE, chordae=BRANCHED)
    surface, tips = valve.surface, valve.papillary_tips
    arrays = valve_fields(valve, ["closed"]) | {"tips": np.stack([tips, tips + 1.0])}
    arrays |= as_stored(chord_fields(valve.chordae, surface.vertices))
    turned = case_fields(arrays)
    moves = np.sin(surface.vertices[:, [1, 2, 0]] / 7.0)
    middle, axes = turn_of(surface.vertices, valve.annulus, surface.triangles, surface.region, tips)
    points = (surface.vertices + moves - middle) @ axes
    moved = valve.chordae.moved(np.ones_like(tips), moves[turned.chord_insertion])
    expected = (moved.ends(tips + 1.0) - middle) @ axes
    found = turned.chords(points, 1)
    # Insertions are drawn at the nearest vertex, here within a cell's diagonal.
    c, on = len(moved.insertion), moved.parent >= 0
    np.testing.assert_allclose(found[on, 0], expected[on, 0], atol=1e-4)
    np.testing.assert_allclose(found[~on, 0], expected[~on, 0], atol=1e-4)
    np.testing.assert_allclose(found[c:, 1], expected[c:, 1], atol=1e-4)
    assert np.abs(found[:c, 1] - expected[:c, 1]).max() < 2.0
    # A vertex that was not seen takes away its own segment alone.
    points[turned.chord_insertion[3]] = np.nan
    unknown = np.isnan(turned.chords(points, 1)).any(axis=(1, 2))
    assert np.flatnonzero(unknown).tolist() == [3]


def test_frames_of_a_case_show_all_segments_of_branching_chordae():
    case, counts = case_of_frames(0.3), []
    for chordae in (STRAIGHT, BRANCHED):
        figure = frames_figure(replace(case, chordae=chordae), reach_mm=2.0)
        paths = len(faces(figure.axes[3]).get_paths())
        counts.append(paths - LINE_PIECES * len(chordae))
    assert len(BRANCHED) > len(STRAIGHT)
    assert counts[0] == counts[1]


def test_the_scene_has_the_gap_in_its_place(fields):
    def parts(reach):
        states = states_of(replace(fields, reach_mm=reach, observed=None), NAMES)
        return {
            label: [part for part in own if part.name in ("touching", "gap")]
            for label, own in states.items()
        }

    touching = parts(200.0)
    assert [part.name for part in touching["closed, personalised"]] == ["touching"]
    assert not touching["open"]
    assert not parts(None)["closed, personalised"]
    (gap,) = parts(0.0)["closed, personalised"]
    assert gap.name == "gap"
    # It lies within the annulus, between the free edges, and is as large as it is drawn flat.
    points = fields.fitted[fields.closed]
    flat, _ = leak_of(replace(fields, reach_mm=0.0), points, fields.closed + 1)
    corner = np.stack([gap.x, gap.y, gap.z], axis=1)[np.stack([gap.i, gap.j, gap.k], axis=1)]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2]
    assert np.abs(across).sum() / 2 == pytest.approx(flat.area, rel=0.1)
    assert points[:, 2].min() <= corner[..., 2].min()
    assert corner[..., 2].max() <= points[:, 2].max()


def test_no_leak_is_drawn_of_an_open_or_half_seen_valve(fields):
    whole = replace(fields, reach_mm=2.0, observed=fields.fitted)
    seen = fields.fitted.copy()
    seen[fields.closed, 0] = np.nan
    for valve, images in ((whole, [0, 1, 1]), (replace(whole, observed=seen), [0, 0, 1])):
        axes = shapes_figure(valve, NAMES).axes[:3]
        assert [len(leaks(panel)) for panel in axes] == images
