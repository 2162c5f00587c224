"""Any experiment on the anatomy of a case folder."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.common.building.closure import (
    anatomy_of,
    build_mesh,
)
from experiments.common.building.gate import anatomy_digest
from experiments.common.config import hash_of, plain
from mvest.cases.folder import read_case, write_case
from mvest.errors import ConfigurationError, InputError
from mvest.scenarios.scenario import plane_of
from mvest.valve.measure.annulus import measure_annulus
from tests.cases.folders import template_case
from tests.experiments.configured import composed

SMALL = (
    "mesh.columns=16",
    "mesh.rows=2",
    "mechanics.contact_points.columns=40",
    "mechanics.contact_points.rows=10",
    "observation.columns=40",
    "observation.rows=10",
)


def values_of(folder, *overrides, experiment="closure"):
    return plain(
        composed(f"experiment={experiment}", "valve=folder", f"valve.folder={folder}", *overrides)
    )


@pytest.fixture(scope="module")
def case():
    seen = template_case(64, 17)
    return replace(seen, frames=seen.frames[:1], derived=())


@pytest.fixture(scope="module")
def folder(case, tmp_path_factory):
    return write_case(tmp_path_factory.mktemp("anatomy") / "case", case)


def test_axes_are_those_of_the_annulus_wherever_a_case_was_seen(case, folder, tmp_path):
    turn = Rotation.from_rotvec([0.4, 2.0, -1.0]).as_matrix()

    def moved(points):
        return points @ turn.T + [120.0, -40.0, 7.0]

    surface = replace(
        case.surface, vertices=moved(case.surface.vertices), fibre=case.surface.fibre @ turn.T
    )
    (frame,) = case.frames
    frame = replace(
        frame,
        vertices=surface.vertices,
        annulus=surface.vertices[case.annulus],
        free_edge=surface.vertices[case.free_edge],
        papillary_tips=moved(frame.papillary_tips),
    )
    chordae = replace(case.chordae, insertion=moved(case.chordae.insertion))
    elsewhere = replace(case, surface=surface, frames=(frame,), chordae=chordae)
    there = anatomy_of(values_of(write_case(tmp_path / "case", elsewhere))).given
    here = anatomy_of(values_of(folder)).given
    for a, b in (
        (there.surface.vertices, here.surface.vertices),
        (there.surface.fibre, here.surface.fibre),
        (there.papillary_tips, here.papillary_tips),
        (there.chordae.insertion, here.chordae.insertion),
        (there.motion.annulus, here.motion.annulus),
    ):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_the_annulus_narrows_as_stated_and_as_a_closed_frame_shows(folder, tmp_path):
    def diameters(valve):
        return [
            measure_annulus(ring, plane_of(valve, ring)).anteroposterior_diameter
            for ring in valve.motion.annulus
        ]

    stated = anatomy_of(values_of(folder, "valve.annulus_contraction=0.1")).given
    opened, closed = diameters(stated)
    assert closed == pytest.approx(0.9 * opened, rel=5e-3)
    both = write_case(tmp_path / "both", template_case(40, 12))
    seen = read_case(both).valve
    np.testing.assert_allclose(
        diameters(anatomy_of(values_of(both)).given), diameters(seen), rtol=1e-9
    )
    with pytest.raises(ConfigurationError, match="whose annulus is known; expected 0"):
        anatomy_of(values_of(both, "valve.annulus_contraction=0.1"))


def test_an_unstructured_mesh_is_made_of_the_surface_that_was_given(folder, tmp_path):
    mesh = {"source": "tetwild", "edge_length": 5.0}
    solid = build_mesh(anatomy_of(values_of(folder)), mesh, "tet10", tmp_path)
    assert solid.element_type == "tet10"
    again = build_mesh(anatomy_of(values_of(folder)), mesh, "tet10", tmp_path)
    assert again.sha256 == solid.sha256


def test_what_lies_in_the_folder_counts_and_not_its_name(folder, tmp_path):
    def both(place):
        asked = ("experiment=closure", "valve=folder", f"valve.folder={place}")
        return hash_of(composed(*asked)), anatomy_digest(plain(composed(*asked)))

    copy = shutil.copytree(folder, tmp_path / "copy")
    assert both(copy) == both(folder)
    text = (copy / "case.yaml").read_text()
    (copy / "case.yaml").write_text(text.replace("name: template", "name: other"))
    assert not set(both(copy)) & set(both(folder))
    # Without a folder nothing is as it was not before.
    assert "folder" not in str(plain(composed("experiment=closure"))["valve"]["annulus"])


@pytest.mark.parametrize(
    ("overrides", "error", "message"),
    [
        ((), ConfigurationError, "valve.folder is not given"),
        (("valve.folder=nowhere",), InputError, "no such folder"),
        (("valve.folder={}", "valve.annulus.saddle_height=3"), ConfigurationError, "one of them"),
        (("valve.folder={}", "valve.annulus_contraction=0.7"), ConfigurationError, r"\[0, 0.5\)"),
    ],
)
def test_what_is_wrong_is_one_line(folder, overrides, error, message):
    given = (each.format(folder) for each in overrides)
    values = plain(composed("experiment=closure", "valve=folder", *given))
    with pytest.raises(error, match=message) as raised:
        anatomy_of(values)
    assert "\n" not in str(raised.value)
