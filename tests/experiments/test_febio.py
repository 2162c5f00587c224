"""The comparison with FEBio: what its page says of tables, and what is compared."""

import numpy as np
import pandas as pd

from experiments.febio import (
    BODIES,
    GAP_MM,
    LAWS,
    MODULI,
    REACH_MM,
    VALVES,
    block,
    contact_like_febio,
    markdown,
    valve_model,
    with_febios_element,
)
from mvest.mechanics.settings import ContactSettings

LAW_ROW = {"reading": "A", "pulled": "along", "stress_mpa": 0.6, "linear": 0.1, "here": 0.0913,
           "here_orthotropic": 0.0815, "orthotropic": 0.0815 + 2e-9,
           "neo_hookean": np.nan}  # fmt: skip
BODY_ROW = {"problem": "sheet", "element": "hex18", "reading": "C", "febio_element": "hex27",
            "here_mm": 1.25, "febio_mm": 1.5, "by_law_mm": 0.0625, "by_rest_mm": 5e-11,
            "here_s": 0.25, "febio_s": 2.5, "febio": "4.11.0", "reason": ""}  # fmt: skip
VALVE_ROW = {"contact": "sliding", "law": "neo-hookean", "here": "as it is",
             "here_converged": True, "febio_converged": False, "reason": "stopped after 9 s",
             "reached_s": 0.25, "through": True, "mean_mm": np.nan, "max_mm": np.nan,
             "here_iterations": 50, "here_s": 1.5, "febio_steps": 7, "febio_iterations": 60,
             "febio_s": 33.0, "febio": "4.11.0"}  # fmt: skip
MODULI_ROW = {"contact": "potential", "law": "neo-hookean", "here": "as it is", "converged": True,
              "reason": "converged", "anterior_mpa": 6.5, "posterior_mpa": 2.0,
              "anterior_percent": 4.3, "posterior_percent": -4.3, "residual_mm": 0.125,
              "seconds": 9.0}  # fmt: skip


def test_the_page_says_what_the_tables_hold_and_what_failed(tmp_path):
    for file, row in ((LAWS, LAW_ROW), (BODIES, BODY_ROW), (VALVES, VALVE_ROW),
                      (MODULI, MODULI_ROW)):  # fmt: skip
        pd.DataFrame([row]).to_csv(tmp_path / file, index=False)
    text = markdown(tmp_path)
    assert "| A | along | 10.00 | 9.13 | 8.15 | – |" in text
    assert "is the same to 2e-09" in text
    assert "| sheet | hex18 | hex27 | C | 1.250 | 1.500 | 0.062 | 5e-11 | 0.25 | 2.50 |" in text
    assert (
        "7; 60; 33; ended at 0.250 s: stopped after 9 s; leaflets pass through each other" in text
    )
    assert "| 6.50 | 4.3 | 2.00 | -4.3 | 0.125 |" in text


def test_the_page_leaves_out_what_was_not_computed(tmp_path):
    pd.DataFrame([MODULI_ROW]).to_csv(tmp_path / MODULI, index=False)
    assert "**Laws.**" not in markdown(tmp_path)


def test_contact_here_gets_febios_gaps():
    model = valve_model(120.0, ContactSettings())
    contact = contact_like_febio(model)
    thickness = model.contact_valve.surface.thickness.mean()
    assert np.isclose((contact.reference_distance - 1) * thickness, GAP_MM)
    assert np.isclose((contact.activation_distance - 1) * thickness, REACH_MM)


def test_febios_element_has_one_direction_of_the_fibre_in_each():
    model = with_febios_element(valve_model(20.0))
    assert model.mesh.element_type == "hex27"
    np.testing.assert_array_equal(model.mesh.fibre, np.broadcast_to(
        model.mesh.fibre[:, :1], model.mesh.fibre.shape))  # fmt: skip


def test_a_block_is_pressed_where_it_is_said():
    mesh = block("tet10", (1, 1, 1), (1.0, 1.0, 1.0), lambda x: np.any(x[:, :2] == 1, axis=1))
    x = mesh.nodes[mesh.pressure_faces]
    on = np.all(x[:, :, 0] == 1, axis=1) | np.all(x[:, :, 1] == 1, axis=1)
    assert len(x) == 4
    assert on.all()
