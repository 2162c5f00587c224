"""Uncertain geometry: modes, columns of an observation, and wider intervals."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.cases.tissue import SEEN_ON_BAND, LeafletBand, lay_out_chordae
from mvest.closure.frames import FramesModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.errors import InputError
from mvest.estimation.noise import observation_noise
from mvest.mechanics.valve_system import HeldState
from mvest.observation.vertices import Observation
from mvest.personalisation.geometry import (
    GeometryModes,
    NuisanceGeometry,
    displacement,
    geometry_modes,
    leaflet_scales,
    rest_lengths_by_ends,
    rest_lengths_by_tips,
    smooth_modes,
)
from mvest.personalisation.model import contact_annulus
from mvest.personalisation.sources import ClosedValve, geometry_sources, sample_frames
from mvest.problem.registration import RegisteredModel
from mvest.valve.geometry.proximity import closest_points
from tests.cases.test_folder import corresponding
from tests.closure.branching import STRAIGHT, branching
from tests.closure.displaced import displaced
from tests.closure.test_model import AT, CLOSING, GENTLE, SMALL, model_of

NONE = NuisanceGeometry(
    shape_mm=0, annulus_mm=0, tips_mm=0, insertions_mm=0, thickness=0, fibre_degrees=0
)
UP = np.array([0.0, 0.0, 1.0])


def test_smooth_modes_have_the_requested_share_of_the_variance():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 30, (300, 3)) * [1, 1, 0]
    few, many = (smooth_modes(points, 10.0, share) for share in (0.8, 0.99))
    assert len(few) < len(many) < 300
    for modes, share in ((few, 0.8), (many, 0.99)):
        variance = np.sum(modes**2, axis=0)
        assert share <= variance.mean() < share + 0.03
        assert variance.max() < 1 + 1e-6
    # The correlation at 10 mm is (1 + sqrt 3) exp(-sqrt 3) = 0.48.
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    covariance = many.T @ many
    assert np.mean(covariance[np.abs(apart - 10.0) < 0.5]) == pytest.approx(0.48, abs=0.03)


def case_of(model, **changes):
    """What modes need of a case."""
    valve = model.valve
    about = {"chordae": valve.chordae, "error_samples": None, "chordae_follow": False} | changes
    return SimpleNamespace(surface=valve.surface, valve=valve, **about)


def test_columns_are_derivatives_times_standard_deviations_turned_as_the_valve_is_seen():
    model = model_of(CLOSING, continuation=True)
    registered = RegisteredModel(model, (*model.names, "turn.z"))
    m = np.array([*AT, 90.0])
    valve = ClosedValve(registered, m, registered(m).y)
    n = len(model.valve.surface.vertices)
    seen = Observation(("closed",), np.zeros((1, n, 3)), np.array(1.0))

    def columns_of(std=1e-3, case=None, **changes):
        modes = geometry_modes(case or case_of(model), replace(NONE, **changes), model)
        sources = geometry_sources(modes, valve, seen, observation_noise(std**2, 3 * n))
        return tuple(source.columns for source in sources)

    assert columns_of() == ()
    (fibres,) = columns_of(fibre_degrees=10.0)
    assert (fibres.name, fibres.factor) == ("fibres", 1.0)
    geometry, count = RestGeometry(model), len(model.valve.chordae)
    change = geometry.change(AT, geometry.fibres(np.eye(2)))[1]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    C = np.deg2rad(10.0) * np.einsum("ij,njq->niq", turn, change).reshape(3 * n, 2)
    np.testing.assert_allclose(
        fibres.columns @ fibres.columns.T, C @ C.T, atol=1e-3 * (C @ C.T).max()
    )
    # All chords longer by a percent are in the span of single ones.
    (lengths,) = columns_of(case=case_of(model, chordae_follow=True), rest_lengths=0.01)
    assert columns_of(rest_lengths=0.01) == ()  # stated rest lengths are exact
    all_longer = geometry.change(AT, geometry.rest_lengths(np.full((1, count), 0.01)))[1]
    longer = np.einsum("ij,njq->niq", turn, all_longer).ravel()
    part = np.linalg.lstsq(lengths.columns, longer, rcond=None)[0]
    np.testing.assert_allclose(lengths.columns @ part, longer, atol=0.02 * np.abs(longer).max())
    both = columns_of(shape_mm=0.3, tips_mm=1.0)
    assert [(o.name, o.factor) for o in both] == [("open shape", 2.0), ("papillary tips", 1.0)]
    # Coarse noise hides many combinations, but none that matters.
    coarse = columns_of(std=1.0, shape_mm=0.3)[0].columns
    assert 0 < coarse.shape[1] < both[0].columns.shape[1]
    assert np.linalg.norm(coarse) > 0.9 * np.linalg.norm(both[0].columns)
    # Error samples contain the errors of the frames already.
    assert columns_of(case=case_of(model, error_samples=()), shape_mm=0.3, tips_mm=1.0) == ()


def test_a_scale_of_a_leaflet_lengthens_it_and_leaves_the_other_and_the_annulus():
    case = corresponding(48, 12)
    surface = case.surface
    # Columns of the grid through the middle of either leaflet, from annulus to free edge.
    lines = [12 + 48 * np.arange(12), 36 + 48 * np.arange(12)]
    for k, moves in enumerate(leaflet_scales(case)):
        assert not moves[case.annulus].any()
        for x, line in enumerate(lines):
            before, after = (
                np.linalg.norm(np.diff(points[line], axis=0), axis=1).sum()
                for points in (surface.vertices, surface.vertices + 0.04 * moves)
            )
            assert after / before - 1.0 == pytest.approx(0.04 * (x == k), abs=0.006)


def laid_out(case, tips=0.0, open_move=0.0, closed_move=0.0):
    """The chordae, laid out for displaced tips and leaflets."""
    surface, closed = case.surface, case.frame(Role.CLOSED)
    band = LeafletBand.of(
        surface.vertices + open_move,
        surface.triangles,
        surface.region,
        case.annulus,
        case.free_edge,
        surface.region_names.index("anterior"),
    )
    return lay_out_chordae(
        band.position,
        np.asarray(case.frame(Role.REFERENCE).papillary_tips) + tips,
        replace(band, vertices=closed.vertices + closed_move).position,
        closed.papillary_tips + tips,
        SEEN_ON_BAND,
    )


@pytest.mark.parametrize("lift", [0.0, 8.0])
def test_rest_lengths_change_as_chordae_laid_out_on_other_frames(lift):
    # Lifted closed leaflets are farther from the tips, so the closed frame decides.
    plain = corresponding(40, 12)
    plain = replace(
        plain,
        frames=tuple(
            replace(one, vertices=one.vertices + lift * (one.role is Role.CLOSED) * UP)
            for one in plain.frames
        ),
    )
    still = laid_out(plain)
    case = replace(plain, chordae_follow=True, chordae=still)

    def by_difference(h, **moves):
        ahead, behind = (
            laid_out(plain, **{name: s * move for name, move in moves.items()}) for s in (h, -h)
        )
        return (ahead.rest_length - behind.rest_length) / (2 * h * still.rest_length)

    for open_, seen in (([0.2, -0.1, 0.3], [0.0] * 3), ([0.0] * 3, [0.1, 0.4, -0.2])):
        expected = by_difference(1e-3, open_move=np.array(open_), closed_move=np.array(seen))
        ends = [np.broadcast_to(move, (1, len(still.insertion), 3)) for move in (open_, seen)]
        (found,) = rest_lengths_by_ends(case, *ends)
        np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(found).max() + 1e-6)
    move = np.random.default_rng(4).standard_normal((1, len(plain.valve.papillary_tips), 3))
    expected = by_difference(0.01, tips=move[0])
    (found,) = rest_lengths_by_tips(case, move)
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())
    assert rest_lengths_by_tips(plain, move) is None
    # Without correspondence only the open valve shows the insertions.
    case = replace(case, frames=tuple(replace(one, corresponds=False) for one in plain.frames))

    def distance(h):
        tips = case.frame(Role.REFERENCE).papillary_tips + h * move[0]
        return np.linalg.norm(still.insertion - tips[still.end_tip], axis=1)

    expected = (distance(1e-4) - distance(-1e-4)) / (2e-4 * distance(0.0))
    straight = np.flatnonzero(still.parent[: len(still.insertion)] < 0)
    found = rest_lengths_by_tips(case, move)[0, straight]
    np.testing.assert_allclose(found, expected[straight], atol=1e-7)


def test_rest_lengths_of_trees_of_any_depth_scale_with_the_frames():
    straight = replace(corresponding(40, 12), chordae_follow=True)
    tips = straight.frame(Role.REFERENCE).papillary_tips
    chordae = branching(STRAIGHT, tips)
    case = replace(straight, chordae=chordae)
    # Leaflets that move away from the tips by a hundredth of the chords' length.
    frame = case.frame(Role.CLOSED)
    place = closest_points(chordae.insertion, case.surface.vertices, case.surface.triangles)
    closed = place.interpolate(frame.vertices, case.surface.triangles)
    away = 0.01 * (closed - np.asarray(frame.papillary_tips)[chordae.end_tip])
    opened = 0.01 * (chordae.insertion - np.asarray(tips)[chordae.end_tip])
    (same,) = rest_lengths_by_ends(case, opened[None], away[None])
    np.testing.assert_allclose(same, np.full(len(chordae), 0.01), rtol=1e-12)


def test_columns_are_the_moves_of_a_displaced_valve():
    model = model_of(GENTLE, **SMALL)
    surface = model.valve.surface
    n = len(surface.vertices)
    smooth = smooth_modes(surface.vertices, 10.0, 0.9)[2]
    modes = [
        GeometryModes("open shape", {"shape": 0.3 * smooth[None, :, None] * UP}),
        GeometryModes("thickness", {"thickness": np.full((1, n), 0.2)}),
    ]
    seen, geometry = (
        Observation(("closed",), np.zeros((1, n, 3)), np.array(1.0)),
        RestGeometry(model),
    )

    def closed(sizes):
        moved = displaced(geometry, displacement(modes, [*sizes[:, None]]))
        registered = RegisteredModel(moved, model.names)
        return ClosedValve(registered, AT, registered(AT).y)

    sources = geometry_sources(modes, closed(np.zeros(2)), seen, observation_noise(1e-6, 3 * n))
    for row, way in zip((source.rows for source in sources), 0.02 * np.eye(2), strict=True):
        above, below = (closed(sign * way).predicted.reshape(2, -1)[1] for sign in (1, -1))
        central = (above - below) / 0.04
        np.testing.assert_allclose(row[:, 0], central, atol=0.02 * np.abs(central).max())


def test_samples_of_frames_move_the_valve_as_a_displaced_geometry_does(monkeypatch):
    model = model_of(GENTLE, **SMALL)
    valve, surface = model.valve, model.valve.surface
    rng = np.random.default_rng(5)
    shape_, closed = 0.02 * smooth_modes(surface.vertices, 10.0, 0.9)[1:3, :, None] * UP
    tips = rng.normal(0.0, 0.2, (2, len(valve.papillary_tips), 3))
    samples = SimpleNamespace(vertices=np.stack([shape_, closed])[None], tips=tips[None])
    roles = (Role.REFERENCE, Role.CLOSED)
    case = case_of(model, error_samples=samples, annulus=valve.annulus)
    case.frames = tuple(SimpleNamespace(role=role) for role in roles)
    registered = RegisteredModel(model, model.names)
    # Chordae of this valve are slack, so its tips are only recorded.
    used, of_tips = [], RestGeometry.tips
    monkeypatch.setattr(RestGeometry, "tips", lambda *given: used.append(given) or of_tips(*given))
    found = sample_frames(case, ClosedValve(registered, AT, registered(AT).y))
    np.testing.assert_array_equal(used[0][1], tips[None, 1])
    geometry = RestGeometry(model)
    rest = surface.vertices[valve.annulus]
    annulus = contact_annulus(model, rest + closed[valve.annulus]) - contact_annulus(model, rest)
    parts = {"shape": shape_, "annulus": annulus, "tips": tips[1]}
    variation = geometry.variation({name: part[None] for name, part in parts.items()})
    expected = geometry.change(AT, variation)[1, ..., 0]
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(found.predicted[0], expected, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_array_equal(found.seen[0], closed)
    np.testing.assert_array_equal(found.opened[0], shape_)


def test_inadmissible_standard_deviations_are_refused():
    for setting in ({"shape_mm": -0.1}, {"share": 1.0}):
        with pytest.raises(InputError, match=r"nuisance geometry sha\w+ = "):
            NuisanceGeometry(**setting)


def test_scales_of_annulus_and_of_all_lengths():
    model = model_of(GENTLE, **SMALL)
    case = case_of(model)
    (annulus,) = geometry_modes(case, replace(NONE, annulus_scale=0.02), model)
    closed = model.contact_valve.motion.annulus[-1]
    np.testing.assert_allclose(annulus.parts["annulus"][0], 0.02 * (closed - closed.mean(axis=0)))
    # A larger and equally thicker valve has the same shape under the same pressure.
    (whole,) = geometry_modes(case, replace(NONE, frame_scale=0.02), model)
    np.testing.assert_allclose(whole.parts["thickness"], 0.02)


def test_all_closed_frames_are_displaced_as_their_derivatives_say():
    model = model_of(GENTLE, **SMALL)
    motion = model.contact_valve.motion
    state = HeldState(0.3, motion.annulus[-1], motion.papillary_tips[-1])
    frames = FramesModel(model, "closed", {"early": state}, 1.0)
    rng = np.random.default_rng(2)
    parts = {
        "annulus": np.broadcast_to(rng.normal(0.0, 0.02, 3), motion.annulus[-1].shape),
        "tips": rng.normal(0.0, 0.02, motion.papillary_tips[-1].shape),
    }
    geometry = RestGeometry(model)
    moved_state = replace(
        state,
        annulus=state.annulus + parts["annulus"],
        papillary_tips=state.papillary_tips + parts["tips"],
    )
    other = replace(frames, model=displaced(geometry, parts), states={"early": moved_state})
    y, still = other(AT).y, frames(AT).y
    variation = geometry.variation({name: move[None] for name, move in parts.items()})
    change = geometry.change(AT, variation, [state])[..., 0]
    moved = (y - still).reshape(change.shape)
    assert np.abs(change[1]).max() > 0.01
    np.testing.assert_allclose(moved, change, atol=0.02 * np.abs(change).max())
