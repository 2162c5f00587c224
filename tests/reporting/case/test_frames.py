"""The frames of a case drawn before anything is simulated."""

import numpy as np
import pytest

from mvest.reporting.case import figures as case_figures
from mvest.reporting.case.frames import frame_fields, frames_figure
from mvest.valve.anatomy.template import Template

VALVE = Template().valve(24, 7)
SURFACE = VALVE.surface


def fields(shift=(0.0, 0.0, 0.0), chords=True):
    x = SURFACE.vertices + np.array(shift)
    given = (VALVE.chordae.tip, VALVE.chordae.insertion + np.array(shift)) if chords else ()
    return frame_fields(
        x,
        SURFACE.triangles,
        SURFACE.region,
        x[VALVE.annulus],
        VALVE.papillary_tips + np.array(shift),
        *given,
    )


def test_the_borders_are_found_from_the_annulus():
    found = fields()
    assert set(found.annulus) == set(VALVE.annulus)
    assert set(found.free_edge) == set(VALVE.free_edge)
    # Also with the annulus sampled elsewhere than at the vertices.
    ring = SURFACE.vertices[VALVE.annulus]
    between = 0.5 * (ring + np.roll(ring, 1, axis=0))
    other = frame_fields(
        SURFACE.vertices, SURFACE.triangles, SURFACE.region, between, VALVE.papillary_tips
    )
    assert set(other.annulus) == set(VALVE.annulus)
    assert len(other.chord_insertion) == 0


def test_chordae_end_at_the_nearest_vertices():
    found = fields()
    ends = SURFACE.vertices[found.chord_insertion]
    gap = np.linalg.norm(VALVE.chordae.insertion - ends, axis=1)
    every = np.linalg.norm(VALVE.chordae.insertion[:, None] - SURFACE.vertices[None], axis=2).min(
        axis=1
    )
    np.testing.assert_allclose(gap, every)
    np.testing.assert_array_equal(found.chord_tip, VALVE.chordae.tip)
    np.testing.assert_array_equal(fields((1.0, 2.0, 3.0)).chord_insertion, found.chord_insertion)


@pytest.mark.parametrize("n", [1, 3])
def test_every_frame_is_drawn_from_two_sides_on_one_scale(n):
    frames = {f"frame {k}": fields((0.0, 0.0, 4.0 * k), chords=k == 0) for k in range(n)}
    figure = frames_figure(frames, ("anterior", "posterior"))
    assert len(figure.axes) == 2 * n
    assert [axes.get_title() for axes in figure.axes[:n]] == list(frames)
    for row in (figure.axes[:n], figure.axes[n:]):
        spans = {
            (round(np.ptp(axes.get_xlim()), 6), round(np.ptp(axes.get_ylim()), 6)) for axes in row
        }
        assert len(spans) == 1
    words = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert {"anterior", "posterior"} <= words


def test_every_frame_has_its_own_tips_in_view(monkeypatch):
    seen = []
    monkeypatch.setattr(
        case_figures, "same_scale", lambda panels, shapes, view: seen.append(shapes)
    )
    frames_figure({"one": fields(), "two": fields((5.0, 0.0, 0.0))}, ("anterior", "posterior"))
    from_above, from_the_side = seen
    assert len(from_above) == 2
    tips = [shape for shape in from_the_side if len(shape) == len(VALVE.papillary_tips)]
    np.testing.assert_array_equal(tips[1] - tips[0], [[5.0, 0.0, 0.0]] * len(tips[0]))
