"""The reader of recorded closures on a small made-up one, and on the real one if it is here."""

import os
import re
from pathlib import Path

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.exchange.abaqus.recording import Recording, read_recording, trace_cables, truss_stiffness
from tests.exchange.surfaces.recorded import CASE, DOWN, NAMES, OGDEN, ROUND, skirt, write
from tests.places import ROOT


def read(folder: Path) -> Recording:
    return read_recording(folder / CASE, **NAMES)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    write(folder, skirt())
    return read(folder)


def test_reader(recording):
    valve = recording.valve
    surface, motion = valve.surface, valve.motion
    assert len(surface.triangles) == 2 * ROUND * DOWN
    assert np.bincount(surface.region) == pytest.approx([192, 192, 192])
    assert surface.region_names == ("anterior", "septal", "posterior")
    assert motion.phase == pytest.approx([0, 17 / 81, 64 / 81, 1])
    assert motion.papillary_tips[..., 2] == pytest.approx(np.full((4, 3), -20.0))
    # It is pressed outwards, so that the side under pressure is the inner one.
    assert recording.pressure == pytest.approx(0.00133322)
    assert recording.pressure_share == pytest.approx(motion.phase)
    outward = surface.normals[:, :2] * surface.vertices[:, :2]
    assert outward.sum(axis=1).max() < 0
    assert np.all(surface.thickness == 0.65)
    assert np.abs(surface.fibre[:, 2]).max() < 1e-6
    # Trunk 5; branches from 5 mm inside and 15 - 9 = 6 mm below: sqrt(5^2 + 6^2) for the first.
    assert len(valve.chordae) == 6
    assert valve.chordae.rest_length.min() == pytest.approx(5 + np.sqrt(61), abs=1e-6)
    step = np.diff(np.unwrap(np.arctan2(*surface.vertices[valve.annulus, 1::-1].T)))
    assert np.abs(step) == pytest.approx(2 * np.pi / ROUND)


def test_tips_that_move_before_the_pressure(tmp_path):
    data = skirt(tips_mm=4.0)
    # Nothing but the tips moves until half of the time, when the pressure begins to rise.
    data["frames"][:, data["rim"]] = data["nodes"][data["rim"]]
    data["displacement"][:ROUND] = 0
    path = write(tmp_path, data)
    path.write_text(path.read_text().replace("0., 0., 1., 1.", "0.5, 0., 1., 1."))
    found = read(tmp_path)
    motion = found.valve.motion
    down = motion.papillary_tips[:, :, 2] + 20
    assert down[:, 0] == pytest.approx([0, -4 * 64 / 81, -4, -4])
    # A third of the way through the second half: u = 1/3 at t = 2/3.
    assert found.pressure_share == pytest.approx([0, 0, 17 / 81, 1])
    assert np.ptp(motion.annulus, axis=0).max() == 0


def test_an_ear_quad_is_cut_from_its_corner(tmp_path):
    # Take away one lower quad's neighbours so that a quad keeps two sides on the free edge.
    data = skirt()
    quads = data["quads"]["anterior"]
    last = quads.max(axis=1) >= ROUND * DOWN
    column = np.flatnonzero(last)[3]
    gone = quads[column]
    data["quads"]["anterior"] = np.delete(quads, column, axis=0)
    data["free_edge"] = np.union1d(data["free_edge"], gone)
    write(tmp_path, data)
    found = read(tmp_path).valve
    on_edge = np.isin(found.surface.triangles, found.free_edge).all(axis=1)
    assert not on_edge.any()
    assert len(found.free_edge) == ROUND + 2


def test_triangles_among_quads(tmp_path, recording):
    path = write(tmp_path, skirt())
    text = path.read_text()
    first = re.search(r"ELSET=septal_Quads\n(\d+),(\d+),(\d+),(\d+),(\d+)\n", text)
    label, a, b, c, d = first.groups()
    split = (
        f"ELSET=septal_Quads\n*Element, type=S3, elset=septal_Quads\n{label},{a},{b},{c}\n"
        f"9000,{a},{c},{d}\n*Element, type=S4R, elset=septal_Quads\n"
    )
    path.write_text(text.replace(first.group(), split))
    found, whole = read(tmp_path).valve.surface, recording.valve.surface
    assert found.areas.sum() == pytest.approx(whole.areas.sum())
    assert np.bincount(found.region).tolist() == [192, 192, 192]


def stiffness(leaflet, strain):
    area, pairs = OGDEN[leaflet]
    values = np.array([float(word) for word in pairs.split(",")])
    return truss_stiffness(area, values.reshape(-1, 2), strain)


def test_stiffness_of_the_chordae():
    # Small strains: P = 3 sum(mu) strain for an incompressible Ogden bar, whatever alpha.
    for leaflet, (area, pairs) in OGDEN.items():
        mu = [float(word) for word in pairs.split(",")][::2]
        assert stiffness(leaflet, 1e-6) == pytest.approx(3 * sum(mu) * area, rel=1e-3)
    # Those of the deck: 90, 27 and 8 N (their areas here are rounded).
    assert [stiffness(name, 0.01) for name in OGDEN] == pytest.approx([88.1, 27.0, 8.04], rel=5e-3)


def test_path_lengths_and_shares_of_a_fork():
    # Trunk of 2, branches of 1 and 3; both insertions pull equally, so the trunk carries two
    # forces: shares (2 + 1) / (2 * 2 + 1) and (2 + 3) / (2 * 2 + 3).
    nodes = np.array([[0.0, 0, 0], [0, 0, 2], [1, 0, 2], [0, 3, 2]])
    edges = np.array([[0, 1], [1, 2], [3, 1]])
    _, insertion, length, share = trace_cables(nodes, edges, np.array([0]), np.array([2, 3]))
    assert insertion.tolist() == [2, 3]
    assert length == pytest.approx([3, 5])
    assert share == pytest.approx([3 / 5, 5 / 7])


@pytest.mark.parametrize(
    ("edges", "anchors", "error", "message"),
    [
        ([[0, 1], [2, 3]], [0], GeometryError, "1 chord segments are connected to no anchor"),
        ([[0, 0]], [0], InputError, "chord segment 0 has no length"),
    ],
)
def test_bad_networks(edges, anchors, error, message):
    nodes = np.array([[0.0, 0, 0], [1, 0, 1], [2, 0, 0], [3, 0, 1]])
    with pytest.raises(error, match=message):
        trace_cables(nodes, np.array(edges), np.array(anchors), np.array([1]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rim": lambda x: x[:-1]}, "expected the two boundary loops"),
        ({"frames": lambda x: x[:1]}, "1 frames Skirt_NUMBER.vtu, expected 2 to 500"),
        ({"frames": lambda x: x + 1}, "Skirt_0.vtu: points are not the nodes of the deck"),
        ({"pressure": lambda x: 1e3 * x}, "pressure -1.33.*: stresses must be MPa"),
        ({"nodes": lambda x: 0.001 * x}, "the leaflets span 0.02.*: lengths must be mm"),
    ],
)
def test_contradictions(tmp_path, change, message):
    data = skirt()
    write(tmp_path, data | {name: of(data[name]) for name, of in change.items()})
    with pytest.raises(InputError, match=message):
        read(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("type=T3D2", "type=B31", r"line \d+, \*ELEMENT: type B31, expected S4R, S3, T3D2"),
        ("*Nset, nset=Rim\n1,", "*Ngen, nset=Rim\n1,", r"\*NGEN: is not read"),
        ("*Nset, nset=Rim", "*Nset, nset=Rand", "no node set 'Rim'; there are ALL"),
        (".65, 5\n", "", "shells without a section that states a thickness"),
        ("Valve.Both, SPOS", "Valve.Both, SNEG", "expected one pressure on all leaflets"),
        ("*End Step\n", "*End Step\n*Dynamic\n, 1.\n", "a second step, expected one"),
        ("*Hyperelastic, OGDEN", "*Hyperelastic, NEO HOOKE", "trusses of .*: expected .*OGDEN"),
    ],
)  # fmt: skip
def test_decks_that_are_refused(tmp_path, old, new, message):
    path = write(tmp_path, skirt())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        read(tmp_path)


REAL = ({name: f"{name}_Leaflet_Elements" for name in OGDEN}, "Annular_Nodes", "Free_Edge_Nodes")


@pytest.fixture(scope="module")
def real():
    place = Path(os.environ.get("MVEST_TRIVALVE") or ROOT.parent / "shared" / "data" / "trivalve")
    if not (place / "Healthy_QuasiStatic").is_dir():
        pytest.skip("needs the donor valve (conf/experiment); name its folder in MVEST_TRIVALVE")
    return read_recording(place / "Healthy_QuasiStatic", *REAL)


def test_the_real_valve(real):
    surface = real.valve.surface
    assert surface.areas.sum() == pytest.approx(1318, abs=1)
    # Normals leave the skirt: the ventricle is around it.
    middle = surface.vertices[real.valve.annulus].mean(axis=0)
    assert np.all(((surface.vertices - middle) * surface.normals)[:, :2].sum(axis=1) > 0)


def test_the_real_chordae(real):
    chordae, tips = real.valve.chordae, real.valve.papillary_tips
    insertions, first = np.unique(chordae.insertion, axis=0, return_index=True)
    rest = real.valve.surface.vertices
    vertex = np.array([np.flatnonzero((rest == point).all(axis=1))[0] for point in insertions])
    tip, length = chordae.tip[first], chordae.rest_length[first]
    stretch = np.linalg.norm(real.frames[:, vertex] - tips[tip], axis=2) / length
    assert stretch[0].max() < 1 + 1e-5
    # The trusses of the recording are stretched by 0.8 % at most; straight cables agree, and most
    # of them are drawn nearly straight in the closed valve.
    assert stretch.max() < 1.008
    assert np.mean(stretch[-1] > 0.98) > 0.6
