"""Records that no run made."""

from typing import Any

from experiments.common.records.record import VERSION, GitState, Model, Provenance, Record
from mvest.problem.record import EstimateRecord, Spread, Unknown

SOURCE = Provenance(
    git=GitState(sha="0123456789abcdef" * 2 + "01234567", dirty=True),
    versions={"mvest": "0.1.0"},
    threads={},
    python="3",
    platform="any",
    machine="any",
    cpu_count=1,
    config_hash="cd" * 32,
    mesh_hash="2" * 64,
    seed=1,
    finished="2020-01-01T00:00:00Z",
)


def made_up(**header: Any) -> Record:
    """A record with what is given of it."""
    whole = {
        "version": VERSION,
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
        "model": Model(element="hex18", cells=(24, 3, 1)),
        "mesh": None,
        "provenance": SOURCE,
    }
    return Record(**{**whole, **header})


NAMES = ("E_f.anterior", "E_f.posterior")


def made_up_estimate(
    values: tuple[float, ...] | None = (6.2296, 2.0901), seed: int = 1, **changes: Any
) -> EstimateRecord:
    """An estimate of two moduli whose truth is 6.23 and 2.09 MPa; None: a failed one."""
    unknowns = tuple(
        Unknown(
            name=name,
            unit="MPa",
            prior_mean=start,
            estimate=values and values[k],
            std=values and std,
            low=values and values[k] - 2 * std,
            high=values and values[k] + 2 * std,
            bound=values and std,
            truth=truth,
        )
        for k, (name, start, std, truth) in enumerate(
            zip(NAMES, (5.0, 3.0), (0.02, 0.005), (6.23, 2.09), strict=True)
        )
    )
    done = values is not None
    return EstimateRecord(
        **{
            "seed": seed,
            "simulated": True,
            "status": "converged" if done else "failed",
            "reason": "converged: the change is small" if done else "not converged: no prediction",
            "unknowns": unknowns,
            "distance_mm": Spread(mean=0.0004, std=0.0002, max=0.001) if done else None,
            "iterations": 3,
            "forward_solves": 5,
            "iterates": ((5.0, 3.0), values) if values else (),
            "iterate_std": ((2.0, 2.0), (0.02, 0.005)) if done else (),
            "seconds": 1.5,
            **changes,
        }
    )


def made_up_twin(values: tuple[float, ...] | None = (6.2296, 2.0901), **header: Any) -> Record:
    """A record of the study ``twin`` with one estimate, or a failed one."""
    from experiments.studies.twin import _row, _table

    estimate = made_up_estimate(values)
    given = {"row": "same model", **header}
    config = {
        "row": given["row"],
        "parameters": NAMES,
        "mechanics": {"element": "hex18", "tissue": {}},
        "mesh": {"columns": 24, "rows": 3, "layers": 1, "source": "structured"},
        "filter": {"mode": "paper"},
        "observation": {"noise_mm": 0.0},
    }
    row = _row(config, estimate, None)
    return made_up(
        **{
            "study": "twin",
            "experiment": "table1",
            "table": "table1",
            "title": "Moduli of a synthetic valve",
            "parameters": NAMES,
            "status": estimate.status,
            "reason": estimate.reason,
            "estimates": (estimate,),
            "tables": {"": _table([row | {"forward solves": 5}]).plain()},
            **given,
        }
    )
