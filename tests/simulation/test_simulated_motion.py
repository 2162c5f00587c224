"""Simulated valves in motion: what closes, what is drawn, what is refused, and the file of them."""

import itertools
import pickle
import time
from dataclasses import replace

import joblib
import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.problem.registration import REGISTRATION
from mvest.simulation import imaged_patient as patients
from mvest.simulation import motion, population, virtual_patient
from mvest.simulation.imaged_patient import simulate_imaged_patient
from mvest.simulation.motion import (
    DrawnValve,
    MotionLimits,
    MotionSettings,
    RefusedError,
    check_motion,
    close_in_motion,
    frames_along,
)
from mvest.simulation.population import (
    PopulationSettings,
    draw_population,
    load_population,
    save_population,
)
from mvest.simulation.virtual_patient import PatientSimulation
from mvest.valve.anatomy.dimensions import ChordLayout, TemplateParameters
from mvest.valve.anatomy.template import Template
from tests import made_up_closure
from tests.made_up_closure import MadeUpClosure

TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
MECHANICS = MechanicsSettings(TISSUE, ClosureProtocol(pressure_mmHg=100.0, ramp=0.2, dt=0.04))
VALUES = {"E_f.anterior": 6.0, "E_f.posterior": 4.0, "pressure_scale": 1.1}
SMALL = MotionSettings(
    columns=32, rows=9, mesh_columns=16, mesh_rows=2, contact_columns=60, contact_rows=16, steps=6,
    frames=5, held_pressure=(0.8, 0.6), held_relaxation=(0.1, 0.3),
)  # fmt: skip
TEMPLATE = Template()
LAYOUT = ValveLayout(32, 9)
TIP_MOTION = np.array([[0.5, -1.0, 1.5], [0.0, 1.0, 1.0]])


def drawn_valve(name, values=VALUES, mechanics=MECHANICS):
    return DrawnValve(name, TEMPLATE, values, mechanics, TIP_MOTION)


@pytest.fixture(scope="module")
def valve():
    """A valve that is closed in seconds."""
    return close_in_motion(drawn_valve("small"), SMALL)


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
    middle = valve.vertices[:, [LAYOUT.vertex(phi, -1) for phi in (90, 270)]]
    gap = np.linalg.norm(middle[:, 0] - middle[:, 1], axis=1)
    # Free edges are 17 mm apart in the open valve; the closed one coapts.
    assert gap[0] > 15
    assert gap[4] < 6
    # The annulus follows its boundary: closed, and a tenth of its way back.
    start, end = seen.motion.annulus
    for frame, back in ((4, 0.0), (5, 0.1), (6, 0.3)):
        ring = valve.vertices[frame][LAYOUT.annulus]
        # The hinge holds the annulus of a coarse mesh, whose edges are not those that are seen.
        np.testing.assert_allclose(ring[::2], (end + back * (start - end))[::2], atol=0.15)


def test_valves_lie_in_their_own_axes(valve):
    ring = valve.vertices[0][LAYOUT.annulus]
    assert abs(ring[:, 2].mean()) < 1.0
    assert ring[LAYOUT.column(90), 1] > 10 > -10 > ring[LAYOUT.column(270), 1]
    assert ring[LAYOUT.column(0), 0] > 10
    assert valve.tips[0, 0, 0] > 10
    assert valve.tips[..., 2].max() < -20
    a, b, c = valve.vertices[0][LAYOUT.triangles].transpose(1, 0, 2)
    # Out of the lumen and down: open leaflets hang like a funnel.
    outward = np.cross(b - a, c - a)[:, :2] * (a[:, :2] - ring[:, :2].mean(axis=0))
    assert (outward.sum(axis=1) > 0).mean() > 0.9


def test_tips_move_while_the_valve_closes_and_return_with_it(valve):
    closed = TEMPLATE.papillary_tips
    np.testing.assert_allclose(valve.tips[0], closed + TIP_MOTION)
    np.testing.assert_allclose(valve.tips[4], closed)
    np.testing.assert_allclose(valve.tips[5], closed + 0.1 * TIP_MOTION)
    np.testing.assert_allclose(valve.tips[6], closed + 0.3 * TIP_MOTION)
    way = np.linalg.norm(valve.tips[:5] - valve.tips[4], axis=2)
    assert np.all(np.diff(way, axis=0) <= 0)


def test_chordae_of_a_motion_are_those_of_the_template(valve):
    phi, s, _, tip = TEMPLATE.chord_places()
    assert phi.min() < 0 <= valve.chord_phi.min()
    assert valve.chord_phi.max() < 360
    np.testing.assert_allclose(
        TEMPLATE.position(valve.chord_phi, valve.chord_s), TEMPLATE.position(phi, s), atol=1e-9
    )
    np.testing.assert_array_equal(valve.chord_tip, tip)
    # One is absent, so that numbers beyond it shift.
    template = Template(TemplateParameters(chordae=ChordLayout(absent=((250.0, 256.0),))))
    chordae, (phi, s, family, tip) = template.chordae(), template.chord_places()
    assert len(phi) == len(TEMPLATE.chordae()) - 1
    np.testing.assert_array_equal(template.position(phi, s), chordae.insertion)
    np.testing.assert_array_equal(tip, chordae.tip)
    np.testing.assert_array_equal(family, chordae.family)


def test_a_valve_that_does_not_close_is_refused(monkeypatch):
    monkeypatch.setattr(motion, "GIVE_UP", {"max_iterations": 1, "max_halvings": 0})
    with pytest.raises(RefusedError, match="simulated valve soft: the closure does not converge"):
        close_in_motion(drawn_valve("soft"), SMALL)


def test_frames_are_chosen_evenly_along_the_way():
    x = np.array([0.0, 0.1, 0.2, 5.0, 5.2, 9.0, 9.9, 10.0])
    points = x[:, None, None] * np.ones((1, 4, 3))
    np.testing.assert_array_equal(frames_along(points, 3), [0, 3, 7])
    np.testing.assert_array_equal(frames_along(points, 2), [0, 7])
    np.testing.assert_array_equal(frames_along(points, 8), np.arange(8))
    # Every frame once, also where the nearest would be one that is taken.
    snap = np.array([0.0, 9.0, 9.1, 9.2, 10.0])[:, None, None] * np.ones((1, 4, 3))
    np.testing.assert_array_equal(frames_along(snap, 4), [0, 1, 2, 4])


def test_tips_keep_where_they_end():
    seen, moved = TEMPLATE.valve(16, 3), drawn_valve("moved").sampled(16, 3)
    np.testing.assert_allclose(moved.motion.papillary_tips[-1], seen.papillary_tips)
    np.testing.assert_allclose(moved.motion.papillary_tips[0], seen.papillary_tips + TIP_MOTION)
    np.testing.assert_array_equal(moved.motion.papillary_tips[0], moved.papillary_tips)
    with pytest.raises(InputError, match=r"shape \(3,\), expected \(2, 3\)"):
        replace(drawn_valve("moved"), tip_motion=np.zeros(3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"held_pressure": (0.5,)}, "expected as many"),
        ({"frames": 9}, "frames = 9 to the closed one, expected 2 to 8"),
        ({"frames": 1}, "frames = 1"),
    ],
)
def test_settings_of_a_motion_are_checked(change, message):
    with pytest.raises(InputError, match=message):
        replace(SMALL, **change)


# --- refusals -----------------------------------------------------------------------------------


FLAILING = REST * np.array([1, 1, -1.0])
# Free edges beyond the opposite ones.
CROSSED = REST - [[0.0, 2.0, 0.0]] * LAYOUT.s[:, None] * (REST - 1.8)


@pytest.mark.parametrize(
    ("limits", "vertices", "words"),
    [
        ({}, REST, "of its orifice open"),
        ({"orifice": 2.0}, REST, "mm apart"),
        ({"orifice": 2.0, "edge_gap": 50.0, "stretch": 10.0}, FLAILING, "above the annulus"),
        ({"orifice": 5.0, "edge_gap": 50.0}, 1.7 * REST, "stretched to 1.70"),
        ({"orifice": 2.0, "edge_gap": 50.0, "stretch": 10.0}, CROSSED, "pass through each other"),
    ],
)
def test_what_no_valve_does_is_refused(limits, vertices, words):
    with pytest.raises(RefusedError, match=f"simulated valve still: .*{words}"):
        check_motion(still(vertices=vertices), 1, MotionLimits(**limits))


def test_what_a_valve_may_do_passes(valve):
    check_motion(valve, 4, MotionLimits())
    check_motion(still(), 1, MotionLimits(orifice=2.0, edge_gap=50.0, stretch=10.0))
    check_motion(still(vertices=1.5 * REST), 1, MotionLimits(orifice=5.0, edge_gap=50.0))


# --- populations --------------------------------------------------------------------------------

BASES = {
    "one": TemplateParameters(),
    "other": TemplateParameters().changed({"annulus.anteroposterior_half_axis": 15.0}),
}


@pytest.fixture
def closings(monkeypatch):
    """What valves would be closed with; every third of the anatomy ``other`` is refused."""
    calls = []

    def close(drawn, settings):
        calls.append((drawn, settings))
        if drawn.name.startswith("other") and len(calls) % 3 == 0:
            raise RefusedError(drawn.name, "a test")
        # Something by which valves can be told apart.
        return replace(still(drawn.name), vertices=still().vertices * drawn.values["E_f.anterior"])

    monkeypatch.setattr(population, "close_in_motion", close)
    return calls


def population_of(count, seed, bases=BASES, **settings):
    return tuple(draw_population(count, seed, bases, PopulationSettings(), MECHANICS, **settings))


def same_shape(one, other):
    return [np.array_equal(a.vertices, b.vertices) for a, b in zip(one, other, strict=True)]


def test_a_population_is_drawn_by_its_seed(closings):
    one, same, other = (population_of(6, seed) for seed in (1, 1, 2))
    assert [v.name for v in one] == [v.name for v in same]
    assert sum(v.name.startswith("one") for v in one) == 3
    assert len({v.name for v in (*one, *other)}) == 12
    alike = same_shape(one, same)
    # What another valve is refused for does not change a valve.
    not_refused = [v.name.startswith("one") for v in one]
    assert all(a for a, free in zip(alike, not_refused, strict=True) if free)
    assert not any(same_shape(one, other))


def test_refused_valves_are_drawn_again(closings):
    assert len(population_of(6, 1)) == 6 < len(closings)
    valves = [valve for valve, _ in closings]
    again = [(a, b) for a, b in itertools.pairwise(valves) if a.name == b.name]
    assert again
    for a, b in again:
        assert a.template.parameters != b.template.parameters
        assert a.values != b.values


def test_a_valve_that_is_always_refused_is_an_error(monkeypatch):
    def refuse(drawn, _):
        raise RefusedError(drawn.name, "a test")

    monkeypatch.setattr(population, "close_in_motion", refuse)
    with pytest.raises(GeometryError, match="one_1_000: refused 20 times"):
        population_of(1, 1, {"one": BASES["one"]})


def test_what_is_drawn_spreads_as_requested(closings):
    population_of(60, 4, {"one": BASES["one"]})
    assert len(closings) == 60
    for name, median, spread in (
        ("E_f.anterior", 6.23, 0.35),
        ("E_f.posterior", 2.09, 0.35),
        ("pressure_scale", 1.0, 0.12),
        ("chord_rest_length", 1.0, 0.015),
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
            towards = (chordae.insertion[chordae.tip == k] - closed[k]).mean(axis=0)
            assert valve.tip_motion[k] @ towards > 0


def test_processes_change_nothing(monkeypatch):
    def close(drawn, _):
        if drawn.values["E_f.anterior"] > 7:
            raise RefusedError(drawn.name, "a test")
        # The first valve of two is the last to be ready.
        time.sleep(0.05 * drawn.name.endswith("0"))
        return replace(still(drawn.name), vertices=still().vertices * drawn.values["E_f.anterior"])

    monkeypatch.setattr(population, "close_in_motion", close)
    config = joblib.parallel_config
    # Threads, as what is replaced here is not replaced in other processes.
    monkeypatch.setattr(joblib, "parallel_config", lambda **_: config(backend="threading"))
    one, two = (population_of(8, 3, processes=processes) for processes in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert a.name == b.name
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_what_goes_to_another_process_arrives_there(valve):
    for sent in (BASES["one"], PopulationSettings(SMALL), MECHANICS):
        assert pickle.loads(pickle.dumps(sent)) == sent
    back = pickle.loads(pickle.dumps(valve))
    np.testing.assert_array_equal(back.vertices, valve.vertices)
    assert back.layout == valve.layout


def test_settings_of_a_population_are_checked():
    for count, bases, processes in ((0, BASES, 1), (1, {}, 1), (1, BASES, 0)):
        with pytest.raises(InputError, match="expected at least one of each"):
            population_of(count, 1, bases, processes=processes)
    for change in ({"scale": (1.5, 1.0)}, {"tip_motion": (-1.0, 1.0)}):
        with pytest.raises(InputError, match=f"population {next(iter(change))}"):
            PopulationSettings(**change)


# --- files --------------------------------------------------------------------------------------


@pytest.fixture
def drawn():
    one = {"chord_phi": np.array([1.0]), "chord_s": np.ones(1), "chord_tip": np.array([1])}
    return replace(still("first"), **one), still("second", frames=4)


def test_a_population_is_the_same_after_its_file(drawn, tmp_path):
    path = tmp_path / "population.npz"
    save_population(path, drawn)
    assert [file.name for file in tmp_path.iterdir()] == ["population.npz"]
    back = load_population(path)
    for a, b in zip(drawn, back, strict=True):
        assert a.name == b.name
        assert a.layout == b.layout
        for part in ("times", "vertices", "tips", "thickness", "chord_phi", "chord_s"):
            np.testing.assert_allclose(getattr(a, part), getattr(b, part), rtol=1e-6)
            assert getattr(b, part).dtype == np.float64
        np.testing.assert_array_equal(a.chord_tip, b.chord_tip)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"names": np.array(["a", "b", "c"])}, "'2.layout' is missing"),
        ({"0.layout": np.array([32, 9, 1])}, r"layout is int64 of shape \(3,\)"),
        ({"1.thickness": np.ones(3, np.float32)}, r"thickness: shape \(3,\)"),
        ({"1.thickness": np.full(288, np.nan, np.float32)}, "thickness has values that are"),
        ({"0.times": np.zeros(2, np.float32)}, "moving valve first: times"),
        ({"0.times": np.zeros(2, int)}, "times is int64 of .*, expected finite numbers"),
    ],
)
def test_a_file_that_is_not_as_it_must_be_is_refused(drawn, tmp_path, change, message):
    path = tmp_path / "p.npz"
    save_population(path, drawn)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez(path, **{**arrays, **change})
    with pytest.raises(InputError, match=message) as refused:
        load_population(path)
    assert str(path) in str(refused.value)


def test_a_file_of_something_else_is_refused(drawn, tmp_path):
    path = tmp_path / "p.npz"
    with pytest.raises(InputError, match="is missing"):
        load_population(path)
    with pytest.raises(InputError, match="cannot write"):
        save_population(tmp_path / "none" / "p.npz", drawn)
    save_population(path, drawn)
    for content in (b"", b"nothing", pickle.dumps([1, 2]), path.read_bytes()[:2000]):
        path.write_bytes(content)
        with pytest.raises(InputError, match="cannot be read"):
            load_population(path)
    np.savez(path, times=np.array([1.0]))
    with pytest.raises(InputError, match="'names' is missing"):
        load_population(path)


# --- patients -----------------------------------------------------------------------------------

SIMULATION = PatientSimulation(
    held_pressure_mmHg=(80.0,), held_relaxation=(0.2,), held_tips=(0.0, 0.0, 0.0)
)
HIDDEN = {**VALUES, "chord_stiffness": 0.9, "chord_rest_length": 1.01}


@pytest.fixture
def made(monkeypatch):
    """A patient whose fine closure is a formula and whose closing frames are halfway to it."""
    closure = MadeUpClosure(tuple(HIDDEN))
    rest = made_up_closure.VALVE.surface.vertices

    def close(drawn, _):
        assert drawn.values == HIDDEN
        tips = TEMPLATE.papillary_tips + np.linspace(1, 0, 4)[:, None, None] * drawn.tip_motion
        return [rest * (1 - 0.01 * k) for k in range(4)], list(tips), closure

    monkeypatch.setattr(patients, "closing_frames", close)
    monkeypatch.setattr(virtual_patient, "_model", lambda *_: closure)
    wide = MotionLimits(2.0, 50.0, 50.0, 10.0, 100_000)
    displaced = dict.fromkeys(REGISTRATION, 3.0)
    valve = drawn_valve("p", {**HIDDEN, **displaced})
    return simulate_imaged_patient(valve, SIMULATION, replace(SMALL, limits=wide))


def test_an_imaged_patient_is_closed_as_a_patient_and_nowhere_displaced(made):
    assert (made.closed, made.pressure_mmHg, made.values) == (3, 100.0, HIDDEN)
    rest = made_up_closure.VALVE.surface.vertices
    # The formula, not the coarse closed frame.
    expected = [rest, 0.99 * rest, 0.98 * rest, made_up_closure.shape(HIDDEN, 100.0)]
    np.testing.assert_allclose(made.valve.vertices[:4], expected)
    assert len(made.valve.vertices) == 5
    closed = TEMPLATE.papillary_tips
    for frame, share in ((0, 1.0), (1, 2 / 3), (2, 1 / 3), (3, 0.0), (4, 0.2)):
        np.testing.assert_allclose(made.valve.tips[frame], closed + share * TIP_MOTION)
    np.testing.assert_array_equal(made.stated.chordae.rest_length, TEMPLATE.chordae().rest_length)
    assert made.stated.surface.vertices.shape == made.valve.vertices[0].shape


def test_chord_ratios_are_true_lengths_over_what_they_span_in_the_closed_valve(made):
    # A valve twice as large when it is closed, in which a chord spans twice as much.
    twice, tips = made.valve.vertices.copy(), made.valve.tips.copy()
    twice[made.closed], tips[made.closed] = 2 * twice[0], 2 * TEMPLATE.papillary_tips
    patient = replace(made, valve=replace(made.valve, vertices=twice, tips=tips))
    chordae = TEMPLATE.chordae()
    spans = np.linalg.norm(chordae.insertion - TEMPLATE.papillary_tips[chordae.tip], axis=1)
    ratios = patient.chord_ratios()
    assert set(ratios) == {"marginal", "basal"}
    for family, name in enumerate(chordae.family_names):
        own = chordae.family == family
        expected = 1.01 * chordae.rest_length[own] / (2 * spans[own])
        # Insertions lie on the curved leaflet, ends on flat triangles.
        np.testing.assert_allclose(ratios[name], expected, rtol=0.02)


def test_an_imaged_patient_is_in_equilibrium():
    moving = replace(MECHANICS, protocol=replace(MECHANICS.protocol, equilibrium=False))
    with pytest.raises(InputError, match="equilibrium = False, expected True"):
        simulate_imaged_patient(drawn_valve("p", HIDDEN, moving), SIMULATION, SMALL)
