"""What the study notes say of the published sweeps, against the published tables."""

import pandas as pd
import pytest

from tests.places import ROOT


def table(name: str) -> pd.DataFrame:
    """The table by setting, without the paper's rows."""
    found = pd.read_csv(ROOT / "results" / f"sweep_{name}_table.csv", comment="#")
    return found[found["runs"].notna()]


def test_of_132_starts_130_and_125_lead_to_the_truth():
    found = table("initial_guess").drop_duplicates("filter").set_index("filter")
    assert found["runs"].to_dict() == {"iterated": 130, "paper": 125}
    assert found["failed"].to_dict() == {"iterated": 2, "paper": 7}
    assert table("initial_guess")["largest error [%]"].max() < 0.02
    assert found["forward solves, max"].to_dict() == {"iterated": 6, "paper": 9}


def test_independent_noise_is_harmless_and_correlated_noise_is_not():
    found = table("noise")
    assert (found["runs"].sum() / 2, found["failed"].sum()) == (2101, 0)
    white = found[(found["kind"] == "white") & (found["noise [mm]"] > 0)]
    iterated = white[white["filter"] == "iterated"]
    assert iterated["RMSE / bound"].between(0.9, 1.1).all()
    assert iterated["coverage [%]"].between(91, 94).all()
    assert white[white["filter"] == "paper"]["coverage [%]"].min() == pytest.approx(84, abs=0.5)
    alike = found[found["kind"].str.startswith("correlated")]
    untold = alike[alike["R correlation [mm]"] == 0]
    assert list(untold["RMSE [%]"].round()) == [25, 14]
    assert list(untold["coverage [%]"].round()) == [12, 14]
    off = found[found["kind"].str.contains("annulus")]
    assert list(off["RMSE [%]"].round()) == [50, 45]
    assert (off["coverage [%]"] == 0).all()


def test_a_tight_prior_holds_the_iterated_filter_back():
    found = table("covariance")
    per_setting = found.drop_duplicates("setting")["failed"]
    assert (per_setting.sum(), (per_setting > 0).sum()) == (123, 14)
    iterated = found[(found["filter"] == "iterated") & (found["R [mm²]"] == 1.0)]
    worst = iterated.groupby("P0 [filter coordinates²]")["RMSE [%]"].max()
    assert [round(worst[p0], 1) for p0 in (1e-4, 1.0, 9.0)] == [42.3, 1.7, 1.9]


def test_the_length_of_the_chordae_matters_most():
    runs = pd.read_csv(ROOT / "results" / "sweep_discrepancy.csv", comment="#")
    largest = runs.groupby("truth")["signed error [%]"].agg(lambda error: error.abs().max())
    assert list(largest.sort_values().index[-2:]) == [f"chord rest length {s}5 %" for s in "+-"]
    assert round(largest.max()) == 158
    found = table("discrepancy")
    held = found[(found["truth"] != "same model") & (found["coverage [%]"] == 100)]
    assert (len(held), len(found) - 2) == (4, 24)


def test_the_iterated_filter_takes_the_fewest_forward_solves():
    found = table("filter")
    noisy = found[found["noise [mm]"] == 0.5].groupby("filter")["forward solves"]
    assert noisy.max()["iterated"] < noisy.min()["paper"]
    assert found["failed"].sum() == 0
