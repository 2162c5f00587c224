"""Words about predictions that a wrong count would spoil."""

from experiments.studies.prediction.report import coverage


def row(low, high, truth):
    inside = low <= truth <= high
    return {
        "low": low, "high": high, "truth_own_mesh": truth, "inside_own_mesh": inside,
        "wide_low": low - 0.5, "wide_high": high + 0.5,
        "inside_wide": low - 0.5 <= truth <= high + 0.5,
    }  # fmt: skip


def test_an_interval_without_width_counts_only_where_it_misses():
    found = {
        "observed": {"measures": {"gap_mm2": row(8.0, 12.0, 9.0), "other": row(0.0, 1.0, 5.0)}},
        "ring": {"measures": {"gap_mm2": row(0.0, 0.0, 0.0)}},
        "clip": {"measures": {"gap_mm2": row(0.0, 0.0, 1.5)}},
        "both": {"measures": {"gap_mm2": {**row(1.0, 2.0, 3.0), "inside_own_mesh": None}}},
    }
    record = {"patients": [{"seed": 1, "scenarios": found}]}
    # Inside: observed. Missed: clip. Neither: the ring, where there is nothing to be wrong about,
    # and both, whose truth is not known.
    assert coverage(record, "gap_mm2", "own") == (1, 2)
    # With the mesh's error the ring's interval has a width, and both, 3.0 in 0.5 to 2.5, misses.
    assert coverage(record, "gap_mm2", "wide") == (2, 4)
