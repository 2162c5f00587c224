"""Contact: the law between parallel sheets, smoothness, balance, and that leaflets do not pass.

Its Hessian is compared with differences among the tangents of all loads.
"""

import ipctk
import numpy as np
import pytest

from mvest.mechanics.forces.contact import (
    APPROACH,
    BARRIER,
    Contact,
)
from mvest.mechanics.forces.pair_search import NEIGHBOUR, ContactPairs
from mvest.mechanics.settings import ContactSettings
from mvest.valve.mesh.solid_mesh import Embedding
from tests.mechanics.bodies import grid_triangles, point_masses

P0, R0, H = 0.02, 1.2, 2.0  # MPa and, for a thickness of 1 mm, mm
RB = BARRIER * R0
SETTINGS = ContactSettings(P0, R0, H)
FAR = 100.0


def contact_of(rest, areas=None, settings=SETTINGS, triangles=None, host=None, skin=1.0):
    n = len(rest)
    points = point_masses(n)
    if host is not None:
        points = Embedding(points.nodes, points.weights, host)
    return Contact(
        points,
        rest,
        np.ones(n) if areas is None else areas,
        np.ones(n),
        np.array([[0, 1, 2]]) if triangles is None else triangles,
        settings,
        skin,
    )


def energy_of(contact, pairs, y):
    """Contact energy in N mm."""
    r = np.linalg.norm(y[pairs.first] - y[pairs.second], axis=1)
    gap = np.maximum(pairs.reach - r, 0.0) / (pairs.reach - pairs.reference)
    barrier = BARRIER * pairs.reference
    phi = contact.settings.reference_pressure * gap**4 / (2 * np.pi * r)
    phi *= ((pairs.reference - barrier) / (r - barrier)) ** 2
    areas = contact.sheet.areas
    return float(np.sum(areas[pairs.first] * areas[pairs.second] * phi))


def pair(distance):
    """Two points of area 1 mm^2, far apart at rest, now at `distance`; a third stays away."""
    contact = contact_of(np.array([[0.0, 0, 0], [FAR, 0, 0], [0, FAR, 0]]))
    y = np.array([[0.0, 0, 0], [distance, 0, 0], [0, FAR, 0]])
    return contact, contact.search(y), y


def pressure_between_sheets(distance, spacing):
    """Force per area on a point above a large regular sheet of points, at an arbitrary offset."""
    n = int(np.ceil((H + 0.5) / spacing))
    line = spacing * (np.arange(-n, n + 1) + 0.31)
    below = np.stack(np.meshgrid(line, 1.07 * line, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    y = np.concatenate([[[0.0, 0.0, distance]], below])
    areas = np.full(len(y), 1.07 * spacing**2)
    areas[0] = 1.0
    k = len(below)
    pairs = ContactPairs(
        np.zeros(k, dtype=int), np.arange(1, k + 1), np.full(k, H), np.full(k, R0),
        np.array([0, k]), np.zeros((1, 2), dtype=int), y,
    )  # fmt: skip
    return -contact_of(y, areas).forces(pairs, y)[0, 2]


@pytest.mark.parametrize("distance", [1.15, 1.5])
def test_points_press_like_parallel_sheets(distance):
    # p(d) = p0 ((h - d) / (h - r0))^4 ((r0 - rb) / (d - rb))^2. The sum over points approaches the
    # integral; a wrong factor (2 pi, 2, or phi for its derivative) shows at once.
    expected = P0 * ((H - distance) / (H - R0)) ** 4 * ((R0 - RB) / (distance - RB)) ** 2
    spacings = np.array([0.4, 0.2, 0.1])
    errors = [abs(pressure_between_sheets(distance, s) / expected - 1) for s in spacings]
    assert errors[0] < 0.25
    assert errors[2] < 1e-3
    # Faster than the third order: the kernel is smooth where it acts.
    assert np.polyfit(np.log(spacings), np.log(errors), 1)[0] > 3


def test_force_vanishes_with_the_third_order_at_activation():
    # phi = p / (2 pi r) with p ~ (h - r)^4, so phi' ~ (h - r)^3: the force and its first two
    # derivatives are continuous at activation (C3 in the energy). Order by a log-log fit.
    gaps = np.array([1e-2, 5e-3, 2.5e-3])
    force = [np.linalg.norm(c.forces(p, y)[0]) for c, p, y in map(pair, H - gaps)]
    assert np.polyfit(np.log(gaps), np.log(force), 1)[0] == pytest.approx(3, abs=0.05)
    contact, pairs, y = pair(H + 1e-9)
    assert np.all(contact.forces(pairs, y) == 0)


@pytest.fixture(scope="module")
def cloud():
    """Two rough sheets of points in contact, each point its own host."""
    random = np.random.default_rng(2)
    line = np.linspace(0, 3, 6)
    plane = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    y = np.concatenate([np.column_stack([plane, np.full(36, z)]) for z in (0.0, 1.2)])
    y = y + random.uniform(-0.1, 0.1, y.shape)
    rest = y + np.where(np.arange(72) < 36, 0, FAR)[:, None]
    contact = contact_of(rest, random.uniform(0.2, 0.4, 72), host=np.arange(72))
    pairs = contact.search(y)
    assert contact.active(pairs, y) > 100
    return contact, pairs, y


def test_force_is_the_gradient_of_the_energy(cloud):
    contact, pairs, y = cloud
    d = np.random.default_rng(0).uniform(-1, 1, y.shape)
    slope = np.sum(contact.forces(pairs, y) * d)
    errors = []
    for h in (4e-3, 2e-3, 2e-5):
        ahead, behind = (energy_of(contact, pairs, y + sign * h * d) for sign in (1, -1))
        errors.append(abs((ahead - behind) / (2 * h) - slope))
    assert errors[2] < 1e-6 * abs(slope)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)


def test_action_equals_reaction(cloud):
    contact, pairs, y = cloud
    force = contact.forces(pairs, y)
    assert np.abs(force).max() > 1e-4
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-15)
    np.testing.assert_allclose(np.cross(y, force).sum(axis=0), 0, atol=1e-14)


def test_the_search_finds_all_pairs_that_can_become_active_before_it_is_stale():
    random = np.random.default_rng(8)
    y = random.uniform(0, 6, (150, 3))
    rest = y + FAR * np.arange(150)[:, None]
    contact = contact_of(rest, skin=0.6)
    pairs = contact.search(y)
    step = random.normal(size=y.shape)
    moved = y + 0.299 * step / np.linalg.norm(step, axis=1, keepdims=True)
    assert not contact.stale(pairs, moved)
    assert contact.stale(pairs, y + np.array([0.31, 0, 0]))
    fresh = contact.search(moved)
    assert contact.active(pairs, moved) == contact.active(fresh, moved)
    np.testing.assert_allclose(
        contact.forces(pairs, moved), contact.forces(fresh, moved), atol=1e-12
    )


def test_the_search_finds_what_comparing_all_points_finds():
    # Several points to a host, hosts in no order, a point far away, one flat layer of cells.
    random = np.random.default_rng(9)
    y = random.uniform(0, 9, (200, 3)) * [1, 1, 0.02]
    y[-1] = [60.0, -40.0, 0.0]
    rest = y + random.normal(scale=1.5, size=y.shape)
    host = random.integers(0, 30, 200)
    contact = contact_of(rest, host=host, skin=0.4)
    pairs = contact.search(y)
    settings, t = contact.settings, contact.sheet.thickness
    expected = {}
    for i in range(200):
        for j in range(i + 1, 200):
            mean = 0.5 * (t[i] + t[j])
            full = settings.activation_distance * mean
            reach = min(full, NEIGHBOUR * np.linalg.norm(rest[i] - rest[j]))
            near = np.linalg.norm(y[i] - y[j]) < reach + 0.4
            if near and reach > 0.5 * settings.reference_distance * mean:
                reference = settings.reference_distance * mean * reach / full
                expected[i, j] = (reach, reference)
    found = {
        (min(i, j), max(i, j)): (reach, reference)
        for i, j, reach, reference in zip(
            pairs.first, pairs.second, pairs.reach, pairs.reference, strict=True
        )
    }
    assert len(found) == len(pairs.first) > 500
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        np.testing.assert_allclose(found[key], values, rtol=1e-14)
    first, second = host[pairs.first], host[pairs.second]
    assert np.all(first <= second)
    for k, (one, other) in enumerate(pairs.hosts):
        group = slice(pairs.start[k], pairs.start[k + 1])
        assert np.all(first[group] == one)
        assert np.all(second[group] == other)
    keys = pairs.hosts[:, 0] * 30 + pairs.hosts[:, 1]
    assert np.all(np.diff(keys) > 0)


def test_a_step_takes_from_a_pair_at_most_its_share_of_the_way_to_the_barrier():
    contact, pairs, y = pair(1.4)
    dy = np.array([[0.0, 0, 0], [-10.0, 0.05, 0], [0, 0, 0]])
    factor = contact.largest_step(pairs, y, dy)
    after = np.linalg.norm(np.diff(y + factor * dy, axis=0)[0])
    assert after == pytest.approx(RB + (1 - APPROACH) * (1.4 - RB), rel=1e-6)
    assert contact.largest_step(pairs, y, -dy) == 1.0


def two_sheets(gap, spacing=0.7, points=9):
    """Two flat sheets that were far apart at rest, with what lies between them."""
    line = spacing * np.arange(points)
    plane = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    lower = np.column_stack([plane, np.zeros(len(plane))])
    upper = np.column_stack([plane + 0.3 * spacing, np.full(len(plane), gap)])
    triangles = grid_triangles(points)
    contact = contact_of(
        np.concatenate([lower, upper + np.array([0, 0, FAR])]),
        triangles=np.concatenate([triangles, triangles + len(plane)]),
    )
    return contact, np.concatenate([lower, upper]), np.repeat([0.0, 1.0], len(plane))


@pytest.fixture
def detections(monkeypatch):
    """How often collisions were looked for."""
    true, seen = ipctk.compute_collision_free_stepsize, []

    def detect(*arguments, **options):
        seen.append(1)
        return true(*arguments, **options)

    monkeypatch.setattr(ipctk, "compute_collision_free_stepsize", detect)
    return seen


@pytest.mark.parametrize(
    ("spacing", "gap", "moved", "down"),
    [(1.6, 1.4, 0.0, 0.1), (0.7, 6.0, 0.0, 2.0), (0.7, 1.6, 0.49, 0.4)],
    ids=["long edges", "beyond the search", "long after the search"],
)
def test_collisions_are_looked_for_where_nothing_is_proved(detections, spacing, gap, moved, down):
    contact, y, upper = two_sheets(gap, spacing)
    pairs = contact.search(y)
    y = y + np.outer(1 - upper, [moved, 0.0, 0.0])
    assert not contact.stale(pairs, y)
    contact.largest_step(pairs, y, np.outer(upper, [0.0, 0.0, -down]))
    assert len(detections) == 1


def test_sheets_that_touch_are_no_start_of_a_step(capfd):
    """Detection from a distance of nearly zero does not end and takes gigabytes: two edges 8e-15 mm
    apart, of a leaflet of 1 MPa that had rolled up."""
    rest = FAR * np.eye(6, 3) + FAR * np.eye(6, 3, -3) * [[2.0]]
    contact = contact_of(rest, triangles=np.array([[0, 1, 4], [2, 3, 5]]))
    edges = np.array(
        [
            [-16.051336303482632, 4.644382933368503, -3.6001434736602302],
            [-15.93223538855475, 4.618859321040644, -4.0436619334687],
            [-15.880946106567379, 4.912033664899875, -3.3915170813866813],
            [-16.060619502794605, 4.568738949182942, -3.780771842361751],
        ]
    )
    moved = np.array(
        [
            [-16.05867107133735, 4.608830319870311, -3.612349697076018],
            [-15.94821851984567, 4.568444516842367, -4.035590697163797],
            [-15.910823777859619, 4.897769255752416, -3.3974812906940786],
            [-16.10180529753734, 4.5218273498250525, -3.796768158761757],
        ]
    )
    y, dy = np.zeros((6, 3)), np.zeros((6, 3))
    y[:4], dy[:4] = edges, moved - edges
    y[4], y[5] = edges[0] - [0, 0, 9.0], edges[2] + [0, 9.0, 0]
    pairs = contact.search(y)
    assert contact.largest_step(pairs, y, dy) == 0.0
    apart = y - np.outer([1, 1, 0, 0, 1, 0], [0.0, 0.0, 1.0])
    assert contact.largest_step(pairs, apart, dy, detect=True) == 1.0
    assert capfd.readouterr().out == ""


def test_what_is_proved_apart_is_free_of_collisions():
    # Random states and moves; where distances prove that nothing meets, detection agrees. The
    # points of a third are neighbours at rest but not in the sheet, as at a commissure.
    random = np.random.default_rng(11)
    proved = 0
    for k in range(60):
        contact, y, upper = two_sheets(gap=random.uniform(0.8, 3.0), points=6)
        if k % 3 == 0:
            rest = contact.sheet.rest - np.outer(upper, [0.0, 0.0, FAR - 0.5])
            contact = contact_of(rest, triangles=contact.passing.triangles)
        y = y + random.normal(scale=0.05, size=y.shape)
        pairs = contact.search(y)
        move = random.uniform(0, 2) * np.outer(upper, random.uniform(-1, 1, 3))
        move += random.normal(scale=0.1, size=y.shape)
        if contact.passing.stays_apart(pairs, y, move):
            proved += 1
            start, end = np.asfortranarray(y), np.asfortranarray(y + move)
            mesh = contact.passing.mesh
            assert ipctk.compute_collision_free_stepsize(mesh, start, end) == 1.0
    assert proved > 5


def test_crossing_sheets_are_noticed():
    contact, y, _ = two_sheets(gap=3.0)
    for height, crosses in ((0.1, False), (-0.1, True)):
        y[-41, 2] = height  # the middle of the upper sheet
        assert contact.intersects(y) == crosses
