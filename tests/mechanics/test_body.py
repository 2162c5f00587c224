"""Mechanics from plain arrays: the examples in the documentation, and what bad input says."""

import doctest

import numpy as np
import pytest

import mvest.mechanics
import mvest.mechanics.body
from mvest.errors import GeometryError, InputError, MaterialError, MvestError
from mvest.mechanics import Parameter, TransverselyIsotropic, box, outer_faces, simulate_body
from mvest.mechanics.solver import linear_solver
from tests.mechanics.bodies import ELEMENT_NAMES, MATERIALS, SaintVenantKirchhoff

RUBBER = TransverselyIsotropic.isotropic(2.0, 0.45)


@pytest.mark.parametrize("module", [mvest.mechanics, mvest.mechanics.body])
def test_the_documented_examples_run_as_shown(module):
    outcome = doctest.testmod(module)
    assert outcome.attempted > 5
    assert outcome.failed == 0


def test_the_documented_example_has_ten_lines():
    parts = doctest.DocTestParser().get_examples(mvest.mechanics.__doc__)
    statements = [p for p in parts if not p.source.startswith(("import", "from"))]
    assert len(statements) <= 10


def arguments(element_type="hex18"):
    nodes, elements = box(element_type, (3, 3, 1), (9.0, 9.0, 1.0))
    faces = outer_faces(elements, element_type)
    return {
        "nodes": nodes,
        "elements": elements,
        "element_type": element_type,
        "material": RUBBER,
        "fixed_nodes": np.flatnonzero(np.any((nodes[:, :2] == 0) | (nodes[:, :2] == 9), axis=1)),
        "pressure_faces": faces[np.all(nodes[faces][:, :, 2] == 0, axis=1)],
        "pressure": 0.01,
        "times": [0.05, 0.1],
    }


@pytest.mark.parametrize("element_type", ELEMENT_NAMES)
@pytest.mark.parametrize("material", ["isotropic", "A"])
def test_every_element_inflates_a_sheet_with_every_material(element_type, material):
    given = arguments(element_type)
    fibre = None if material == "isotropic" else (1.0, 0.0, 0.0)
    result = simulate_body(**(given | {"material": MATERIALS[material], "fibre": fibre}))
    assert result.converged
    assert result.frames.shape == (3, len(given["nodes"]), 3)
    np.testing.assert_array_equal(result.frames[0], given["nodes"])
    np.testing.assert_array_equal(
        result.frames[-1][given["fixed_nodes"]], given["nodes"][given["fixed_nodes"]]
    )
    # Pressure from below lifts the sheet, further at the later time because it is damped.
    lift = result.frames[:, :, 2].max(axis=1) - 1.0
    assert 0 < lift[1] < lift[2]


def test_the_direction_of_the_fibre_does_not_matter_to_an_isotropic_material():
    given = arguments()
    free = simulate_body(**given).frames
    turned = simulate_body(**given, fibre=(0.6, 0.8, 0.0)).frames
    np.testing.assert_allclose(free, turned, atol=1e-8)


def test_two_materials_and_their_parameters():
    given = arguments()
    region = (np.arange(len(given["elements"])) < 4).astype(int)
    result = simulate_body(
        **(given | {"material": [RUBBER, TransverselyIsotropic.isotropic(4.0, 0.4)]}),
        region=region,
        parameters=[Parameter("E_f.0", 2.0), Parameter("E_f.1", 4.0)],
    )
    assert result.sensitivities.shape == (3, 2, len(given["nodes"]), 3)
    # Stiffer means less lifted, in either half.
    assert np.all(result.sensitivities[-1, :, :, 2].sum(axis=1) < 0)


def test_pressure_as_number_table_and_function_agree():
    given = arguments()
    number = simulate_body(**given).frames
    table = simulate_body(**(given | {"pressure": [(0.0, 0.01), (1.0, 0.01)]})).frames
    function = simulate_body(**(given | {"pressure": lambda t: 0.01})).frames
    np.testing.assert_array_equal(number, table)
    np.testing.assert_array_equal(number, function)


def test_forces_as_numbers_and_as_a_function_agree_and_are_borne_by_what_is_held():
    given = arguments() | {"pressure_faces": None, "static": True, "times": [1.0]}
    push = np.zeros_like(given["nodes"])
    push[np.all(np.abs(given["nodes"] - [4.5, 4.5, 1.0]) < 0.1, axis=1)] = (0.01, 0.02, 0.05)
    assert np.count_nonzero(push) == 3
    number = simulate_body(**given, forces=push).frames
    function = simulate_body(**given, forces=lambda t: t * push).frames
    np.testing.assert_allclose(number[-1], function[-1], atol=1e-9)
    assert number[-1, :, 2].max() > 1.1
    # Twice the force in two steps, the first of which is the one above.
    twice = simulate_body(**given | {"times": [1.0, 2.0]}, forces=lambda t: t * push).frames
    np.testing.assert_allclose(twice[1], number[-1], atol=1e-9)
    assert twice[2, :, 2].max() > number[-1, :, 2].max()


@pytest.mark.parametrize("static", [True, False])
def test_half_a_sheet_with_a_plane_of_symmetry_does_what_the_whole_does(static):
    # Pressed and pulled symmetrically; the plane x = 4.5 keeps its first coordinate only.
    nodes, elements = box("hex18", (4, 3, 1), (9.0, 9.0, 1.0))
    half, cells = box("hex18", (2, 3, 1), (4.5, 9.0, 1.0))
    results = []
    for x, e in ((nodes, elements), (half, cells)):
        faces = outer_faces(e, "hex18")
        pull = np.zeros_like(x)
        # A node on the plane has half of its force in each half.
        pull[(x[:, 0] == 4.5) & (x[:, 1] == 4.5), 2] = 0.04 if x is nodes else 0.02
        fixed = np.zeros(x.shape, dtype=bool)
        fixed[:, 0] = (x[:, 0] == 4.5) & (x is half)
        results.append(
            simulate_body(
                x,
                e,
                "hex18",
                material=RUBBER,
                fixed_nodes=np.flatnonzero(np.any((x[:, :2] == 0) | (x[:, :2] == 9), axis=1)),
                fixed_components=fixed,
                pressure_faces=faces[np.all(x[faces][:, :, 2] == 0, axis=1)],
                pressure=0.01,
                forces=pull,
                times=[0.05, 0.1],
                static=static,
                parameters=[Parameter("E_f.0", 2.0), Parameter("pressure_scale", 1.0)],
            )
        )
    whole, part = results
    assert whole.converged
    assert part.converged
    shared = [int(np.argmin(np.linalg.norm(nodes - x, axis=1))) for x in half]
    np.testing.assert_allclose(part.frames, whole.frames[:, shared], atol=1e-8)
    np.testing.assert_allclose(part.sensitivities, whole.sensitivities[:, :, shared], atol=1e-7)
    on_plane = half[:, 0] == 4.5
    np.testing.assert_array_equal(part.frames[:, on_plane, 0], 4.5)
    assert np.abs(part.sensitivities[-1]).max() > 1e-3


def saint_venant(young):
    return SaintVenantKirchhoff([TransverselyIsotropic.isotropic(young, 0.45)])


@pytest.mark.parametrize("static", [True, False])
def test_a_law_of_ones_own_takes_the_place_of_the_material(static):
    given = arguments() | {"fibre": (1.0, 0.0, 0.0), "static": static}
    known = simulate_body(**given)
    law = saint_venant(2.0)
    parameter = [Parameter("E_f.0", 2.0)]
    own = simulate_body(**given | {"material": law}, parameters=parameter)
    assert own.converged
    # Strains of some per cent: the two laws agree to their order, and are not the same.
    lift = known.frames[-1, :, 2].max() - 1.0
    difference = np.abs(own.frames[-1] - known.frames[-1]).max()
    assert 1e-5 * lift < difference < 0.05 * lift
    # Its derivative is that of its differences.
    moved = [
        simulate_body(**given | {"material": saint_venant(e)}).frames[-1] for e in (1.999, 2.001)
    ]
    np.testing.assert_allclose(own.sensitivities[-1, 0], (moved[1] - moved[0]) / 0.002, atol=2e-6)
    assert np.abs(own.sensitivities[-1]).max() > 1e-2


def test_the_result_says_what_has_solved():
    for solver in ("pardiso", "superlu"):
        if solver == "pardiso" and linear_solver().name != "pardiso":
            continue
        result = simulate_body(**arguments(), solver=solver)
        assert result.solver == solver
        assert f"solved by {solver}" in str(result)


def broken(name):
    """The good arguments with one thing wrong."""
    good = arguments()
    nodes, elements, faces = good["nodes"], good["elements"], good["pressure_faces"]
    nan_nodes, bad_elements = nodes.copy(), elements.copy()
    nan_nodes[3, 1] = np.nan
    bad_elements[1, 2] = len(nodes)
    fibre = TransverselyIsotropic(2.0, 1.0, 0.5, 0.3, 0.3)
    return {
        "nodes of a wrong shape": {"nodes": nodes[:, :2]},
        "nodes not finite": {"nodes": nan_nodes},
        "unknown element": {"element_type": "hex8"},
        "elements of a wrong width": {"elements": elements[:, :8]},
        "no elements": {"elements": elements[:0]},
        "element index out of range": {"elements": bad_elements},
        "element index not an integer": {"elements": elements + 0.5},
        "inverted element": {"nodes": nodes * [1, 1, -1]},
        "unused node": {"nodes": np.vstack([nodes, [[0, 0, 9.0]]])},
        "fixed node out of range": {"fixed_nodes": [0, len(nodes)]},
        "negative fixed node": {"fixed_nodes": [-1]},
        "fixed nodes not integers": {"fixed_nodes": [0.5]},
        "face index out of range": {"pressure_faces": faces + len(nodes)},
        "faces of a wrong width": {"pressure_faces": faces[:, :4]},
        "face of no element": {"pressure_faces": np.roll(faces, 2, axis=0) * 0 + np.arange(9) * 3},
        "face pointing inwards": {"pressure_faces": faces[:, [2, 1, 0, 5, 4, 3, 8, 7, 6]]},
        "time step 0": {"times": [0.1, 0.1]},
        "times of a wrong shape": {"times": [[0.1, 0.2]]},
        "pressure not finite": {"pressure": float("nan")},
        "pressure table of a wrong shape": {"pressure": [0.0, 0.1, 0.2]},
        "pressure table not increasing": {"pressure": [(0.1, 0.0), (0.0, 0.1)]},
        "fixed component of a wrong shape": {"fixed_components": np.zeros((3, 3), dtype=bool)},
        "fixed component not bool": {"fixed_components": np.zeros(nodes.shape)},
        "force of a wrong shape": {"forces": (0.0, 0.0, 1.0)},
        "force not finite": {"forces": lambda t: np.full(nodes.shape, np.inf)},
        "fibre of a law missing": {"material": saint_venant(2.0)},
        "fibre missing": {"material": fibre},
        "fibre zero": {"material": fibre, "fibre": (0, 0, 0)},
        "fibre across the layer": {"material": fibre, "fibre": (0, 0, 1)},
        "fibre of a wrong shape": {"material": fibre, "fibre": [(1, 0, 0), (0, 1, 0)]},
        "region missing": {"material": [RUBBER, RUBBER]},
        "region out of range": {"region": np.full(len(elements), 1)},
        "region of a wrong shape": {"region": [0]},
        "no material": {"material": []},
        "not a material": {"material": 2.0},
        "density": {"density": 0.0},
        "unknown solver": {"solver": "cholmod"},
        "unknown parameter": {"parameters": [Parameter("E_f.septal", 1.0)]},
    }[name]


MESSAGES = {
    "nodes of a wrong shape": (InputError, "nodes: shape"),
    "nodes not finite": (InputError, "nodes.*finite"),
    "unknown element": (InputError, "unknown element 'hex8'; known elements: tet4"),
    "elements of a wrong width": (InputError, r"elements: shape \(9, 8\), expected \(None, 18\)"),
    "no elements": (InputError, "the mesh has no elements"),
    "element index out of range": (InputError, "98|97"),
    "element index not an integer": (InputError, "integer"),
    "inverted element": (GeometryError, "inverted elements; the worst is element"),
    "unused node": (GeometryError, "belongs to no element"),
    "fixed node out of range": (InputError, r"fixed_nodes: entry .* expected 0 to"),
    "negative fixed node": (InputError, r"fixed_nodes: entry .* expected 0 to"),
    "fixed nodes not integers": (InputError, "fixed_nodes.*integers"),
    "face index out of range": (InputError, "pressure_faces"),
    "faces of a wrong width": (InputError, "pressure_faces"),
    "face of no element": (GeometryError, "is not a face of an element"),
    "face pointing inwards": (GeometryError, "points into the solid; reverse its node order"),
    "time step 0": (InputError, "time steps must increase strictly"),
    "times of a wrong shape": (InputError, r"times: shape \(1, 2\)"),
    "pressure not finite": (InputError, "pressure table .* is not finite"),
    "pressure table of a wrong shape": (InputError, r"pressure table .* shape \(3,\)"),
    "pressure table not increasing": (InputError, "increasing times"),
    "fixed component of a wrong shape": (InputError, r"fixed_components: shape \(3, 3\)"),
    "fixed component not bool": (InputError, "fixed_components.* of bool"),
    "force of a wrong shape": (InputError, r"forces: shape \(3,\), expected \(98, 3\)"),
    "force not finite": (InputError, r"forces at t = 0.05 s"),
    "fibre of a law missing": (InputError, "fibre is needed"),
    "fibre missing": (InputError, "fibre is needed"),
    "fibre zero": (InputError, "fibre has a length of zero"),
    "fibre across the layer": (InputError, "no direction within the leaflet"),
    "fibre of a wrong shape": (InputError, "fibre"),
    "region missing": (InputError, "2 materials need the region"),
    "region out of range": (InputError, "region"),
    "region of a wrong shape": (InputError, "region"),
    "no material": (MaterialError, "material must be"),
    "not a material": (MvestError, "material must be"),
    "density": (InputError, "density 0.0 t/mm"),
    "unknown solver": (InputError, "unknown linear solver 'cholmod'"),
    "unknown parameter": (InputError, "unknown region"),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_bad_input_gives_one_clear_error(name):
    kind, message = MESSAGES[name]
    with pytest.raises(kind, match=message):
        simulate_body(**(arguments() | broken(name)))


@pytest.mark.parametrize(("cells", "size"), [((0, 1, 1), (1, 1, 1)), ((1, 1, 1), (1, -1, 1))])
def test_a_box_needs_cells_and_a_size(cells, size):
    with pytest.raises(InputError, match="box of"):
        box("tet4", cells, size)
