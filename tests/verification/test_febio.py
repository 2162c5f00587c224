"""The comparison with FEBio: what its stored tables prove, and that both get the same body."""

import numpy as np
import pandas as pd
import pytest

from tests.mechanics.bodies import SaintVenantKirchhoff
from tests.verification.febio import (
    RESULTS,
    block,
    here,
    largest,
)
from tests.verification.strip import MATERIALS


def stored(name):
    return pd.read_csv(RESULTS / f"febio_{name}.csv", keep_default_na=False, na_values=[""])


def test_where_element_and_law_are_the_same_so_are_the_bodies():
    rest = stored("bodies").groupby("element")["by_rest_mm"].max()
    assert rest["tet4"] < 1e-10
    assert rest["tet10"] < 1e-6
    laws = stored("laws")
    np.testing.assert_allclose(laws["here_orthotropic"], laws["orthotropic"], atol=1e-8)


def test_a_valve_without_contact_is_the_same_and_a_closed_one_is_not_yet():
    distance = stored("valves").set_index(["contact", "here"])
    assert distance.loc[("none", "as it is"), "max_mm"] < 0.05
    assert distance.loc[("none", "FEBio's law and element"), "max_mm"] < 0.02
    assert distance.loc[("potential", "as it is"), "max_mm"] > 7
    moduli = stored("moduli").set_index(["contact", "here"])
    percent = moduli.loc[("none", "as it is"), ["anterior_percent", "posterior_percent"]]
    assert percent.astype(float).abs().max() < 3
    assert moduli.loc[("potential", "as it is"), "anterior_percent"] < -40


def test_the_stored_body_comes_out_again_here():
    def held(x):
        return np.repeat(x[:, :1] == 0, 3, axis=1)

    mesh = block("tet10", (6, 4, 1), (13.0, 10.0, 1.26), lambda x: x[:, 2] == 0)
    row = stored("bodies").set_index(["problem", "element", "reading"]).loc[("strip", "tet10", "A")]
    law = here(mesh, held, 4.1e-3, SaintVenantKirchhoff([MATERIALS["A"]])).frames[-1]
    own = here(mesh, held, 4.1e-3, MATERIALS["A"]).frames[-1]
    assert largest(own - mesh.nodes) == pytest.approx(row.here_mm, rel=1e-5)
    assert largest(law - own) == pytest.approx(row.by_law_mm, rel=1e-5)
