"""How well a case was seen: a deviation for each vertex, and joint errors of all frames."""

import dataclasses

import numpy as np
import pytest

from mvest.cases.case import ErrorSamples, Role, Uncertainty
from mvest.cases.folder import read_case, write_case, write_error_samples
from mvest.errors import InputError
from tests.cases.folders import plain_folder, save, template_case
from tests.cases.test_folder import assert_equal

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


ERRORS, TIPS = np.zeros((5, 2, 80, 3)), np.zeros((5, 2, 2, 3))
GOOD = {"frames": np.array(NAMES), "vertices": ERRORS, "tips": TIPS}


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
        ({"frames": np.array([0, 1])}, "frames an array of int64"),
        ({"frames": np.array(NAMES, dtype=object)}, "plain arrays"),
        ({"more": np.zeros(1)}, "holds arrays more"),
        ({"vertices": np.zeros((5, 2, 81, 3))}, "vertices of 2 frames of 81 points"),
        ({"vertices": ERRORS[..., 0]}, r"is float64 of shape \(5, 2, 80\)"),
        ({"vertices": ERRORS + 25.0}, "at most 20 mm"),
        ({"tips": TIPS * np.nan}, "tips has values that are"),
        ({"tips": TIPS[:4]}, "expected as many"),
        ({"vertices": ERRORS[:3], "tips": TIPS[:3]}, "3 error samples, expected 4 to 500"),
    ],
)
def test_a_file_of_other_samples_is_refused(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        read_case(folder_with(tmp_path, **{**GOOD, **change}))
