"""The benchmark's report: calibrated ratios, the baseline and the fitted orders."""

import json

import numpy as np
import pandas as pd
import pytest

from tests.benchmark.report import benchmark_table, fitted_orders, main


def entry(name, seconds, calibration=0.5, **about):
    return {
        "name": name,
        "stats": {"median": seconds, "rounds": 3},
        "extra_info": {"threads": 1, "calibration": calibration} | about,
    }


def report(scale=1.0, calibration=0.5):
    """Closures whose time grows like nodes^1.5, and an update of the filter."""
    sizes = {"3k": 3000, "7k": 7000, "25k": 25000}
    closures = [
        entry(
            f"test_closure[hex18-{size}-2]",
            scale * 1e-4 * n**1.5,
            calibration,
            element="hex18",
            size=size,
            nodes=n,
            parameters=2,
        )
        for size, n in sizes.items()
    ]
    update = entry("test_update[2-3248]", scale * 0.01, calibration, points=3248, parameters=2)
    return {"benchmarks": [*closures, update]}


def test_times_are_compared_over_the_calibration():
    # A machine that is twice as slow at everything has neither won nor lost.
    baseline = benchmark_table([report()], None)
    slower = benchmark_table([report(scale=2.0, calibration=1.0)], baseline)
    np.testing.assert_allclose(slower["of baseline"], 1.0)
    worse = benchmark_table([report(scale=3.0)], baseline)
    np.testing.assert_allclose(worse["of baseline"], 3.0)
    assert list(worse["what"]) == ["closure"] * 3 + ["update"]


def test_the_baseline_survives_its_file(tmp_path):
    table = benchmark_table([report()], None)
    table.to_csv(tmp_path / "baseline.csv", index=False)
    again = benchmark_table([report(scale=2.0)], pd.read_csv(tmp_path / "baseline.csv"))
    np.testing.assert_allclose(again["of baseline"], 2.0)


def test_orders_are_fitted_over_the_sizes():
    orders = fitted_orders(benchmark_table([report()], None))
    assert orders["what"].tolist() == ["closure"]
    assert orders["order"][0] == pytest.approx(1.5)


def test_the_report_is_written_with_the_peers(tmp_path):
    run, peers, profile, startup = (
        tmp_path / f"{name}.json" for name in ("run", "peers", "profile", "startup")
    )
    startup.write_text(json.dumps({"startup": [{"start": "mvest list", "seconds": 0.07}]}))
    run.write_text(json.dumps(report()))
    rows = [{"library": "other", "nodes": 3362, "seconds_per_iteration": 0.1}]
    peers.write_text(json.dumps({"rows": rows}))
    bound = {"what": "factorisation", "bound by": "GFlop/s", "reached": 12.0, "machine": 50.0}
    parts = {"solves": 1.0, "factorisation": 3.0}
    counts = {"iterations on the finest mesh": 5, "factorisations": 6, "evaluations": 7}
    entry = {"closure": "continued", "nodes": 9, "seconds": 4.0, **counts, "parts": parts}
    profile.write_text(json.dumps({"profile": [entry | {"bounds": [bound]}]}))
    main([str(run), str(peers), str(profile), str(startup)], tmp_path)
    text = (tmp_path / "benchmark.md").read_text()
    assert "closure" in text
    assert "| mvest list | 0.07 |" in text
    assert "| other | 3362 | 0.1 |" in text
    assert "## Where the time of a continued closure goes: 9 nodes" in text
    assert "5 Newton iterations on the finest mesh, 6 factorisations and 7 evaluations." in text
    # The largest part first, with its share.
    assert "| factorisation | 3 | 75 |\n| solves | 1 | 25 |" in text
    assert "| factorisation | 12 | 50 | GFlop/s |" in text
    assert (tmp_path / "benchmark.csv").is_file()
    assert (tmp_path / "benchmark.png").stat().st_size > 10_000
