"""What the studies of the forward model share."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

from experiments.common.records.record import Mesh, Outcome
from mvest.valve.mesh.solid_mesh import SolidMesh

__all__ = ["outcome_of"]

F = TypeVar("F")


def outcome_of(
    findings: F,
    mesh: SolidMesh,
    forward_solves: int,
    failures: Iterable[str] = (),
    gate: str | None = None,
) -> Outcome[F]:
    """The outcome of a study, which failed for the first of the reasons given, if any."""
    reason = next(iter(failures), None)
    return Outcome(
        findings=findings,
        status="converged" if reason is None else "failed",
        reason="completed" if reason is None else reason,
        mesh=Mesh(mesh.sha256, len(mesh.nodes)),
        forward_solves=forward_solves,
        gate=gate,
    )
