"""Mechanics from plain arrays: the examples in the documentation, and what bad input says."""

import doctest

import numpy as np
import pytest

import mvest.mechanics
import mvest.mechanics.body
from mvest.errors import GeometryError, InputError, MaterialError
from mvest.mechanics import Parameter, TransverselyIsotropic, box, outer_faces, simulate_body
from tests.mechanics.bodies import SaintVenantKirchhoff

RUBBER = TransverselyIsotropic.isotropic(2.0, 0.45)


@pytest.mark.parametrize("module", [mvest.mechanics, mvest.mechanics.body])
def test_the_documented_examples_run_as_shown(module):
    outcome = doctest.testmod(module)
    assert outcome.attempted > 5
    assert outcome.failed == 0


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


GOOD = arguments()
NODES, ELEMENTS, FACES = GOOD["nodes"], GOOD["elements"], GOOD["pressure_faces"]
FIBROUS = TransverselyIsotropic(2.0, 1.0, 0.5, 0.3, 0.3)
BAD = [
    ({"nodes": NODES[:, :2]}, InputError, "nodes: shape"),
    ({"element_type": "hex8"}, InputError, "unknown element 'hex8'; known elements: tet4"),
    ({"elements": ELEMENTS[:, :8]}, InputError, r"elements: shape \(9, 8\), expected \(None, 18\)"),
    ({"nodes": NODES * [1, 1, -1]}, GeometryError, "inverted elements; the worst is element"),
    ({"fixed_nodes": [0, len(NODES)]}, InputError, r"fixed_nodes: entry .* expected 0 to"),
    (
        {"pressure_faces": FACES * 0 + np.arange(9) * 3},
        GeometryError,
        "is not a face of an element",
    ),
    (
        {"pressure_faces": FACES[:, [2, 1, 0, 5, 4, 3, 8, 7, 6]]},
        GeometryError,
        "points into the solid; reverse its node order",
    ),
    ({"times": [[0.1, 0.2]]}, InputError, r"times: shape \(1, 2\)"),
    ({"pressure": float("nan")}, InputError, "pressure table .* is not finite"),
    ({"pressure": [(0.1, 0.0), (0.0, 0.1)]}, InputError, "increasing times"),
    ({"fixed_components": np.zeros(NODES.shape)}, InputError, "fixed_components.* of bool"),
    ({"forces": lambda t: np.full(NODES.shape, np.inf)}, InputError, r"forces at t = 0.05 s"),
    ({"material": saint_venant(2.0)}, InputError, "fibre is needed"),
    ({"material": FIBROUS, "fibre": (0, 0, 0)}, InputError, "fibre has a length of zero"),
    ({"material": FIBROUS, "fibre": (0, 0, 1)}, InputError, "no direction within the leaflet"),
    ({"material": [RUBBER, RUBBER]}, InputError, "2 materials need the region"),
    ({"region": np.full(len(ELEMENTS), 1)}, InputError, "region"),
    ({"material": 2.0}, MaterialError, "material must be"),
    ({"density": 0.0}, InputError, "density 0.0 t/mm"),
    ({"solver": "cholmod"}, InputError, "unknown linear solver 'cholmod'"),
    ({"parameters": [Parameter("E_f.septal", 1.0)]}, InputError, "unknown region"),
]


@pytest.mark.parametrize(("changes", "kind", "message"), BAD)
def test_bad_input_gives_one_clear_error(changes, kind, message):
    with pytest.raises(kind, match=message):
        simulate_body(**(GOOD | changes))
