"""The donor reader on a small made-up recording of its form, and on the real one if present."""

import os

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.valve.anatomy.chord_network import trace_cables
from mvest.valve.io.donor.arrays import CITATION, DATA_VARIABLE, REGION_NAMES, donor_file
from mvest.valve.io.donor.recording import (
    OGDEN_CHORDAE,
    PRESSURE_MPA,
    chord_axial_stiffness,
    read_donor,
)
from mvest.valve.mesh.layered import layered_wedges
from mvest.valve.mesh.remesh import remesh
from tests.places import ROOT

ROUND, DOWN = 48, 6


def skirt():
    """A cylindrical skirt of 48 x 6 quads that hangs from a circle, with three chord trees.

    Four equal frames in time, so the smooth step passes 0, 17/81, 64/81 and 1.
    """
    angle = np.arange(ROUND) * 2 * np.pi / ROUND
    rings = [
        np.column_stack([10 * np.cos(angle), 10 * np.sin(angle), np.full(ROUND, -1.5 * k)])
        for k in range(DOWN + 1)
    ]
    leaflet = np.concatenate(rings)
    i, k = np.meshgrid(np.arange(ROUND), np.arange(DOWN), indexing="ij")
    a, b = (i + ROUND * k).ravel(), ((i + 1) % ROUND + ROUND * k).ravel()
    quads = np.column_stack([b, a, a + ROUND, b + ROUND])  # normals outwards, to the ventricle
    leaflet_of = np.searchsorted([16, 32], i.ravel(), side="right")
    n = len(leaflet)
    chord_nodes, edges, anchors = [], [], []
    for tree in range(3):
        first = n + len(chord_nodes)
        at = leaflet[n - ROUND + 16 * tree]
        # Anchor, a branching point straight above it, and two branches to the free edge.
        chord_nodes += [at * [0.5, 0.5, 0] - [0, 0, 20.0], at * [0.5, 0.5, 0] - [0, 0, 15.0]]
        edges += [[first, first + 1], [first + 1, n - ROUND + 16 * tree]]
        edges += [[first + 1, n - ROUND + 16 * tree + 1]]
        anchors.append(first)
    nodes = np.vstack([leaflet, chord_nodes])
    rim = np.arange(ROUND)
    constrained = np.concatenate([rim, anchors])
    displacement = np.zeros((len(constrained), 3))
    displacement[:ROUND] = -0.1 * leaflet[:ROUND]
    phase = np.array([0, 17 / 81, 64 / 81, 1])
    frames = np.repeat(nodes[None], 4, axis=0)
    frames[:, constrained] += phase[:, None, None] * displacement
    return {
        "nodes_ref_mm": nodes,
        **{f"quads_{name}": quads[leaflet_of == r] for r, name in enumerate(REGION_NAMES)},
        "chordae_edges": np.array(edges),
        "annulus_nodes": rim,
        "free_edge_nodes": np.arange(n - ROUND, n),
        "bc_nodes": constrained,
        "bc_displacement_mm": displacement,
        "chordae_anchor_nodes": np.array(anchors),
        "frames_xyz_mm": frames.astype(np.float32),
    }


def write(folder, arrays):
    np.savez(folder / "healthy.npz", **arrays)
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return read_donor(write(tmp_path_factory.mktemp("donor"), skirt()))


def test_reader(recording):
    assert len(recording.surface.triangles) == 2 * ROUND * DOWN
    assert np.bincount(recording.surface.region) == pytest.approx([192, 192, 192])
    assert recording.surface.region_names == ("anterior", "septal", "posterior")
    assert recording.phase == pytest.approx([0, 17 / 81, 64 / 81, 1])
    assert recording.papillary_tips[:, 2] == pytest.approx([-20, -20, -20])
    outward = recording.surface.normals[:, :2] * recording.surface.vertices[:, :2]
    assert outward.sum(axis=1).min() > 0
    assert np.abs(recording.surface.fibre[:, 2]).max() < 1e-6
    step = np.diff(np.unwrap(np.arctan2(*recording.surface.vertices[recording.annulus, 1::-1].T)))
    assert np.abs(step) == pytest.approx(2 * np.pi / ROUND)


def test_chordae_of_the_made_up_valve(recording):
    cables = recording.cables
    assert len(cables) == 6
    # Trunk 5; branches from 5 mm inside and 15 - 9 = 6 mm below: sqrt(5^2 + 6^2) for the first.
    assert np.sort(cables.length)[0] == pytest.approx(5 + np.sqrt(61), abs=1e-6)
    valve = recording.valve()
    straight = np.linalg.norm(
        valve.chordae.insertion - valve.papillary_tips[valve.chordae.tip], axis=1
    )
    assert np.all(valve.chordae.rest_length >= straight)


def test_motion_and_positions_agree(recording):
    coarse = remesh(recording.surface, recording.annulus, recording.free_edge, 90)
    valve = recording.valve(coarse)
    for frame in range(4):
        seen = recording.positions(coarse.triangle, coarse.weights, frame)
        assert valve.motion.annulus[frame] == pytest.approx(seen[coarse.annulus], abs=1e-5)
    triangle, weights = recording.locate(coarse.surface.vertices)
    assert recording.positions(triangle, weights, 0) == pytest.approx(
        coarse.surface.vertices, abs=1e-5
    )


def test_an_ear_quad_is_cut_from_its_corner(tmp_path):
    # Take away one lower quad's neighbours so that a quad keeps two sides on the free edge.
    arrays = skirt()
    quads = arrays["quads_anterior"]
    last = quads.max(axis=1) >= ROUND * DOWN
    column = np.flatnonzero(last)[3]
    gone = quads[column]
    arrays["quads_anterior"] = np.delete(quads, column, axis=0)
    edge = arrays["free_edge_nodes"]
    arrays["free_edge_nodes"] = np.concatenate([edge, np.setdiff1d(gone, edge)])
    found = read_donor(write(tmp_path, arrays))
    on_edge = np.isin(found.surface.triangles, found.free_edge).all(axis=1)
    assert not on_edge.any()
    assert len(found.free_edge) == ROUND + 2


def test_stiffness_of_the_chordae():
    # Small strains: P = 3 sum(mu) strain for an incompressible Ogden bar, whatever alpha.
    for leaflet, (area, pairs) in OGDEN_CHORDAE.items():
        expected = 3 * sum(mu for mu, _ in pairs) * area
        assert chord_axial_stiffness(leaflet, 1e-6) == pytest.approx(expected, rel=1e-3)
    stiffness = [chord_axial_stiffness(name, 0.01) for name in REGION_NAMES]
    assert stiffness == pytest.approx([89.7, 26.9, 8.04], rel=2e-3)


@pytest.mark.parametrize("strain", [0.0, -0.01, 0.5])
def test_stiffness_needs_a_sensible_strain(strain):
    with pytest.raises(InputError, match="linearisation strain"):
        chord_axial_stiffness("anterior", strain)


def test_path_lengths_and_shares_of_a_fork():
    # Trunk of 2, branches of 1 and 3; both insertions pull equally, so the trunk carries two
    # forces: shares (2 + 1) / (2 * 2 + 1) and (2 + 3) / (2 * 2 + 3).
    nodes = np.array([[0.0, 0, 0], [0, 0, 2], [1, 0, 2], [0, 3, 2]])
    cables = trace_cables(
        nodes, np.array([[0, 1], [1, 2], [3, 1]]), np.array([0]), np.array([2, 3])
    )
    assert cables.insertion.tolist() == [2, 3]
    assert cables.length == pytest.approx([3, 5])
    assert cables.stiffness_share == pytest.approx([3 / 5, 5 / 7])


def test_paths_end_at_the_leaflet():
    # Two anchors meet in one leaflet node: neither path goes on to the other's anchor or node.
    nodes = np.array([[0.0, 0, 0], [1, 0, 1], [2, 0, 0], [3, 0, 1]])
    edges = np.array([[0, 1], [2, 1], [2, 3]])
    cables = trace_cables(nodes, edges, np.array([0, 2]), np.array([1, 3]))
    pairs = list(zip(cables.anchor.tolist(), cables.insertion.tolist(), strict=True))
    assert pairs == [(0, 1), (2, 1), (2, 3)]


@pytest.mark.parametrize(
    ("edges", "anchors", "error", "message"),
    [
        ([[0, 1]], [0, 2], GeometryError, "anchor at node 2 reaches no leaflet"),
        ([[0, 1], [2, 3]], [0], GeometryError, "1 chord segments are connected to no anchor"),
        ([[0, 9]], [0], InputError, "edges refer to nodes outside 0 to 3"),
        ([[0, 0]], [0], InputError, "chord segment 0 has no length"),
    ],
)
def test_bad_networks(edges, anchors, error, message):
    nodes = np.array([[0.0, 0, 0], [1, 0, 1], [2, 0, 0], [3, 0, 1]])
    with pytest.raises(error, match=message):
        trace_cables(nodes, np.array(edges), np.array(anchors), np.array([1]))


def drop(name):
    return lambda arrays: arrays.pop(name)


def put(name, change):
    def apply(arrays):
        arrays[name] = change(arrays[name])

    return apply


def spoil_frame(x):
    x = x.copy()
    x[2, 0, 0] += 0.01
    return x


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop("chordae_edges"), "arrays chordae_edges are missing"),
        (put("nodes_ref_mm", lambda x: x[:, :2]), r"nodes_ref_mm is float64 of shape \(\d+, 2\)"),
        (put("quads_septal", lambda x: x + 0.5), "quads_septal is float64 .* expected integer"),
        (put("quads_septal", lambda x: x + 10**6), "quads_septal refers to nodes outside 0 to"),
        (put("nodes_ref_mm", lambda x: x * np.nan), "nodes_ref_mm has values that are not finite"),
        (put("annulus_nodes", lambda x: x[:0]), r"annulus_nodes is int64 of shape \(0,\)"),
        (put("annulus_nodes", lambda x: x[:-1]), "must be the two boundary loops"),
        (put("frames_xyz_mm", lambda x: x[:1]), "frames_xyz_mm has shape .* expected"),
        (put("frames_xyz_mm", lambda x: x + 1), "frame 0 of frames_xyz_mm differs"),
        (put("frames_xyz_mm", spoil_frame), "frame 2 of frames_xyz_mm is 0.01 mm away"),
        (put("bc_displacement_mm", lambda x: x[:-1]), r"\d+ rows of bc_displacement_mm"),
        (put("bc_displacement_mm", lambda x: x + 1), "moves a chord anchor"),
        (put("bc_nodes", lambda x: np.append(x[:-1], 100)), "annulus or anchors is not in bc"),
        (put("quads_anterior", lambda x: x[x.min(axis=1) > 0]), "loops|without gaps"),
    ],
)
def test_malformed_files(tmp_path, change, message):
    arrays = skirt()
    change(arrays)
    with pytest.raises(InputError, match=message):
        read_donor(write(tmp_path, arrays))


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 broken"])
def test_unreadable_files(tmp_path, content):
    (tmp_path / "healthy.npz").write_bytes(content)
    with pytest.raises(InputError, match="of plain arrays"):
        read_donor(tmp_path)


def test_pickled_objects_are_not_loaded(tmp_path):
    arrays = skirt()
    arrays["annulus_nodes"] = np.array([{"a": 1}], dtype=object)
    np.savez(tmp_path / "healthy.npz", allow_pickle=True, **arrays)
    with pytest.raises(InputError, match="of plain arrays"):
        read_donor(tmp_path)


def test_absent_data_say_where_to_get_them(tmp_path, monkeypatch):
    monkeypatch.delenv(DATA_VARIABLE, raising=False)
    for call in (lambda: read_donor(), lambda: read_donor(tmp_path / "nowhere")):
        with pytest.raises(InputError) as caught:
            call()
        for part in (CITATION, DATA_VARIABLE, "healthy.npz", "CC BY 4.0", "10.1007/s00366-022"):
            assert part in str(caught.value)


def test_the_environment_names_the_data(tmp_path, monkeypatch):
    write(tmp_path, skirt())
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path))
    assert donor_file() == tmp_path / "healthy.npz"
    assert donor_file(tmp_path / "healthy.npz") == tmp_path / "healthy.npz"


@pytest.fixture(scope="module")
def real():
    beside = ROOT.parent / "shared" / "data" / "trivalve"
    try:
        return read_donor(os.environ.get(DATA_VARIABLE) or beside)
    except InputError as error:
        if "there is no file" not in str(error):
            raise
        pytest.skip(f"needs the donor valve: {CITATION}; name its folder in {DATA_VARIABLE}")


def test_the_real_valve(real):
    surface = real.surface
    assert surface.vertices.shape == (8587, 3)
    assert len(surface.triangles) == 2 * 8283
    assert (len(real.annulus), len(real.free_edge), len(real.frames)) == (244, 364, 21)
    assert pytest.approx(0.00306) == PRESSURE_MPA
    assert surface.areas.sum() == pytest.approx(1318, abs=1)
    # Normals leave the skirt: the ventricle is around it.
    middle = surface.vertices[real.annulus].mean(axis=0)
    assert np.all(((surface.vertices - middle) * surface.normals)[:, :2].sum(axis=1) > 0)
    # Along the annulus at the annulus.
    along = np.roll(surface.vertices[real.annulus], -1, 0) - surface.vertices[real.annulus]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    fibre = surface.fibre[real.annulus]
    assert np.median(np.abs(np.einsum("ij,ij->i", along, fibre))) > 0.99


def test_the_real_chordae(real):
    cables = real.cables
    assert len(real.papillary_tips) == 6
    assert len(cables) == 1552
    assert len(np.unique(cables.insertion)) == 1344
    tips = real.papillary_tips[cables.anchor]
    stretch = np.linalg.norm(real.frames[:, cables.insertion] - tips, axis=2) / cables.length
    assert stretch[0].max() < 1 + 1e-5
    # The trusses of the recording are stretched by 0.8 % at most; straight cables agree, and most
    # of them are drawn nearly straight in the closed valve.
    assert stretch.max() < 1.008
    assert np.mean(stretch[-1] > 0.98) > 0.6


def test_the_real_mesh(real):
    coarse = remesh(real.surface, real.annulus, real.free_edge, 520)
    mesh = layered_wedges(coarse.surface, onto=real.surface)
    assert 3000 <= len(mesh.solid.nodes) <= 5000
    assert mesh.straightened < 30
    valve = real.valve(coarse)
    seen = real.positions(coarse.triangle, coarse.weights, -1)[coarse.annulus]
    assert valve.motion.annulus[-1] == pytest.approx(seen, abs=1e-4)
