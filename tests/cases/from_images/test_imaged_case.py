"""From a valve in images to a case: the frames chosen, what is derived, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvest.cases.case import Role
from mvest.cases.folder import read_case, write_case
from mvest.cases.from_images.build import CaseFrames, case_of_sequence, choose_frames
from mvest.cases.from_images.detected import pressure_curve
from mvest.cases.from_images.detector_errors import samples_in_world, valve_axes
from mvest.cases.from_images.measures import measure_sequence
from mvest.cases.tissue import SEEN_CLOSURE
from mvest.errors import GeometryError, InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import ValveSequence
from mvest.valve.anatomy.template import (
    BRANCHING,
    INDENTATION_ANGLE,
    INDENTATION_WIDTH,
    Template,
)
from mvest.valve.geometry.proximity import closest_points
from tests.cases.folders import closing
from tests.cases.test_folder import assert_equal

LAYOUT = ValveLayout(32, 9)
TEXTS = {
    "name": "imaged", "description": "a valve from images", "source": "made up", "licence": "MIT",
    "simulated": True,
}  # fmt: skip
FRAMES = CaseFrames(0, 2, 118.0)
TURN, HERE = Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.eye(3)


def sequence(turn=HERE, origin=(0.0, 0.0, 0.0)):
    valve = Template().valve(32, 9)
    x = valve.surface.vertices
    shapes = np.stack([closing(x, share) for share in (0.0, 0.5, 1.0, 0.9)])
    tips = np.repeat(valve.papillary_tips[None], 4, axis=0)
    times, confidence = np.array([0.0, 0.04, 0.1, 0.14]), np.array([0.9, 0.8, 0.85, 0.9])
    placed = shapes @ turn.T + origin, tips @ turn.T + origin
    known = np.ones((4, LAYOUT.size)), np.linspace(0.4, 0.8, LAYOUT.size), 9.0
    return ValveSequence(LAYOUT, times, *placed, confidence, *known)


def test_the_case_is_that_of_the_frames_and_passes_the_checks_of_a_folder(tmp_path):
    case = case_of_sequence(sequence(), FRAMES, TEXTS)
    assert [(f.name, f.role, f.pressure_mmHg) for f in case.frames] == [
        ("open", Role.REFERENCE, 0.0),
        ("closed", Role.CLOSED, 118.0),
    ]
    assert all(frame.corresponds for frame in case.frames)
    assert case.chordae_follow
    chordae = case.chordae
    assert len(chordae) == len(Template().chordae())
    # Where the template has them: the layout's phi and s are its own. Flat triangles of 6 mm lie
    # up to 0.3 mm off the curved leaflet, and 1 mm where one spans an indentation.
    gap = np.linalg.norm(chordae.insertion - Template().chordae().insertion, axis=1)
    phi = np.mod(Template().chord_places().phi, 360.0)
    plain = np.abs(np.abs(phi - 270.0) - INDENTATION_ANGLE) > INDENTATION_WIDTH
    assert gap[plain].max() < 0.3
    assert gap.max() < 1.0
    # By the closed frame, as one that was seen.
    here, there = (f.vertices for f in (case.frames[0], case.frames[1]))
    place = closest_points(chordae.insertion, here, case.surface.triangles)
    ends = place.interpolate(there, case.surface.triangles)
    c, tips = len(ends), case.frames[1].papillary_tips
    fans = [ends[chordae.parent[:c] == k].mean(axis=0) for k in range(len(chordae.junction))]
    own = tips[chordae.tip[c:]]
    closed = replace(chordae, insertion=ends, junction=own + BRANCHING * (np.array(fans) - own))
    spans = np.linalg.norm(np.diff(closed.ends(tips), axis=1)[:, 0], axis=1)
    slack = np.where(chordae.family == 0, SEEN_CLOSURE.marginal_slack, SEEN_CLOSURE.basal_slack)
    by_closed = chordae.rest_length / spans < 1.0001 * slack
    assert by_closed.sum() >= 20
    np.testing.assert_allclose((chordae.rest_length / spans)[by_closed], slack[by_closed])
    np.testing.assert_array_equal(case.uncertainty.std_mm, sequence().std_mm)
    assert_equal(read_case(write_case(tmp_path / "case", case)), case, "sha256", "derived")
    # What was seen last may be the open valve.
    case = case_of_sequence(sequence(), CaseFrames(3, 2, 100.0), TEXTS)
    assert [frame.role for frame in case.frames] == [Role.CLOSED, Role.REFERENCE]
    np.testing.assert_array_equal(case.surface.vertices, sequence().vertices[3])


def test_thickness_and_fibres_vary_as_in_the_template():
    case, valve = case_of_sequence(sequence(TURN), FRAMES, TEXTS), Template().valve(32, 9)
    np.testing.assert_allclose(case.surface.thickness, valve.surface.thickness, rtol=1e-12)
    along = np.abs(np.sum(case.surface.fibre @ TURN * valve.surface.fibre, axis=1))
    # Directions follow from the vertices alone; within two cells of the commissures the surface
    # bends sharply, and at the indentations the free edge turns.
    cell = 360.0 / LAYOUT.columns
    away = np.abs((LAYOUT.phi + 90.0) % 180.0 - 90.0) > 2 * cell
    away &= np.abs(np.abs(LAYOUT.phi - 270.0) - INDENTATION_ANGLE) > INDENTATION_WIDTH + cell
    assert along[away].min() > 0.97
    assert np.median(along) > 0.995
    thicker = case_of_sequence(
        sequence(), FRAMES, TEXTS, thickness_mm={"anterior": 2.64, "posterior": 1.26}
    )
    middle = LAYOUT.vertex(90.0, 0)
    assert thicker.surface.thickness[middle] == pytest.approx(2.64)


def test_frames_are_chosen_by_orifice_and_contact_among_those_that_are_sure():
    seen = sequence()
    rows = measure_sequence(seen, 1.3)
    orifice = [row["orifice_mm2"] for row in rows]
    found = choose_frames(seen, rows, 120.0)
    assert found.open == int(np.argmax(orifice)) == 0
    assert found.closed not in (0, 1)
    assert len(found.derived) == 2
    # Frames that no one believes in are not chosen, whatever they show.
    unsure = replace(seen, frame_confidence=np.array([0.3, 0.8, 0.85, 0.9]))
    assert choose_frames(unsure, rows, 120.0).open == 1
    given = choose_frames(seen, rows, 120.0, open_=1, closed=3)
    assert (given.open, given.closed, given.derived) == (1, 3, ())
    with pytest.raises(InputError, match=r"0 of 4 frames .*imaged\.open_frame"):
        choose_frames(replace(seen, frame_confidence=np.full(4, 0.2)), rows, 120.0)
    with pytest.raises(InputError, match="closed frame 4, expected one of 0 to 3"):
        choose_frames(seen, rows, 120.0, closed=4)


def test_errors_become_displacements_back_to_where_it_may_have_been_and_so_in_a_mirror():
    rng, seen = np.random.default_rng(0), sequence(TURN)
    errors, tips = rng.standard_normal((4, 2, LAYOUT.size, 3)), rng.standard_normal((4, 2, 2, 3))
    found = samples_in_world(seen, FRAMES, np.concatenate([errors, tips], axis=2))
    np.testing.assert_array_equal(found.source, [0, 1, 2, 3, 0, 1, 2, 3])
    # Axes are those of a moving valve.
    np.testing.assert_allclose(valve_axes(sequence(), 0), np.eye(3), atol=0.05)
    for which, number in enumerate((FRAMES.open, FRAMES.closed)):
        axes = valve_axes(seen, number)
        np.testing.assert_allclose(axes, TURN @ valve_axes(sequence(), number), atol=1e-9)
        own, mirrored = found.vertices[:4, which] @ axes, found.vertices[4:, which] @ axes
        np.testing.assert_allclose(own, -errors[:, which], atol=1e-9)
        # x runs between the commissures: what was seen at 45 degrees is mirrored to 135.
        for phi, other in ((45.0, 135.0), (225.0, 315.0), (0.0, 180.0), (90.0, 90.0)):
            here, there = LAYOUT.vertex(phi, 4), LAYOUT.vertex(other, 4)
            np.testing.assert_allclose(mirrored[:, there], own[:, here] * [-1, 1, 1], atol=1e-9)
        moved = found.tips[:, which] @ axes
        np.testing.assert_allclose(moved[:4], -tips[:, which], atol=1e-9)
        np.testing.assert_allclose(moved[4:, 0], moved[:4, 1] * [-1, 1, 1], atol=1e-9)
    case = case_of_sequence(seen, FRAMES, TEXTS, error_samples=found)
    assert case.error_samples is found


def test_vertices_that_were_never_measured_have_no_weight():
    seen = sequence()
    std = np.array(seen.std_mm)
    std[3:7] = np.nan
    case = case_of_sequence(replace(seen, std_mm=std), FRAMES, TEXTS)
    np.testing.assert_array_equal(case.uncertainty.std_mm[3:7], 10.0)
    assert any("4 vertices whose error was never measured" in text for text in case.derived)
    with pytest.raises(InputError, match="no vertex has a standard deviation"):
        case_of_sequence(replace(seen, std_mm=np.full(LAYOUT.size, np.nan)), FRAMES, TEXTS)


def test_a_surface_that_is_no_valve_is_refused_with_its_frame():
    folded, spoilt, above = sequence(), sequence(), sequence()
    x = folded.vertices[0]
    x[LAYOUT.vertex(90.0, 4)] = x[LAYOUT.vertex(270.0, 4)] + [0.0, -4.0, 0.0]
    spoilt.vertices[2, 5] = np.nan
    above.tips[...] += [0.0, 0.0, 60.0]
    for seen, message in (
        (folded, "open frame 0: "),
        (spoilt, "closed frame 2: a position is not finite"),
        (above, "open frame 0: tip 0 .* above the annulus"),
    ):
        with pytest.raises(GeometryError, match=message):
            case_of_sequence(seen, FRAMES, TEXTS)


def test_frames_pressures_and_thicknesses_out_of_place_are_refused():
    with pytest.raises(InputError, match="both the open and the closed"):
        CaseFrames(1, 1, 100.0)
    with pytest.raises(InputError, match=r"16 mmHg on the closed valve.*is it in kPa"):
        CaseFrames(0, 2, 16.0)
    with pytest.raises(InputError, match="thickness of anterior, expected of anterior, posterior"):
        case_of_sequence(sequence(), FRAMES, TEXTS, thickness_mm={"anterior": 1.3})


def test_the_pressure_curve_is_monotone_and_not_extrapolated():
    time, pressure = np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.0, 5.0, 120.0, 121.0])
    curve = pressure_curve(time, pressure)
    np.testing.assert_allclose([curve(t) for t in time], pressure)
    assert np.all(np.diff([curve(t) for t in np.linspace(0.0, 0.3, 50)]) > 0.0)
    with pytest.raises(InputError, match=r"time 0.4 s lies outside .* from 0 to 0.3 s"):
        curve(0.4)
    with pytest.raises(InputError, match="expected two or more that increase"):
        pressure_curve(time[::-1], pressure)
