"""How well a case was seen: a deviation for each vertex, and joint errors of all frames."""

import dataclasses

import numpy as np
import pytest
import yaml

from mvest.cases.case import ErrorSamples, Role, Uncertainty
from mvest.cases.folder import read_case, write_case, write_error_samples
from mvest.errors import InputError
from tests.cases.folders import plain_folder, save, template_case

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


def test_what_a_case_says_of_its_errors_comes_back_as_it_was_written(tmp_path):
    case = corresponding()
    n = len(case.surface.vertices)
    std = np.random.default_rng(2).uniform(0.2, 1.0, n)
    told = dataclasses.replace(
        case, uncertainty=Uncertainty(std, 8.0), error_samples=samples(6, 3, n), chordae_follow=True
    )
    back = read_case(write_case(tmp_path / "case", told))
    np.testing.assert_array_equal(back.uncertainty.std_mm, std)
    assert back.uncertainty.correlation_length_mm == 8.0
    np.testing.assert_array_equal(back.error_samples.vertices, told.error_samples.vertices)
    np.testing.assert_array_equal(back.error_samples.tips, told.error_samples.tips)
    assert back.error_samples.source is None
    own = dataclasses.replace(told.error_samples, source=np.array([0, 1, 2, 0, 1, 2]))
    again = write_case(tmp_path / "again", dataclasses.replace(told, error_samples=own))
    np.testing.assert_array_equal(read_case(again).error_samples.source, own.source)
    with pytest.raises(InputError, match=r"source is float64 .* expected integers of shape \(6,\)"):
        dataclasses.replace(told.error_samples, source=np.zeros(6))
    assert back.chordae_follow
    # The samples are part of the case and of its hash.
    other = dataclasses.replace(told, error_samples=samples(6, 3, n, seed=7))
    assert read_case(write_case(tmp_path / "other", other)).sha256 != back.sha256
    # A case that says nothing of this is written as before.
    plain = read_case(write_case(tmp_path / "plain", case))
    assert (plain.error_samples, plain.chordae_follow) == (None, False)
    text = (tmp_path / "plain" / "case.yaml").read_text()
    assert "follow" not in text
    assert "error_samples" not in text


def test_chordae_that_are_laid_out_on_reading_follow_the_frames(tmp_path):
    document = plain_folder(tmp_path)
    assert not read_case(save(tmp_path, document)).chordae_follow
    del document["chordae"]
    assert read_case(save(tmp_path, document)).chordae_follow


def test_a_typical_deviation_is_the_root_mean_square():
    assert Uncertainty(np.array([0.3, 0.4, 1.2])).typical_mm == pytest.approx(np.sqrt(1.69 / 3))
    assert Uncertainty(0.7).typical_mm == 0.7


@pytest.mark.parametrize(
    ("std", "message"),
    [
        (np.array([0.5, 0.0, 0.5]), "std_mm = 0 at vertex 1"),
        (np.array([0.5, np.nan]), "std_mm = nan at vertex 1"),
        (np.ones((3, 2)), r"shape \(3, 2\)"),
    ],
)
def test_deviations_that_are_none_are_refused(std, message):
    with pytest.raises(InputError, match=message):
        Uncertainty(std)


def test_deviations_and_samples_must_be_of_the_case():
    case = corresponding()
    n = len(case.surface.vertices)
    change = dataclasses.replace
    with pytest.raises(InputError, match=f"std_mm of 3 vertices, expected {n}"):
        change(case, uncertainty=Uncertainty(np.ones(3)))
    with pytest.raises(InputError, match="vertices of 2 frames of 80 points, expected 3 of 80"):
        change(case, error_samples=samples())
    with pytest.raises(InputError, match="tips of 3 frames of 1 points, expected 3 of 2"):
        change(case, error_samples=samples(frames=3, tips=1))
    loose = change(
        case, frames=(case.frames[0], change(case.frames[1], corresponds=False), case.frames[2])
    )
    with pytest.raises(InputError, match="frame 'held' do not correspond"):
        change(loose, error_samples=samples(frames=3))
    closed = case.frame(Role.CLOSED)
    frames = tuple(change(f, corresponds=f is not closed) for f in case.frames)
    with pytest.raises(InputError, match="closed frame do not correspond; expected one number"):
        change(case, frames=frames, uncertainty=Uncertainty(np.ones(n)))


@pytest.mark.parametrize(
    ("vertices", "tips", "message"),
    [
        (
            np.zeros((5, 2, 80)),
            np.zeros((5, 2, 2, 3)),
            r"is float64 of shape \(5, 2, 80\)",
        ),
        (np.zeros((5, 2, 80, 3), dtype=int), np.zeros((5, 2, 2, 3)), "int64 of shape"),
        (np.full((5, 2, 80, 3), 25.0), np.zeros((5, 2, 2, 3)), "at most 20 mm"),
        (
            np.zeros((5, 2, 80, 3)),
            np.full((5, 2, 2, 3), np.nan),
            "tips has values that are",
        ),
        (np.zeros((5, 2, 80, 3)), np.zeros((4, 2, 2, 3)), "expected as many"),
        (np.zeros((3, 2, 80, 3)), np.zeros((3, 2, 2, 3)), "3 error samples, expected 4 to 500"),
    ],
)
def test_samples_that_are_none_are_refused(vertices, tips, message):
    with pytest.raises(InputError, match=message):
        ErrorSamples(vertices, tips)


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


def test_samples_are_read_from_their_file(tmp_path):
    case = read_case(folder_with(tmp_path))
    np.testing.assert_array_equal(case.error_samples.vertices, samples().vertices)


GOOD = {
    "frames": np.array(NAMES),
    "vertices": np.zeros((5, 2, 80, 3)),
    "tips": np.zeros((5, 2, 2, 3)),
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": np.array(["closed", "open"])}, r"frames \['closed', 'open'\], expected"),
        ({"frames": np.array([0, 1])}, "frames an array of int64"),
        ({"frames": np.array(NAMES, dtype=object)}, "plain arrays"),
        ({"more": np.zeros(1)}, "holds arrays more"),
        ({"vertices": np.zeros((5, 2, 81, 3))}, "vertices of 2 frames of 81 points"),
    ],
)
def test_a_file_of_other_samples_is_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        read_case(folder_with(tmp_path, **{**GOOD, **change}))


@pytest.mark.parametrize("content", [b"", b"not a file of arrays", b"PK\x03\x04 broken"])
def test_a_file_without_arrays_is_refused_with_the_field(tmp_path, content):
    folder = folder_with(tmp_path)
    (tmp_path / "errors.npz").write_bytes(content)
    with pytest.raises(
        InputError, match=r"case.yaml: observation.error_samples: errors.npz: cannot"
    ):
        read_case(folder)


def test_samples_lie_in_the_folder_under_their_extension(tmp_path):
    folder = folder_with(tmp_path)
    document = yaml.safe_load((folder / "case.yaml").read_text())
    for name, message in (("../errors.npz", "leads out"), ("open.vtp", "expected .npz")):
        document["observation"]["error_samples"] = name
        with pytest.raises(InputError, match=message):
            read_case(save(folder, document))
