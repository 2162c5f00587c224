"""The configured anatomies are valves, and have what their names say."""

import numpy as np
import pytest

from experiments.common.building.closure import template_of
from experiments.common.config import plain
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.structured import structured_mesh
from tests.experiments.configured import composed
from tests.places import ANATOMIES

NORMAL = [name for name in ANATOMIES if name.startswith("normal")]


def anatomy(name: str) -> Template:
    return template_of(plain(composed(f"valve={name}")))


def diameters(template: Template) -> tuple[float, float]:
    """Antero-posterior and commissural diameter of the open annulus, mm."""
    x, y, _ = template.annulus(np.arange(0.0, 360.0)).T
    return float(np.ptp(y)), float(np.ptp(x))


@pytest.mark.parametrize("name", ANATOMIES)
def test_every_anatomy_is_a_valve_that_can_be_meshed(name: str) -> None:
    template = anatomy(name)
    valve = template.valve()
    structured_mesh(template, "hex18", 40, 5)  # refuses elements that are inside out
    # No way from a tip to a leaflet is taut in the open valve, which is the state without stress.
    chordae = valve.chordae
    span = np.linalg.norm(np.diff(chordae.ends(valve.papillary_tips), axis=1)[:, 0], axis=1)
    assert np.all(chordae.along(chordae.rest_length) > chordae.along(span))


@pytest.mark.parametrize("name", NORMAL)
def test_normal_valves_have_normal_annuli_and_anterior_leaflets(name: str) -> None:
    template = anatomy(name)
    ap, commissural = diameters(template)
    assert 24 - 3 <= ap <= 30.8 + 4.4
    assert 35 - 5 <= commissural <= 35.1 + 4.9
    # The published length belongs to a valve of mean size, whose annulus is 35 mm wide.
    assert 20 <= template.parameters.leaflets.anterior.length * 35 / commissural <= 25
    assert 13 <= template.parameters.papillary.tip[0] <= 19


def test_functional_regurgitation_is_a_wide_annulus_and_displaced_tips() -> None:
    template = anatomy("functional_mr")
    ap, commissural = diameters(template)
    assert 33 - 6 <= ap <= 36 + 5
    assert 41 - 5 <= commissural <= 43 + 5
    # Dilated most from front to back.
    normal = diameters(anatomy("template"))
    assert ap / normal[0] > commissural / normal[1] > 1.1
    outward, _, up = template.parameters.papillary.displacement
    assert outward > 0
    assert up < 0
    assert 5 <= np.linalg.norm(template.parameters.papillary.displacement) <= 10


def test_fibroelastic_deficiency_is_thin_and_lacks_one_chord() -> None:
    template, normal = anatomy("fibroelastic"), anatomy("template")
    here, there = template.valve().surface.thickness, normal.valve().surface.thickness
    assert 0.75 <= here.min() / there.min() <= 0.8
    assert 0.75 <= here.max() / there.max() <= 0.8
    ends = [len(one.chordae().insertion) for one in (template, normal)]
    assert np.diff(ends) == 1
