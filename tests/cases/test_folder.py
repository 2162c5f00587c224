"""A case comes back as it was written; its units, derived values and errors of the vertices."""

import dataclasses

import numpy as np
import pytest

from mvest.cases.case import ErrorSamples, Role, Uncertainty
from mvest.cases.folder import (
    read_case,
    write_case,
    write_error_samples,
)
from mvest.errors import InputError
from mvest.valve.anatomy.template import Template
from mvest.valve.geometry.triangles import unit_rows
from tests.cases.folders import TIPS, plain_folder, save, save_surface, template_case, tree_case


def assert_equal(back, expected, *leave_out):
    """All fields of two dataclasses are equal, arrays to the last bit."""
    for entry in dataclasses.fields(expected):
        if entry.name in leave_out:
            continue
        a, b = getattr(back, entry.name), getattr(expected, entry.name)
        if entry.name == "fibre":  # divided by its length again on reading: two roundings
            np.testing.assert_allclose(a, b, rtol=0, atol=2 * np.finfo(float).eps)
        elif entry.name == "frames":
            assert len(a) == len(b)
            for one, other in zip(a, b, strict=True):
                assert_equal(one, other)
        elif dataclasses.is_dataclass(b):
            assert_equal(a, b)
        elif isinstance(b, np.ndarray):
            np.testing.assert_array_equal(a, b, err_msg=entry.name)
            assert a.dtype == b.dtype
        else:
            assert a == b, entry.name


@pytest.mark.parametrize(
    "case", [template_case(branches=1), tree_case()], ids=["straight", "trees"]
)
def test_a_case_comes_back_as_it_was_written(tmp_path, case):
    back = read_case(write_case(tmp_path / "case", case))
    assert_equal(back, case, "sha256")
    assert [path.name for path in tmp_path.iterdir()] == ["case"]
    again = read_case(write_case(tmp_path / "again", back))
    assert_equal(again, back, "sha256")  # the last digit of a fibre may differ
    assert len(back.sha256) == 64
    assert back.valve.motion.annulus.shape == (2, 40, 3)
    header = (tmp_path / "case" / "chordae.csv").read_text().splitlines()[0]
    assert header.endswith("stiffness_n,start,end") is bool(len(case.chordae.junction))


def test_rows_of_branching_chordae_may_have_any_order_and_names(tmp_path):
    case = tree_case()
    folder = write_case(tmp_path / "case", case)
    file = folder / "chordae.csv"
    head, *rows = file.read_text().splitlines()
    names = {f"b{k}": f"fan {k}" for k in range(len(case.chordae.junction))}
    turned = [",".join(names.get(cell, cell) for cell in row.split(",")) for row in rows[::-1]]
    file.write_text("\n".join([head, *turned]))
    back, c = read_case(folder).chordae, len(case.chordae.insertion)
    order = np.r_[np.arange(c)[::-1], c + np.arange(len(names))[::-1]]
    np.testing.assert_array_equal(back.rest_length, case.chordae.rest_length[order])
    tips = case.frames[0].papillary_tips
    np.testing.assert_array_equal(back.ends(tips), case.chordae.ends(tips)[order])


def test_nothing_is_left_of_a_case_that_cannot_be_written(tmp_path):
    case = template_case(16, 5)
    wrong = dataclasses.replace(case.frames[2], vertices=case.frames[2].vertices * np.nan)
    with pytest.raises(InputError, match="not finite"):
        write_case(tmp_path / "a", dataclasses.replace(case, frames=(*case.frames[:2], wrong)))
    with pytest.raises(InputError, match="its folder must exist"):
        write_case(tmp_path / "no" / "a", case)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not an empty folder"):
        write_case(tmp_path / "full", case)
    assert (tmp_path / "full" / "notes.txt").read_text() == "mine"


def test_the_hash_changes_with_every_file_that_is_used_and_no_other(tmp_path):
    folder = write_case(tmp_path / "case", template_case(16, 5))
    first = read_case(folder).sha256
    (folder / "notes.txt").write_text("not used")
    assert read_case(folder).sha256 == first
    for file in sorted(set(folder.iterdir()) - {folder / "notes.txt"}):
        content = file.read_bytes()
        file.write_bytes(content.rstrip() + b"\n\n")
        assert read_case(folder).sha256 != first, file.name
        file.write_bytes(content)
    assert read_case(folder).sha256 == first


# --- units and what is derived ------------------------------------------------------------------


def test_units_are_converted_on_reading(tmp_path):
    length, factor = "m", 1000.0
    document = plain_folder(tmp_path)
    expected = read_case(save(tmp_path, document))
    surface = expected.surface
    small = tmp_path / "small"
    other = plain_folder(small)
    for entry, frame in zip(other["frames"], expected.frames, strict=True):
        save_surface(
            small / entry["surface"], frame.vertices / factor, frame.triangles, frame.region
        )
        entry["papillary_tips"] = (np.array(TIPS) / factor).tolist()
        entry["time"] *= 1000.0
        entry["pressure"] *= 0.133322387415  # kPa per mmHg
    table = (small / "chordae.csv").read_text().splitlines()
    scaled = [table[0]]
    for line in table[1:]:
        tip, x, y, z, *rest = line.split(",")
        scaled.append(",".join([tip, *(repr(float(v) / factor) for v in (x, y, z)), *rest]))
    (small / "chordae.csv").write_text("\n".join(scaled))
    other["units"] = {"length": length, "pressure": "kPa", "time": "ms"}
    case = read_case(save(small, other))
    np.testing.assert_allclose(case.surface.vertices, surface.vertices, atol=1e-12)
    np.testing.assert_allclose(case.chordae.insertion, expected.chordae.insertion, atol=1e-12)
    np.testing.assert_array_equal(case.chordae.rest_length, expected.chordae.rest_length)
    for ours, theirs in zip(case.frames, expected.frames, strict=True):
        for name in ("papillary_tips", "time", "pressure_mmHg"):
            np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-12)


def test_everything_derived_is_said_and_nothing_else(tmp_path):
    document = plain_folder(tmp_path)
    del document["chordae"]
    case = read_case(save(tmp_path, document))
    fields = [sentence.split(":")[0] for sentence in case.derived]
    assert fields == [
        "annulus and free edge", "thickness", "fibre", "chordae", "observation"
    ]  # fmt: skip
    document["observation"] = {"std_mm": 0.5, "correlation_length_mm": 0}
    document["thickness"] = {"anterior": 1.5, "posterior": 1.0}
    document["frames"][0]["annulus"] = list(range(24))
    document["frames"][0]["free_edge"] = list(range(24 * 7, 24 * 8))
    case = read_case(save(tmp_path, document))
    assert [sentence.split(":")[0] for sentence in case.derived] == ["fibre", "chordae"]
    assert set(case.surface.thickness.tolist()) == {1.5, 1.0}
    np.testing.assert_array_equal(case.annulus, np.arange(24))
    assert (case.uncertainty.std_mm, case.uncertainty.correlation_length_mm) == (0.5, 0.0)


def test_fibres_and_thickness_are_those_of_the_template_unless_given(tmp_path):
    case = read_case(save(tmp_path, plain_folder(tmp_path, 40, 12)))
    known = Template().valve(40, 12).surface
    cosine = np.abs(np.einsum("ij,ij->i", case.surface.fibre, known.fibre))
    assert np.median(cosine) > 0.98
    # Half-way between parallel and perpendicular: 45 degrees are between those of the template and
    # those turned the other way round. The angle phi is a few degrees off there, over which fibres
    # turn by twice as many.
    grid = known.vertices.reshape(12, 40, 3)
    tangent = unit_rows((np.roll(grid, -1, axis=1) - np.roll(grid, 1, axis=1)).reshape(-1, 3))
    turned = np.abs(np.abs(np.einsum("ij,ij->i", known.fibre, tangent)) - 0.7) < 0.2
    assert turned.sum() > 20
    assert cosine[turned].mean() > np.cos(np.pi / 4)
    # A third of the range from annulus to edge, and between the leaflets.
    np.testing.assert_allclose(case.surface.thickness, known.thickness, atol=0.1)


NAMES = ["open", "closed"]


def corresponding(columns=16, rows=5):
    case = template_case(columns, rows)
    frames = tuple(dataclasses.replace(frame, corresponds=True) for frame in case.frames)
    return dataclasses.replace(case, frames=frames)


def samples(count=5, frames=2, n=80, tips=2, seed=1):
    rng = np.random.default_rng(seed)
    return ErrorSamples(
        0.5 * rng.standard_normal((count, frames, n, 3)),
        rng.standard_normal((count, frames, tips, 3)),
    )


def test_what_a_case_states_of_its_errors_comes_back_as_it_was_written(tmp_path):
    case, change = corresponding(), dataclasses.replace
    n = len(case.surface.vertices)
    std = np.random.default_rng(2).uniform(0.2, 1.0, n)
    own = change(samples(6, 3, n), source=np.array([0, 1, 2, 0, 1, 2]))
    known = change(case, uncertainty=Uncertainty(std, 8.0), error_samples=own, chordae_follow=True)
    back = read_case(write_case(tmp_path / "case", known))
    assert_equal(back.uncertainty, known.uncertainty)
    assert_equal(back.error_samples, own)
    assert back.chordae_follow
    # A case that states nothing of this is written without it.
    plain = read_case(write_case(tmp_path / "plain", case))
    assert (plain.error_samples, plain.chordae_follow) == (None, False)
    with pytest.raises(InputError, match=r"source is float64 .* expected integers of shape \(6,\)"):
        change(own, source=np.zeros(6))


def test_deviations_that_are_not_positive_are_refused():
    assert Uncertainty(np.array([0.3, 0.4, 1.2])).typical_mm == pytest.approx(np.sqrt(1.69 / 3))
    with pytest.raises(InputError, match="std_mm = 0 at vertex 1"):
        Uncertainty(np.array([0.5, 0.0, 0.5]))
    with pytest.raises(InputError, match=r"shape \(3, 2\)"):
        Uncertainty(np.ones((3, 2)))


def test_deviations_and_samples_must_be_of_the_case():
    case, change = corresponding(), dataclasses.replace
    n = len(case.surface.vertices)

    def without(role):
        """The case with a frame that does not correspond."""
        frames = (change(f, corresponds=f.role is not role) for f in case.frames)
        return change(case, frames=tuple(frames))

    for wrong, change_of_it, message in (
        (case, {"uncertainty": Uncertainty(np.ones(3))}, f"std_mm of 3 vertices, expected {n}"),
        (case, {"error_samples": samples()}, "vertices of 2 frames of 80 points, expected 3 of 80"),
        (case, {"error_samples": samples(5, 3, 80, 1)}, "tips of 3 frames of 1 points, expected 3"),
        (without(Role.HELD_OUT), {"error_samples": samples(5, 3)}, "'held' do not correspond"),
        (without(Role.CLOSED), {"uncertainty": Uncertainty(np.ones(n))}, "expected one number"),
    ):
        with pytest.raises(InputError, match=message):
            change(wrong, **change_of_it)


MOVES, TIP_MOVES = np.zeros((5, 2, 80, 3)), np.zeros((5, 2, 2, 3))
GOOD = {"frames": np.array(NAMES), "vertices": MOVES, "tips": TIP_MOVES}


def folder_with(tmp_path, **arrays):
    document = plain_folder(tmp_path, 16, 5)
    document["observation"] = {
        "std_mm": 0.5, "correlation_length_mm": 8.0, "error_samples": "errors.npz"
    }  # fmt: skip
    if arrays:
        np.savez(tmp_path / "errors.npz", **arrays)
    else:
        write_error_samples(tmp_path / "errors.npz", samples(), NAMES)
    return save(tmp_path, document)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": np.array(["closed", "open"])}, r"frames \['closed', 'open'\], expected"),
        ({"frames": np.array(NAMES, dtype=object)}, "plain arrays"),
        ({"vertices": MOVES + 25.0}, "at most 20 mm"),
        ({"tips": TIP_MOVES * np.nan}, "tips has values that are"),
        ({"vertices": MOVES[:3], "tips": TIP_MOVES[:3]}, "3 error samples, expected 4 to 500"),
    ],
)
def test_a_file_of_other_samples_is_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        read_case(folder_with(tmp_path, **{**GOOD, **change}))


# --- several segments of a leaflet --------------------------------------------------------------


def scallops(case):
    """Label of each triangle: 0 anterior; 1, 2 and 3 in three parts of the posterior leaflet."""
    surface = case.surface
    middle = surface.vertices[surface.triangles].mean(axis=1)
    angle = np.degrees(np.arctan2(middle[:, 0], -middle[:, 1]))
    return np.where(surface.region == 0, 0, 2 + (angle > 30.0) - (angle < -30.0))


def test_segments_of_a_leaflet_are_one_region(tmp_path):
    document = plain_folder(tmp_path)
    whole = read_case(save(tmp_path, document))
    label = scallops(whole)
    assert set(label.tolist()) == {0, 1, 2, 3}
    for entry, frame in zip(document["frames"], whole.frames, strict=True):
        save_surface(tmp_path / entry["surface"], frame.vertices, frame.triangles, label)
        for number in range(4):
            file = tmp_path / f"{entry['name']}{number}.vtp"
            save_surface(file, frame.vertices, frame.triangles[label == number], None)
    document["regions"] = {0: "anterior", **dict.fromkeys((1, 2, 3), "posterior")}
    labelled = read_case(save(tmp_path, document))
    assert_equal(labelled, whole, "sha256")
    for entry in document["frames"]:
        files = [f"{entry['name']}{number}.vtp" for number in range(4)]
        entry["surface"] = {"anterior": files[0], "posterior": files[1:]}
    document["regions"] = ["anterior", "posterior"]
    joined = read_case(save(tmp_path, document))
    assert joined.surface.region_names == ("anterior", "posterior")
    assert len(joined.surface.vertices) == len(whole.surface.vertices)
    assert joined.closed.corresponds
    # The same triangles of the same regions; merging numbers them anew.
    for one in (0, 1):
        corners = [
            np.sort(s.vertices[s.triangles[s.region == one]].mean(axis=1), axis=0)
            for s in (joined.surface, whole.surface)
        ]
        np.testing.assert_allclose(*corners, atol=1e-12)
    # Each may be a region of its own.
    regions = ["anterior", "P1", "P2", "P3"]
    for entry in document["frames"]:
        entry["surface"] = f"{entry['name']}.vtp"
    document |= {"regions": regions, "thickness": 1.3}
    own = read_case(save(tmp_path, document))
    np.testing.assert_array_equal(own.surface.region, label)
