"""Kept closed states: the same digits with and without them, in any order, and after damage."""

from dataclasses import replace

import numpy as np
import pytest

import mvest.cache
from mvest.closure.anchors import SPACING, Coordinates, content_digest
from mvest.closure.model import ClosureModel
from mvest.errors import InputError, MaterialError
from mvest.mechanics.settings import ModulusField
from mvest.mechanics.steps import StepReason
from mvest.processes import side_by_side
from tests.closure.test_model import AT, CLOSING, GENTLE, MODULI, OPEN, TINY, model_of

# In one cell of the lattice, whose middle is (e^1.6, e^1.2) = (4.95, 3.32), and in another.
NEAR, OTHER = np.array([5.5, 3.6]), np.array([6.3, 3.6])


def gentle(folder, **changes):
    """A valve that closes in no time, where its closed states are kept."""
    return replace(model_of(GENTLE, **TINY), continuation=True, anchors=folder, **changes)


def files(folder):
    return sorted(folder.glob("closed-*.npz"))


@pytest.fixture
def anchored(monkeypatch):
    """The parameters at which anchors were made."""
    true, made = ClosureModel._anchor, []

    def anchor(self, at):
        made.append(at)
        return true(self, at)

    monkeypatch.setattr(ClosureModel, "_anchor", anchor)
    return made


def test_the_closed_state_is_the_same_with_and_without_an_anchor(tmp_path, anchored):
    guide = model_of(CLOSING, cells=(10, 2))
    model = replace(model_of(CLOSING), continuation=True, guide=guide)
    plain = model.close(NEAR).simulation
    assert plain.records[-1].active_contacts > 200
    model = replace(model.fresh(), anchors=tmp_path)
    for k in range(2):
        closed = model.fresh().close(NEAR).simulation
        # From the anchor to the equilibrium, and no other way; made once.
        assert len(closed.times) == 2
        assert len(anchored) == len(files(tmp_path)) == 1
        np.testing.assert_allclose(closed.frames[-1], plain.frames[-1], rtol=0, atol=1e-9)
        scale = np.abs(plain.sensitivities[-1]).max()
        difference = closed.sensitivities[-1] - plain.sensitivities[-1]
        assert np.abs(difference).max() < 1e-7 * scale
        if k == 0:
            first = closed
    # Whoever made it goes on from what is kept, as those that find it.
    np.testing.assert_array_equal(closed.frames[-1], first.frames[-1])
    np.testing.assert_array_equal(closed.sensitivities[-1], first.sensitivities[-1])
    np.testing.assert_allclose(anchored[0], np.exp([1.6, 1.2]), rtol=1e-14)


def test_nothing_depends_on_the_order_of_jobs(tmp_path):
    found = []
    for order in ((NEAR, OTHER, 1.1 * NEAR), (1.1 * NEAR, OTHER, NEAR)):
        folder = tmp_path / str(len(found))
        jobs = {m.tobytes(): gentle(folder).close(m).simulation for m in order}
        kept = [np.load(file)["positions"].tobytes() for file in files(folder)]
        assert len(kept) == 2
        found.append((jobs[NEAR.tobytes()].frames[-1].tobytes(), kept))
    assert found[0] == found[1]


def test_only_a_closure_without_a_near_state_begins_at_an_anchor(tmp_path, anchored):
    model = gentle(tmp_path)
    model.close(NEAR)
    model.close(OTHER)
    assert len(anchored) == 1
    # Beyond the reach of the last state it is another anchor's, within it none; and one that is
    # itself out of reach is no help.
    for reach, expected in ((0.3, 2), (1.5, 1), (0.01, 0)):
        anchored.clear()
        far = gentle(tmp_path / str(reach), reach=reach)
        far.close(NEAR)
        far.close(3.0 * NEAR)
        assert len(anchored) == expected
    anchored.clear()
    replace(gentle(tmp_path), continuation=False).close(NEAR)
    gentle(tmp_path).close(NEAR, sensitivities=False, every_frame=True)
    moving = replace(model_of(OPEN, **TINY), continuation=True, anchors=tmp_path)
    moving.close(NEAR, sensitivities=False)
    assert not anchored


def test_the_anchor_is_the_nearest_point_of_the_lattice(tmp_path, anchored):
    fields = {"anterior": ModulusField(8.0, 0.4, 2)}
    names = (*MODULI, "field.anterior.0")
    settings = replace(model_of(GENTLE, **TINY).settings, fields=fields)
    for k in range(4):
        m = np.random.default_rng(k).uniform([3.0, 2.0, -3.0], [9.0, 6.0, 3.0])
        replace(gentle(tmp_path), names=names, settings=settings).close(m)
        at = anchored[-1]
        # The coefficient counts by what it does to log E_f.
        off = np.array([*np.log(m[:2] / at[:2]), 0.4 * (m[2] - at[2])])
        assert np.abs(off).max() <= SPACING / 2
        whole = np.array([*np.log(at[:2]), 0.4 * at[2]]) / SPACING
        np.testing.assert_allclose(whole, np.round(whole), atol=1e-9)


def test_a_kept_state_belongs_to_all_that_decides_it(tmp_path, monkeypatch):
    base = gentle(tmp_path)
    contact = replace(base.contact_valve, papillary_tips=base.contact_valve.papillary_tips + 0.1)
    changed = [
        gentle(tmp_path),
        replace(base, mesh=model_of(GENTLE, cells=(10, 1), samples=(16, 5)).mesh),
        replace(base, contact_valve=contact),
        replace(base, settings=replace(base.settings, density=2e-9)),
        replace(base, fixed={"pressure_scale": 0.99}),
        replace(base, guide=model_of(GENTLE, **TINY)),
    ]
    for k, model in enumerate(changed):
        model.close(NEAR)
        assert len(files(tmp_path)) == k + 1
    monkeypatch.setattr(mvest.cache, "code_digest", lambda folder: "changed")
    gentle(tmp_path).close(NEAR)
    assert len(files(tmp_path)) == len(changed) + 1
    # What only decides where a closure begins is none of it.
    monkeypatch.undo()
    replace(gentle(tmp_path), reach=3.0, largest_change=0.3).close(NEAR)
    assert len(files(tmp_path)) == len(changed) + 1


def damage_bytes(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(bytes(content))


def cut(file):
    file.write_bytes(file.read_bytes()[:-300])


def change_contents(file):
    # A sound archive whose positions are others than those that were written.
    with np.load(file) as stored:
        contents = dict(stored)
    np.savez(file, **contents | {"positions": contents["positions"] + 1e-6})


@pytest.mark.parametrize("harm", [damage_bytes, cut, change_contents])
def test_damage_is_noticed_and_made_again(tmp_path, anchored, capsys, harm):
    expected = gentle(tmp_path).close(NEAR).simulation.frames[-1]
    (file,) = files(tmp_path)
    with np.load(file) as stored:
        sound = stored["positions"].tobytes()
    harm(file)
    again = gentle(tmp_path).close(NEAR).simulation.frames[-1]
    np.testing.assert_array_equal(again, expected)
    assert len(anchored) == 2
    assert "is damaged and is made again" in capsys.readouterr().err
    with np.load(file) as stored:
        assert stored["positions"].tobytes() == sound


def test_an_anchor_that_does_not_close_is_kept_as_such(tmp_path, anchored, monkeypatch):
    true = ClosureModel._close

    def close(self, m, sensitivities=True, *, every_frame=False):
        result = true(self, m, sensitivities, every_frame=every_frame)
        if np.allclose(m, np.exp([1.6, 1.2]), rtol=1e-12):
            failed = replace(result.simulation, reason=StepReason.NO_CONVERGENCE)
            return replace(result, simulation=failed)
        return result

    monkeypatch.setattr(ClosureModel, "_close", close)
    for _ in range(2):
        closed = gentle(tmp_path).close(NEAR).simulation
        assert closed.converged
        assert len(closed.times) > 2
    assert len(anchored) == 1


def test_parameters_that_the_anchor_may_not_have_need_none(tmp_path, monkeypatch):
    def refuse(self, m, sensitivities=True, *, every_frame=False):
        raise MaterialError("inadmissible")

    model = gentle(tmp_path)
    monkeypatch.setattr(ClosureModel, "_close", refuse)
    assert not model._begin_at_anchor(NEAR)
    assert len(files(tmp_path)) == 1
    # What is inadmissible itself is refused as ever, before anything is closed.
    with pytest.raises(MaterialError, match="E_f"):
        model.close(np.array([-1.0, 2.0]))
    with pytest.raises(InputError, match="posterior"):
        replace(model, names=(*MODULI, "field.posterior.0")).close(np.array([5.0, 3.0, 0.1]))


def test_a_closure_that_fails_from_its_anchor_is_the_one_from_the_open_valve(tmp_path, monkeypatch):
    model = gentle(tmp_path, repeat=False)
    expected = model.fresh().close(NEAR).simulation.frames[-1]
    true, starts = ClosureModel._close, []

    def close(self, m, sensitivities=True, *, every_frame=False):
        result = true(self, m, sensitivities, every_frame=every_frame)
        starts.append(len(result.simulation.times))
        if starts[-1] == 2:
            failed = replace(result.simulation, reason=StepReason.NO_CONVERGENCE)
            return replace(result, simulation=failed)
        return result

    monkeypatch.setattr(ClosureModel, "_close", close)
    again = model.close(NEAR).simulation
    assert again.converged
    assert len(again.times) == starts[-1] > 2
    np.testing.assert_allclose(again.frames[-1], expected, rtol=0, atol=1e-9)


def test_processes_share_anchors(tmp_path):
    model = gentle(tmp_path)
    values = NEAR * np.linspace(0.95, 1.0, 4)[:, None]
    calls = ((model.fresh(), m) for m in values)
    shared = list(side_by_side(ClosureModel.__call__, calls, 2))
    assert len(files(tmp_path)) == 1
    for m, prediction in zip(values, shared, strict=True):
        plain = replace(model.fresh(), anchors=None)(m)
        np.testing.assert_allclose(prediction.y, plain.y, rtol=0, atol=1e-9)


def test_a_digest_tells_values_apart_and_nothing_else():
    a = np.arange(6.0)
    values = [
        a,
        a.reshape(2, 3),
        a.astype(np.float32),
        a.copy(),
        list(a),
        tuple("ab"),
    ]
    values += [("a", "b", ""), {"a": 1}, {"a": 1.0}, {"b": 1}, None, True, "True"]
    values += [Coordinates(a, a), Coordinates(a, a[:0])]
    digests = [content_digest(v) for v in values]
    assert digests[0] == digests[3]
    assert len(set(digests)) == len(values) - 1
    assert content_digest({"a": 1, "b": 2}) == content_digest({"b": 2, "a": 1})
    assert content_digest(np.float64(1.5)) == content_digest(1.5)
    with pytest.raises(InputError, match="no digest of a function"):
        content_digest(content_digest)


def test_coordinates_there_and_back():
    names = (*MODULI, "field.anterior.1")
    settings = replace(
        model_of(OPEN, **TINY).settings, fields={"anterior": ModulusField(8.0, 0.4, 2)}
    )
    coordinates = Coordinates.of(names, settings)
    m = np.array([*AT, -0.7])
    at = coordinates(m)
    np.testing.assert_allclose(at, [np.log(AT[0]), np.log(AT[1]), -0.28])
    np.testing.assert_allclose(coordinates.parameters(at), m)
    assert coordinates(np.array([0.0, 1.0, 1.0])) is None
    assert coordinates.distance(m, np.array([1.0, -1.0, 1.0])) == np.inf
    assert not coordinates.between(m, np.array([1.0, -1.0, 1.0]), 0.1)
