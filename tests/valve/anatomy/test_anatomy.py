"""Value objects: what is inadmissible is refused, once, by name and entry; what exists stays."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.valve import Chordae, lumped_areas, vertex_normals
from mvest.valve.mesh.solid_mesh import SolidMesh

VALVE = Template().valve(16, 5)
SURFACE, CHORDAE, MOTION = VALVE.surface, VALVE.chordae, VALVE.motion


def changed(array, entry, value):
    """A copy of ``array`` with one entry changed."""
    out = np.array(array)
    out[entry] = value
    return out


NAN = float("nan")

TABLE = [
    (SURFACE, {"thickness": changed(SURFACE.thickness, 7, 0.0)}, "thickness of vertex 7 is 0.0 mm"),
    (SURFACE, {"thickness": changed(SURFACE.thickness, 7, NAN)}, r"entry \(7,\) is not finite"),
    (SURFACE, {"thickness": np.ones(3)}, r"thickness: shape \(3,\), expected \(80,\)"),
    (SURFACE, {"triangles": changed(SURFACE.triangles, (3, 2), 80)}, r"is 80, expected 0 to 79"),
    (SURFACE, {"triangles": SURFACE.triangles + 0.5}, "triangles: float64, expected integers"),
    (SURFACE, {"region": changed(SURFACE.region, 9, -1)}, r"region: entry \(9,\) is -1"),
    (SURFACE, {"fibre": changed(SURFACE.fibre, 5, 0.0)}, "fibre of vertex 5 has no direction"),
    (CHORDAE, {"rest_length": changed(CHORDAE.rest_length, 2, -5.0)}, "length of chord 2 is -5.0"),
    (CHORDAE, {"family": changed(CHORDAE.family, 3, 3)}, r"chordae family: entry \(3,\) is 3"),
    (CHORDAE, {"toe_strain": NAN}, "toe strain nan, expected between 0 and 0.5"),
    (MOTION, {"phase": np.array([0.0, 0.0])}, "strictly increasing from 0 to 1"),
    (MOTION, {"phase": np.array([0.0, 0.5])}, "strictly increasing from 0 to 1"),
    (MOTION, {"annulus": MOTION.annulus[:1]}, r"motion annulus: shape \(1, 16, 3\), expected \(2,"),
    (VALVE, {"annulus": VALVE.annulus[:-1]}, "motion moves 16 annulus points, the valve has 15"),
    (VALVE, {"papillary_tips": VALVE.papillary_tips[:1]}, "chord 25 starts at papillary tip 1"),
    (
        VALVE,
        {"papillary_tips": np.vstack([VALVE.papillary_tips, np.zeros((1, 3))])},
        "motion moves 2 papillary tips, the valve has 3",
    ),
    (
        VALVE,
        {"chordae": replace(CHORDAE, insertion=changed(CHORDAE.insertion, (8, 2), -60.0))},
        r"chord 8 is disconnected: its insertion is \d+\.\d mm from the leaflets",
    ),
]


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
    ({"elements": ELEMENTS[:, :3]}, r"elements: shape \(2, 3\), expected \(None, 4\)"),
    ({"elements": ELEMENTS[:0], "region": np.zeros(0, int)}, "the mesh has no elements"),
    (
        # Element 0 has volume 1/6 and Jacobian determinant 1; turned, -1.
        {"elements": changed(ELEMENTS, 0, [1, 0, 2, 3])},
        r"1 inverted elements; the worst is element 0 with Jacobian determinant -1 mm\^3",
    ),
    ({"nodes": np.vstack([NODES, [[9, 9, 9]]]), "fibre": np.ones((6, 3))}, "node 5 belongs to no"),
    ({"fibre": np.ones((4, 3))}, r"mesh fibre: shape \(4, 3\)"),
    ({"fibre": changed(np.ones((2, 4, 3)), (1, 2), 0.0)}, "fibre at node 2 of element 1 has no"),
    ({"pressure_faces": np.array([[1, 2]])}, r"pressure_faces: shape \(1, 2\)"),
]


@pytest.mark.parametrize(("changes", "message"), MESHES)
def test_an_inadmissible_mesh_is_refused_by_name_and_entry(changes, message):
    with pytest.raises(InputError, match=message):
        tetrahedra(**changes)


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


def test_no_chordae_are_chordae_too():
    none = Chordae(np.zeros(0, int), np.zeros((0, 3)), np.zeros(0, int), (), np.zeros(0),
                   np.zeros(0), 0.02)  # fmt: skip
    assert len(none) == 0
    assert len(replace(VALVE, chordae=none).chordae) == 0


# Two ends on junction 1, which hangs on junction 0 with a third end; a fourth end is straight.
TREE = Chordae(
    np.zeros(6, int),
    np.array([[0.0, 0, 10], [2.0, 0, 10], [4.0, 0, 10], [6.0, 0, 10]]),
    np.zeros(6, int),
    ("marginal",),
    np.array([3.0, 3.5, 5.0, 12.0, 5.5, 2.0]),
    np.full(6, 10.0),
    0.02,
    np.array([[2.0, 0, 5], [1.0, 0, 7]]),
    np.array([1, 1, 0, -1, -1, 0]),
)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parent": np.array([1, 1, 0, -1, -1])}, r"parent: shape \(5,\), expected \(6,\)"),
        (
            {"parent": np.array([1, 1, 0, -1, -1, 2])},
            r"parent: entry \(5,\) is 2, expected -1 to 1",
        ),
        ({"parent": np.array([1, 1, 0, -1, 1, 0])}, "parent: segment 0 hangs on a cycle"),
        ({"parent": np.array([0, 0, 0, -1, -1, 0])}, "junction 1: no segment starts at it"),
        (
            {"tip": np.array([0, 1, 0, 0, 0, 0])},
            "segment 1 belongs to tip 1, .* junction 1 of tip 0",
        ),
        ({"junction": np.zeros((0, 3))}, r"chordae tip: shape \(6,\), expected \(4,\)"),
        ({"rest_length": np.array([3.0, 3, 5, 12, 0, 2])}, "rest_length of chord 4 is 0"),
    ],
)
def test_segments_that_form_no_trees_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        replace(TREE, **change)


def test_segments_know_their_ends_and_their_way_to_the_tip():
    tips = np.array([[1.0, 1.0, 1.0]])
    start, end = TREE.ends(tips).transpose(1, 0, 2)
    np.testing.assert_array_equal(end[:4], TREE.insertion)
    np.testing.assert_array_equal(end[4:], TREE.junction)
    low, high = TREE.junction
    np.testing.assert_array_equal(start, [high, high, low, tips[0], tips[0], low])
    # 3 + 2 + 5.5, 3.5 + 2 + 5.5, 5 + 5.5, 12.
    np.testing.assert_allclose(TREE.along(TREE.rest_length), [10.5, 11.0, 10.5, 12.0])
    alone = replace(TREE, insertion=TREE.insertion[3:], junction=np.zeros((0, 3)), **{
        name: getattr(TREE, name)[3:4]
        for name in ("tip", "family", "rest_length", "axial_stiffness", "parent")
    })  # fmt: skip
    np.testing.assert_array_equal(alone.along(alone.rest_length), [12.0])


def test_junctions_follow_tips_and_leaflets_in_proportion():
    # The trunk is 5.5 of 10.667 mm (the mean of 10.5, 11 and 10.5) to the ends beyond it.
    still, up = np.zeros((1, 3)), np.tile([0.0, 0.0, 1.0], (4, 1))
    share = 5.5 / np.mean([10.5, 11.0, 10.5])
    moved = TREE.moved(still, up)
    np.testing.assert_allclose(moved.junction[0], TREE.junction[0] + [0, 0, share])
    np.testing.assert_allclose(moved.junction[1], TREE.junction[1] + [0, 0, 7.5 / 10.75])
    np.testing.assert_array_equal(moved.insertion, TREE.insertion + up)
    both = TREE.moved(np.ones((1, 3)), np.ones((4, 3)))
    np.testing.assert_allclose(both.junction, TREE.junction + 1.0)
    # The straight end moves no junction.
    alone = TREE.moved(still, np.array([[0.0] * 3] * 3 + [[1.0] * 3]))
    np.testing.assert_array_equal(alone.junction, TREE.junction)
