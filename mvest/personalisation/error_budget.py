"""What each part of what is not known of a case costs the moduli, to first order.

Error samples of the frames are taken apart: into a rigid motion of both frames together, one of
the closed against the open frame (displaced, tilted), and what is left near the annulus, in the
belly and near the free edge of each frame, and of the papillary tips. The parts of a sample add up
to it. Beside them stands how the frames differ: half of the difference of their errors, with its
sign in each. With their derivatives, those of all else that is in doubt and those of the unknowns,
the covariance of the moduli is known with any part left out, or with it alone: through gains that
have not seen the sample (`mvest.estimation.sampled`), since one that has takes nearly all of it for
known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mvest.cases.case import Role, ValveCase
from mvest.estimation.noise import ObservationNoise, low_rank_noise
from mvest.estimation.sampled import SampledErrors
from mvest.typing import FloatArray, IntArray
from mvest.valve.geometry.surface_coordinates import surface_coordinates

EVERYTHING = "everything"
"""Row of what is not known, all of it; alone, it is nothing but the noise of the frame."""

IMAGES, MOTION = "errors of the images", "motion between the frames"

BANDS = ("{} frame near the annulus", "belly of the {} frame", "{} frame near the free edge")


@dataclass(frozen=True, slots=True)
class BudgetRow:
    """Standard deviation of a modulus' logarithm.

    Attributes
    ----------
    part : str
    modulus : str
    without : float
        If the part were known exactly, all else as it is.
    alone : float
        If all else were known exactly.
    """

    part: str
    modulus: str
    without: float
    alone: float


Moves = tuple[FloatArray, FloatArray]
"""Samples of displacements of vertices ``(K, f, n, 3)`` and tips ``(K, f, t, 3)`` in mm."""


def sample_parts(case: ValveCase) -> tuple[dict[str, Moves], Moves]:
    """The error samples of a case in parts that add up to them, and how its frames differ.

    Returns
    -------
    parts : dict
        Words -> displacements.
    motion : Moves
        Without it both frames have the same error, the mean of theirs.
    """
    samples = case.error_samples
    assert samples is not None
    roles = [frame.role for frame in case.frames]
    open_, closed = roles.index(Role.REFERENCE), roles.index(Role.CLOSED)
    points = {
        k: np.concatenate([case.frames[k].vertices, case.frames[k].papillary_tips])
        for k in (open_, closed)
    }
    n = len(case.surface.vertices)
    moves = np.concatenate([samples.vertices, samples.tips], axis=2)
    centre = points[open_][:n].mean(axis=0)
    fields = {k: _rigid_fields(x - centre) for k, x in points.items()}
    # Of the leaflets; the tips go with them.
    motion = {
        k: np.linalg.lstsq(F[: 3 * n], moves[:, k, :n].reshape(len(moves), -1).T, rcond=None)[0]
        for k, F in fields.items()
    }
    together = 0.5 * (motion[open_] + motion[closed])
    parts: dict[str, FloatArray] = {}

    def part(words: str, frames: Mapping[int, FloatArray]) -> None:
        whole = np.zeros_like(moves)
        for k, own in frames.items():
            whole[:, k] = own
        parts[words] = whole

    def moved(k: int, by: FloatArray) -> FloatArray:
        return np.asarray((fields[k] @ by).T.reshape(len(moves), -1, 3))

    part("both frames displaced as one", {k: moved(k, together) for k in fields})
    for words, members in (("closed frame displaced", (0, 3)), ("closed frame tilted", (3, 6))):
        chosen = np.zeros((6, 1))
        chosen[members[0] : members[1]] = 1.0
        part(words, {k: moved(k, chosen * (motion[k] - together)) for k in fields})
    left = {k: moves[:, k] - moved(k, motion[k]) for k in fields}
    around = surface_coordinates(
        case.surface.vertices, case.surface.triangles, case.annulus, case.free_edge
    )
    s = np.clip(around.s, 0.0, 1.0)
    shares = ((1 - s) ** 2, 2 * s * (1 - s), s**2)
    for name, k in (("open", open_), ("closed", closed)):
        for words, share in zip(BANDS, shares, strict=True):
            weight = np.concatenate([share, np.zeros(len(points[k]) - n)])[:, None]
            part(words.format(name), {k: weight * left[k]})
    at_tips = np.arange(moves.shape[2])[:, None] >= n
    part("papillary tips", {k: at_tips * left[k] for k in fields})

    def moves_of(whole: FloatArray) -> Moves:
        return whole[:, :, :n], whole[:, :, n:]

    differ = np.zeros_like(moves)
    differ[:, open_] = 0.5 * (moves[:, open_] - moves[:, closed])
    differ[:, closed] = -differ[:, open_]
    return {words: moves_of(whole) for words, whole in parts.items()}, moves_of(differ)


def _rigid_fields(x: FloatArray) -> FloatArray:
    """Displacements ``(3 n, 6)`` of points ``(n, 3)`` by small motions."""
    turns = np.cross(np.eye(3)[:, None], x[None])
    shifts = np.broadcast_to(np.eye(3)[:, None], turns.shape)
    return np.asarray(np.concatenate([shifts, turns]).reshape(6, -1).T)


def budget_rows(
    names: Sequence[str],
    H: FloatArray,
    prior: FloatArray,
    base: ObservationNoise,
    images: Mapping[str, FloatArray],
    motion: FloatArray,
    source: IntArray | None,
    considered: Mapping[str, FloatArray],
) -> tuple[BudgetRow, ...]:
    """What is left of each modulus with every part left out, and with it alone.

    Parameters
    ----------
    names : sequence of str, (p,)
        Of the unknowns.
    H : (n, p)
        Derivatives of the observation by them, in filter coordinates.
    prior : (p, p)
        Their covariance.
    base : ObservationNoise
        Of single observations.
    images : mapping
        Words -> each part ``(n, K)`` of the error samples.
    motion : (n, K)
        How the frames differ in these samples.
    source : (K,) or None
        See `SampledErrors`.
    considered : mapping
        Words -> columns of whatever else is in doubt.
    """
    moduli = [k for k, name in enumerate(names) if name.startswith("E_f.")]
    nuisances = [k for k in range(len(names)) if k not in moduli]
    whole = np.sum(list(images.values()), axis=0)
    free = [*moduli, *nuisances]

    def std(
        samples: FloatArray | None, beside: Sequence[FloatArray], unknown: Sequence[int]
    ) -> FloatArray:
        joined = np.concatenate([np.zeros((len(H), 0)), *beside], axis=1)
        noise = low_rank_noise(base, joined) if joined.shape[1] else base
        own, P = H[:, unknown], prior[np.ix_(unknown, unknown)]
        if samples is None:
            A = noise.whiten(own)
            covariance = np.linalg.inv(np.linalg.inv(P) + A.T @ A)
        else:
            covariance = SampledErrors(noise, samples, source, joined).posterior(own, P).covariance
        return np.sqrt(np.diag(covariance))[: len(moduli)]

    every = list(considered.values())

    def rows() -> Iterator[tuple[str, FloatArray, FloatArray]]:
        yield EVERYTHING, std(whole, every, free), std(None, [], moduli)
        yield IMAGES, std(None, every, free), std(whole, [], moduli)
        for words, own in {MOTION: motion, **images}.items():
            yield words, std(whole - own, every, free), std(own, [], moduli)
        for words, own in considered.items():
            rest = [one for name, one in considered.items() if name != words]
            yield words, std(whole, rest, free), std(None, [own], moduli)
        for k in nuisances:
            known = [*moduli, *(other for other in nuisances if other != k)]
            yield names[k], std(whole, every, known), std(None, [], [*moduli, k])

    return tuple(
        BudgetRow(words, names[k], float(without), float(alone))
        for words, left, by_itself in rows()
        for k, without, alone in zip(moduli, left, by_itself, strict=True)
    )
