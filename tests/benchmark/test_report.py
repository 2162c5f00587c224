"""The benchmark's report: calibrated ratios, the baseline and the fitted orders."""

import json

import numpy as np
import pandas as pd
import pytest

from tests.benchmark.report import benchmark_table, fitted_orders, main


def report(scale=1.0, calibration=0.5):
    """Closures whose time grows like nodes^1.5, and an update of the filter."""
    closures = [
        (scale * 1e-4 * n**1.5, {"what": "closure", "element": "hex18", "size": size, "nodes": n})
        for size, n in (("3k", 3000), ("7k", 7000), ("25k", 25000))
    ]
    update = (scale * 0.01, {"what": "update", "points": 3248})
    about = {"threads": 1, "parameters": 2, "calibration": calibration}
    return {
        "benchmarks": [
            {"stats": {"median": seconds, "rounds": 3}, "extra_info": own | about}
            for seconds, own in (*closures, update)
        ]
    }


def test_the_report_is_written_over_the_stored_baseline_with_fitted_orders_and_peers(tmp_path):
    table = benchmark_table([report()])
    # A machine that is twice as slow at everything has neither won nor lost.
    slower = benchmark_table([report(scale=2.0, calibration=1.0)], table)
    np.testing.assert_allclose(slower["of baseline"], 1.0)
    table.to_csv(tmp_path / "benchmark_baseline.csv", index=False)
    assert fitted_orders(table)["order"].tolist() == [pytest.approx(1.5)]
    run, peers = tmp_path / "run.json", tmp_path / "peers.json"
    run.write_text(json.dumps(report(scale=2.0)))
    rows = [{"library": "other", "nodes": 3362, "seconds_per_iteration": 0.1}]
    peers.write_text(json.dumps({"rows": rows}))
    main([str(run), str(peers)], tmp_path)
    text = (tmp_path / "benchmark.md").read_text()
    assert "| other | 3362 | 0.1 |" in text
    assert "| closure | hex18 | 1.5 |" in text
    again = pd.read_csv(tmp_path / "benchmark.csv")
    np.testing.assert_allclose(again["of baseline"], 2.0)
    assert (tmp_path / "benchmark.png").stat().st_size > 10_000
