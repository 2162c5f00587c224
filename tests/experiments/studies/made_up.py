"""A record that no run made, with any findings."""

from typing import Any, TypeVar

from experiments.common.records.record import SCHEMA, GitState, Model, Provenance, Record

F = TypeVar("F")


def made_up(findings: F, **header: Any) -> Record[F]:
    """A record with these findings, and what is given of its header."""
    source = Provenance(
        git=GitState("0" * 40, dirty=False),
        versions={"mvest": "0.1.0"},
        threads={},
        python="3",
        platform="any",
        machine="any",
        cpu_count=1,
        config_hash="1" * 64,
        mesh_hash="2" * 64,
        seed=1,
        finished="2020-01-01T00:00:00Z",
    )
    whole = {
        "schema": SCHEMA,
        "study": "made_up",
        "experiment": "made_up",
        "title": "t",
        "row": "r",
        "table": "made_up",
        "status": "converged",
        "reason": "completed",
        "detail": "",
        "parameters": (),
        "factors": {},
        "seconds_total": 1.0,
        "forward_solves": 1,
        "model": Model("hex18", (24, 3, 1)),
        "mesh": None,
        "provenance": source,
    }
    return Record(**{**whole, **header}, findings=findings)
