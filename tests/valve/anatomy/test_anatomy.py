"""Value objects: what is inadmissible is refused, once, by name and entry; what exists stays."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from mvest.errors import GeometryError, InputError
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Chordae, Motion, lumped_areas, vertex_normals
from mvest.valve.mesh.solid_mesh import SolidMesh

VALVE = Template().valve(16, 5)
SURFACE, CHORDAE, MOTION = VALVE.surface, VALVE.chordae, VALVE.motion


def changed(array, entry, value):
    """A copy of ``array`` with one entry changed."""
    out = np.array(array)
    out[entry] = value
    return out


NAN, INF = float("nan"), float("inf")

SURFACES = [
    ({"thickness": changed(SURFACE.thickness, 7, 0.0)}, "thickness of vertex 7 is 0.0 mm"),
    ({"thickness": changed(SURFACE.thickness, 7, -1.3)}, r"vertex 7 is -1.3 mm, expected > 0"),
    ({"thickness": changed(SURFACE.thickness, 7, NAN)}, r"thickness: entry \(7,\) is not finite"),
    ({"thickness": np.ones(3)}, r"thickness: shape \(3,\), expected \(80,\)"),
    ({"thickness": 1.3}, r"thickness: shape"),
    ({"vertices": changed(SURFACE.vertices, (4, 1), INF)}, r"vertices: entry \(4, 1\) is not fin"),
    ({"vertices": SURFACE.vertices[:, :2]}, r"vertices: shape \(80, 2\), expected \(None, 3\)"),
    ({"triangles": changed(SURFACE.triangles, (3, 2), 80)}, r"\(3, 2\) is 80, expected 0 to 79"),
    ({"triangles": changed(SURFACE.triangles, (3, 2), -1)}, r"triangles: entry \(3, 2\) is -1"),
    ({"triangles": SURFACE.triangles[:, :2]}, r"triangles: shape \(128, 2\)"),
    ({"triangles": SURFACE.triangles + 0.5}, "triangles: float64, expected integers"),
    ({"region": changed(SURFACE.region, 9, 2)}, r"region: entry \(9,\) is 2, expected 0 to 1"),
    ({"region": changed(SURFACE.region, 9, -1)}, r"region: entry \(9,\) is -1"),
    ({"region": SURFACE.region[:-1]}, r"region: shape \(127,\), expected \(128,\)"),
    ({"fibre": changed(SURFACE.fibre, 5, 0.0)}, "fibre of vertex 5 has no direction"),
    ({"fibre": changed(SURFACE.fibre, (5, 0), NAN)}, r"fibre: entry \(5, 0\) is not finite"),
    ({"fibre": SURFACE.fibre[:-1]}, r"fibre: shape \(79, 3\), expected \(80, 3\)"),
]

CHORDS = [
    ({"rest_length": changed(CHORDAE.rest_length, 2, 0.0)}, "rest_length of chord 2 is 0.0"),
    ({"rest_length": changed(CHORDAE.rest_length, 2, -5.0)}, "rest_length of chord 2 is -5.0"),
    ({"rest_length": changed(CHORDAE.rest_length, 2, NAN)}, r"rest_length: entry \(2,\) is not"),
    ({"rest_length": CHORDAE.rest_length[1:]}, r"chordae rest_length: shape \(33,\)"),
    ({"axial_stiffness": changed(CHORDAE.axial_stiffness, 1, 0)}, "axial_stiffness of chord 1"),
    ({"insertion": changed(CHORDAE.insertion, (0, 2), NAN)}, r"insertion: entry \(0, 2\)"),
    ({"tip": changed(CHORDAE.tip, 3, -1)}, r"chordae tip: entry \(3,\) is -1"),
    ({"family": changed(CHORDAE.family, 3, 2)}, r"chordae family: entry \(3,\) is 2"),
    ({"toe_strain": 0.0}, "toe strain 0.0, expected between 0 and 0.5"),
    ({"toe_strain": 0.5}, "toe strain 0.5"),
    ({"toe_strain": NAN}, "toe strain nan"),
]

MOTIONS = [
    ({"phase": np.array([0.0, 0.0])}, "strictly increasing from 0 to 1"),
    ({"phase": np.array([1.0, 0.0])}, "strictly increasing from 0 to 1"),
    ({"phase": np.array([0.0, 0.5])}, "strictly increasing from 0 to 1"),
    ({"phase": np.array([0.0])}, "strictly increasing from 0 to 1"),
    ({"phase": np.array([0.0, NAN])}, r"motion phase: entry \(1,\) is not finite"),
    ({"annulus": MOTION.annulus[:1]}, r"motion annulus: shape \(1, 16, 3\), expected \(2, None"),
    ({"annulus": changed(MOTION.annulus, (1, 2, 0), NAN)}, r"annulus: entry \(1, 2, 0\)"),
    ({"papillary_tips": MOTION.papillary_tips[0]}, r"motion papillary_tips: shape \(2, 3\)"),
]

VALVES = [
    ({"annulus": changed(VALVE.annulus, 1, 80)}, r"annulus: entry \(1,\) is 80"),
    ({"free_edge": changed(VALVE.free_edge, 1, -1)}, r"free_edge: entry \(1,\) is -1"),
    ({"annulus": VALVE.annulus[:-1]}, "motion moves 16 annulus points, the valve has 15"),
    ({"papillary_tips": VALVE.papillary_tips[:1]}, "chord 17 starts at papillary tip 1, but ther"),
    (
        {"papillary_tips": np.vstack([VALVE.papillary_tips, np.zeros((1, 3))])},
        "motion moves 2 papillary tips, the valve has 3",
    ),
    ({"papillary_tips": changed(VALVE.papillary_tips, (0, 0), NAN)}, r"tips: entry \(0, 0\)"),
    (
        # 3.2 mm outwards and more from any vertex.
        {"chordae": replace(CHORDAE, insertion=changed(CHORDAE.insertion, (8, 2), -60.0))},
        r"chord 8 is disconnected: its insertion is \d+\.\d mm from the leaflets",
    ),
]

TABLE = (
    [(SURFACE, *case) for case in SURFACES]
    + [(CHORDAE, *case) for case in CHORDS]
    + [(MOTION, *case) for case in MOTIONS]
    + [(VALVE, *case) for case in VALVES]
)


@pytest.mark.parametrize(("good", "changes", "message"), TABLE)
def test_what_is_inadmissible_is_refused_by_name_and_entry(good, changes, message):
    with pytest.raises(InputError, match=message):
        replace(good, **changes)


def tetrahedra(**changes):
    """Two tetrahedra on one face, with changes."""
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
    given = {
        "nodes": nodes,
        "elements": np.array([[0, 1, 2, 3], [1, 2, 3, 4]]),
        "element_type": "tet4",
        "region": np.array([0, 1]),
        "region_names": ("anterior", "posterior"),
        "fibre": np.tile([1.0, 0.0, 0.0], (5, 1)),
        "pressure_faces": np.array([[1, 2, 4]]),
    }
    return SolidMesh(**{**given, **changes})


NODES, ELEMENTS = tetrahedra().nodes, tetrahedra().elements

MESHES = [
    ({"nodes": changed(NODES, (2, 0), NAN)}, r"mesh nodes: entry \(2, 0\) is not finite"),
    ({"nodes": NODES[:, :2]}, r"mesh nodes: shape \(5, 2\)"),
    ({"elements": changed(ELEMENTS, (1, 3), 5)}, r"elements: entry \(1, 3\) is 5, expected 0 to 4"),
    ({"elements": ELEMENTS[:, :3]}, r"elements: shape \(2, 3\), expected \(None, 4\)"),
    ({"elements": ELEMENTS[:0], "region": np.zeros(0, int)}, "the mesh has no elements"),
    ({"elements": ELEMENTS[:, [1, 0, 2, 3]]}, r"2 inverted elements; the worst is element 1 "),
    (
        # Element 0 has volume 1/6 and Jacobian determinant 1; turned, -1.
        {"elements": changed(ELEMENTS, 0, [1, 0, 2, 3])},
        r"1 inverted elements; the worst is element 0 with Jacobian determinant -1 mm\^3",
    ),
    ({"nodes": changed(NODES, 3, [0.2, 0.2, 0.0])}, r"inverted elements; the worst is element 0"),
    ({"nodes": np.vstack([NODES, [[9, 9, 9]]]), "fibre": np.ones((6, 3))}, "node 5 belongs to no"),
    ({"element_type": "hex99"}, "unknown element 'hex99'"),
    ({"region": np.array([0, 2])}, r"element region: entry \(1,\) is 2, expected 0 to 1"),
    ({"region": np.array([0])}, r"element region: shape \(1,\), expected \(2,\)"),
    ({"fibre": np.ones((4, 3))}, r"mesh fibre: shape \(4, 3\)"),
    ({"fibre": changed(np.ones((2, 4, 3)), (1, 2), NAN)}, r"mesh fibre: entry \(1, 2, 0\)"),
    (
        {"fibre": changed(np.ones((2, 4, 3)), (1, 2), 0.0)},
        "fibre at node 2 of element 1 has no direction",
    ),
    ({"pressure_faces": np.array([[1, 2, 5]])}, r"pressure_faces: entry \(0, 2\) is 5"),
    ({"pressure_faces": np.array([[1, 2]])}, r"pressure_faces: shape \(1, 2\)"),
]


@pytest.mark.parametrize(("changes", "message"), MESHES)
def test_an_inadmissible_mesh_is_refused_by_name_and_entry(changes, message):
    with pytest.raises(InputError, match=message):
        tetrahedra(**changes)


def test_what_concerns_the_shape_of_things_is_a_geometry_error():
    with pytest.raises(GeometryError):
        tetrahedra(elements=ELEMENTS[:, [1, 0, 2, 3]])
    with pytest.raises(GeometryError):
        replace(SURFACE, thickness=-SURFACE.thickness)


def test_fibres_per_node_and_per_element_are_the_same_mesh():
    per_element = np.tile([1.0, 0.0, 0.0], (2, 4, 1))
    assert tetrahedra().fibre.shape == (2, 4, 3)
    assert tetrahedra(fibre=per_element).sha256 == tetrahedra().sha256


@pytest.mark.parametrize("value", [SURFACE, CHORDAE, MOTION, VALVE, tetrahedra()])
def test_value_objects_cannot_be_changed(value):
    for name in value.__slots__:
        with pytest.raises(FrozenInstanceError):
            setattr(value, name, None)
        array = getattr(value, name)
        if isinstance(array, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                array.flat[0] = 0


def test_value_objects_keep_nothing_of_the_callers_arrays():
    # Neither does the object change with the caller's array, nor is that array locked.
    base = np.array(NODES)
    mesh = tetrahedra(nodes=base[:])
    base[0] = -5.0
    assert mesh.nodes[0].tolist() == [0, 0, 0]
    thickness = np.array(SURFACE.thickness)
    surface = replace(SURFACE, thickness=thickness)
    thickness[0] = 9.0
    assert surface.thickness[0] == SURFACE.thickness[0]


def test_normals_and_areas_of_a_square_by_hand():
    # The unit square in two triangles: the diagonal's vertices touch both, a third of 1/2 each.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    np.testing.assert_allclose(vertex_normals(vertices, triangles), np.tile([0, 0, 1.0], (4, 1)))
    np.testing.assert_allclose(lumped_areas(vertices, triangles), [1 / 3, 1 / 6, 1 / 3, 1 / 6])


def test_a_vertex_between_leaflets_belongs_to_the_first():
    # Columns 0 and 8 of 16 are the commissures.
    region = SURFACE.vertex_region.reshape(5, 16)
    assert np.all(region[:, :9] == 0)
    assert np.all(region[:, 9:] == 1)


def test_fibres_are_made_unit_vectors():
    surface = replace(SURFACE, fibre=3.0 * SURFACE.fibre)
    np.testing.assert_allclose(surface.fibre, SURFACE.fibre, atol=1e-15)


def test_no_chordae_are_chordae_too():
    none = Chordae(np.zeros(0, int), np.zeros((0, 3)), np.zeros(0, int), (), np.zeros(0),
                   np.zeros(0), 0.02)  # fmt: skip
    assert len(none) == 0
    assert len(replace(VALVE, chordae=none).chordae) == 0
    assert len(CHORDAE) == 34


def test_motion_may_have_more_frames():
    motion = Motion(
        np.array([0.0, 0.3, 1.0]),
        np.repeat(MOTION.annulus[:1], 3, axis=0),
        np.repeat(MOTION.papillary_tips[:1], 3, axis=0),
    )
    assert replace(VALVE, motion=motion).motion.phase[1] == 0.3
