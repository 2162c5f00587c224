"""Simulated valves in motion: what closes, what is drawn, what is refused, and the file of them."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.simulation import motion, population
from mvest.simulation.population import draw_population, load_population, save_population
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.proximity import closest_points

TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
MECHANICS = MechanicsSettings(TISSUE, ClosureProtocol(pressure_mmHg=100.0, ramp=0.2, dt=0.04))
VALUES = {"E_f.anterior": 6.0, "E_f.posterior": 4.0, "pressure_scale": 1.1}
SMALL = motion.MotionSettings(
    columns=32, rows=9, mesh_columns=16, mesh_rows=2, contact_columns=60, contact_rows=16, steps=6,
    frames=5, held_pressure=(0.8, 0.6), held_relaxation=(0.1, 0.3),
)  # fmt: skip
TEMPLATE = Template()
LAYOUT = ValveLayout(32, 9)
TIP_MOTION = np.array([[0.5, -1.0, 1.5], [0.0, 1.0, 1.0]])


def drawn_valve(name, values=VALUES, mechanics=MECHANICS):
    return motion.DrawnValve(name, TEMPLATE, values, mechanics, TIP_MOTION)


@pytest.fixture(scope="module")
def valve():
    """A valve that is closed in seconds."""
    return motion.close_in_motion(drawn_valve("small"), SMALL)


REST = TEMPLATE.valve(LAYOUT.columns, LAYOUT.rows).surface.vertices


def still(name="still", vertices=REST, frames=2):
    """A valve that does not move, or in which the later frames are as given."""
    shapes = np.stack([REST, *[vertices] * (frames - 1)])
    tips = np.tile(TEMPLATE.papillary_tips, (frames, 1, 1))
    chordae = np.array([10.0, 200.0]), np.array([0.5, 1.0]), np.array([0, 1])
    times = 0.1 * np.arange(frames)
    return MovingValve(name, LAYOUT, times, shapes, tips, np.ones(LAYOUT.size), *chordae)


# --- closing ------------------------------------------------------------------------------------


def test_a_motion_goes_from_the_open_valve_over_the_closed_one(valve):
    assert valve.vertices.shape == (7, 288, 3)
    np.testing.assert_allclose(valve.times, 0.35 * np.arange(7) / 6)
    seen = TEMPLATE.valve(32, 9)
    np.testing.assert_allclose(valve.vertices[0], seen.surface.vertices, atol=1e-6)
    np.testing.assert_array_equal(valve.thickness, seen.surface.thickness)
    anterior = seen.surface.triangles[seen.surface.region == 0]
    edge = [LAYOUT.vertex(270, -1)]
    gap = [closest_points(x[edge], x, anterior).distance[0] for x in valve.vertices]
    # The posterior edge is 7 mm away from the anterior leaflet. In the closed valve it touches:
    # midsurfaces keep a thickness apart, 1 mm at the edge, more on a coarse mesh.
    assert gap[0] > 6
    assert gap[4] < 1.5
    # The annulus follows its boundary: closed, and a tenth of its way back.
    start, end = seen.motion.annulus
    for frame, back in ((4, 0.0), (5, 0.1), (6, 0.3)):
        ring = valve.vertices[frame][LAYOUT.annulus]
        # The hinge holds the annulus of a coarse mesh, whose edges are not those that are seen.
        np.testing.assert_allclose(ring[::2], (end + back * (start - end))[::2], atol=0.15)
        np.testing.assert_allclose(valve.tips[frame], TEMPLATE.papillary_tips + back * TIP_MOTION)
    np.testing.assert_allclose(valve.tips[0], TEMPLATE.papillary_tips + TIP_MOTION)


def test_a_valve_that_does_not_close_is_refused(monkeypatch):
    monkeypatch.setattr(motion, "GIVE_UP", {"max_iterations": 1, "max_halvings": 0})
    with pytest.raises(
        motion.RefusedError, match="simulated valve soft: the closure does not converge"
    ):
        motion.close_in_motion(drawn_valve("soft"), SMALL)


def test_frames_are_chosen_evenly_along_the_way():
    x = np.array([0.0, 0.1, 0.2, 5.0, 5.2, 9.0, 9.9, 10.0])
    points = x[:, None, None] * np.ones((1, 4, 3))
    np.testing.assert_array_equal(motion.frames_along(points, 3), [0, 3, 7])
    # Every frame once, also where the nearest would be one that is taken.
    snap = np.array([0.0, 9.0, 9.1, 9.2, 10.0])[:, None, None] * np.ones((1, 4, 3))
    np.testing.assert_array_equal(motion.frames_along(snap, 4), [0, 1, 2, 4])


def test_settings_of_a_motion_are_checked():
    with pytest.raises(InputError, match="frames = 9 to the closed one, expected 2 to 8"):
        replace(SMALL, frames=9)


# --- refusals -----------------------------------------------------------------------------------


FLAILING = REST * np.array([1, 1, -1.0])
# Free edges beyond the opposite ones.
CROSSED = REST - [[0.0, 2.0, 0.0]] * LAYOUT.s[:, None] * (REST - 1.8)


@pytest.mark.parametrize(
    ("limits", "vertices", "words"),
    [
        ({}, REST, "of its orifice open"),
        ({"orifice": 2.0}, REST, "mm from the anterior leaflet"),
        ({"orifice": 2.0, "edge_gap": 50.0, "stretch": 10.0}, FLAILING, "above the annulus"),
        ({"orifice": 5.0, "edge_gap": 50.0}, 1.7 * REST, "stretched to 1.70"),
        ({"orifice": 2.0, "edge_gap": 50.0, "stretch": 10.0}, CROSSED, "pass through each other"),
    ],
)
def test_what_no_valve_does_is_refused(limits, vertices, words):
    with pytest.raises(motion.RefusedError, match=f"simulated valve still: .*{words}"):
        motion.check_motion(still(vertices=vertices), 1, motion.MotionLimits(**limits))


# --- populations --------------------------------------------------------------------------------

BASES = {
    "one": TemplateParameters(),
    "other": TemplateParameters().changed({"annulus.anteroposterior_diameter": 29.5}),
}


@pytest.fixture
def closings(monkeypatch):
    """What valves would be closed with; every third of the anatomy ``other`` is refused."""
    calls = []

    def close(drawn, settings):
        calls.append((drawn, settings))
        if drawn.name.startswith("other") and len(calls) % 3 == 0:
            raise motion.RefusedError(drawn.name, "a test")
        # Something by which valves can be told apart.
        return replace(still(drawn.name), vertices=still().vertices * drawn.values["E_f.anterior"])

    monkeypatch.setattr(population, "close_in_motion", close)
    return calls


def population_of(count, seed, bases=BASES, **settings):
    return tuple(
        draw_population(count, seed, bases, motion.MotionSettings(), MECHANICS, **settings)
    )


def test_a_population_is_drawn_by_its_seed_and_refused_valves_again(closings):
    one, same, other = (population_of(6, seed) for seed in (1, 1, 2))
    assert [v.name for v in one] == [v.name for v in same]
    assert sum(v.name.startswith("one") for v in one) == 3
    assert len({v.name for v in (*one, *other)}) == 12
    # The refusal of another valve does not change a valve.
    for a, b, c in zip(one, same, other, strict=True):
        assert a.name.startswith("other") or np.array_equal(a.vertices, b.vertices)
        assert not np.array_equal(a.vertices, c.vertices)
    valves = [valve for valve, _ in closings]
    again = [(a, b) for a, b in itertools.pairwise(valves) if a.name == b.name]
    assert again
    assert all(a.values != b.values for a, b in again)


def test_a_valve_that_is_always_refused_is_an_error(monkeypatch):
    def refuse(drawn, _):
        raise motion.RefusedError(drawn.name, "a test")

    monkeypatch.setattr(population, "close_in_motion", refuse)
    with pytest.raises(GeometryError, match="one_1_000: refused 20 times"):
        population_of(1, 1, {"one": BASES["one"]})
    with pytest.raises(InputError, match="expected at least one of each"):
        population_of(1, 1, {})


def test_what_is_drawn_spreads_as_requested(closings):
    population_of(60, 4, {"one": BASES["one"]})
    assert len(closings) == 60
    for name, median, spread in (
        ("E_f.anterior", 6.23, 0.47),
        ("E_f.posterior", 2.09, 0.47),
        ("pressure_scale", 1.0, 0.15),
        ("chord_stiffness", 1.0, 0.2),
        ("chord_rest_length", 1.0, 0.02),
    ):
        found = np.log([valve.values[name] / median for valve, _ in closings])
        # Four standard errors of a mean, and of a spread.
        assert abs(found.mean()) < 4 * spread / np.sqrt(60)
        assert found.std() == pytest.approx(spread, rel=4 / np.sqrt(120))
    durations = np.log([settings.duration / 0.35 for _, settings in closings])
    assert durations.std() == pytest.approx(0.15, rel=4 / np.sqrt(120))
    reach = np.linalg.norm([valve.tip_motion for valve, _ in closings], axis=2)
    assert 1.0 <= reach.min() < 1.3
    assert 2.7 < reach.max() <= 3.0
    for valve, _ in closings:
        # Open tips are nearer to where their chordae insert.
        chordae, closed = valve.template.chordae(), valve.template.papillary_tips
        for k in range(2):
            towards = (chordae.insertion[chordae.end_tip == k] - closed[k]).mean(axis=0)
            assert valve.tip_motion[k] @ towards > 0


# --- files --------------------------------------------------------------------------------------
def test_a_population_is_the_same_after_its_file_and_a_changed_one_is_refused(tmp_path):
    one = {"chord_phi": np.array([1.0]), "chord_s": np.ones(1), "chord_tip": np.array([1])}
    drawn = replace(still("first"), **one), still("second", frames=4)
    path = tmp_path / "population.npz"
    save_population(path, drawn)
    for a, b in zip(drawn, load_population(path), strict=True):
        assert (a.name, a.layout) == (b.name, b.layout)
        for part in ("times", "vertices", "tips", "thickness", "chord_phi", "chord_s", "chord_tip"):
            np.testing.assert_allclose(getattr(a, part), getattr(b, part), rtol=1e-6)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    for change, message in (
        ({"names": np.array(["a", "b", "c"])}, "population.npz: '2.times' is missing"),
        ({"1.thickness": np.ones(3, np.float32)}, r"population.npz: .*thickness: shape \(3,\)"),
    ):
        np.savez(path, **{**arrays, **change})
        with pytest.raises(InputError, match=message):
            load_population(path)


# --- patients -----------------------------------------------------------------------------------
def test_chords_are_as_long_as_they_are_stated_by_their_true_factor():
    hidden = {**VALUES, "chord_stiffness": 0.9, "chord_rest_length": 1.01}
    found = motion.chord_ratios(drawn_valve("p", hidden), still(frames=3), 2)
    # The valve does not move, so closed lengths are those to the closed tips.
    chordae = TEMPLATE.chordae()
    ends = chordae.insertion - TEMPLATE.papillary_tips[chordae.end_tip]
    expected = 1.01 * chordae.along(chordae.rest_length) / np.linalg.norm(ends, axis=1)
    ratios = np.concatenate(list(found.values()))
    np.testing.assert_allclose(np.sort(ratios), np.sort(expected), rtol=0.02)
