"""Expected precision of an estimate, before anything is estimated.

The information of an observation needs a model, its parameters and the errors, but no observed
value. `expect_case` closes the generic valve once on the coarse guide mesh, and gives the expected
intervals, their sources of variance and what would narrow them (`mvest.personalisation.known`).
`design_case` compares numbers of closed frames: information adds over frames with independent
errors, but errors of pressures, chordae, displacement and geometry are common to them. All designs
are a few small matrices from one set of closures.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from mvest.cases.case import Role, ValveCase
from mvest.closure.frames import ERROR, OFFSET, SCALE, is_frame_pressure
from mvest.closure.model import ClosureModel
from mvest.estimation.prediction import predict
from mvest.estimation.transform import to_filter
from mvest.personalisation.closed import closed_details
from mvest.personalisation.estimation import CaseProblem, linearised
from mvest.personalisation.known import LinearModel, narrower, variance_shares
from mvest.personalisation.model import build_coarse, build_model
from mvest.personalisation.result import Expected
from mvest.personalisation.settings import PersonaliseSettings, PressureErrors
from mvest.problem.estimate import expected_intervals
from mvest.typing import FloatArray


def expect_case(
    case: ValveCase, settings: PersonaliseSettings, model: ClosureModel | None = None
) -> Expected:
    """Expected precision of an estimate of a case, to first order about the generic valve.

    The default model is the closure on the guide mesh.
    """
    model = build_coarse(case, settings) if model is None else model
    problem = CaseProblem.of(case, settings, model=model)
    point = problem.generic()
    if not point.prediction.converged:
        return Expected(reason=point.prediction.reason)
    point = linearised(point)
    if case.error_samples is not None:
        point = point.sampled()
    seen = predict(
        point.errors.observation().of(lambda _: point.prediction), point.m, derivatives=True
    )
    transform, prior = problem.transform, to_filter(problem.transform, problem.prior)
    H = seen.jacobian * transform.derivative(transform.forward(point.m))
    linear = LinearModel(problem.names, prior.covariance, H, point.errors)
    after = np.sqrt(linear.variances())
    unknowns = expected_intervals(problem.names, transform, point.m, prior.std, after)
    closed = closed_details(point.valve, point.errors)
    return Expected(
        unknowns,
        list(variance_shares(linear)),
        list(narrower(problem, linear)),
        closed.get("physiology", ()),
        closed.get("resistance", ()),
    )


SHARES = (1.0, 0.875, 0.75, 0.625, 0.5)
"""Pressures of the frames of designs as shares of the closed frame's: 120 to 60 mmHg."""

ERRORS_MMHG = (0.0, 2.0, 5.0, 10.0, 20.0)
"""Errors of pressures that designs are compared for."""

KINDS = ("factor", "offset", "each")
"""Kinds of errors of pressures: a factor on all, an offset of all, and of each by itself."""

GROUPS: dict[str, tuple[str, ...]] = {
    "the pressures": (SCALE, OFFSET, ERROR),
    "the chordae": ("chord_stiffness", "chord_rest_length"),
    "the displacement": ("shift", "turn"),
    "the geometry": ("geometry",),
}
"""Unknowns that might be known exactly, by the first part of their names."""

Errors: TypeAlias = Mapping[str, float]
"""Standard deviation of each of `KINDS`: relative for the factor, otherwise in mmHg."""


def errors_of(kind: str, mmhg: float, pressure_mmHg: float) -> dict[str, float]:
    """Errors of only one of `KINDS`, with a size under a pressure."""
    return dict.fromkeys(KINDS, 0.0) | {kind: mmhg / pressure_mmHg if kind == "factor" else mmhg}


@dataclass(frozen=True, slots=True, eq=False)
class FrameDesigns:
    """Information of closed frames of one valve."""

    pressures_mmHg: tuple[float, ...]  #: stated pressures of the frames, the closed one's first
    #: (q,), the unknowns of the case, the pressures' errors in mmHg (`mvest.closure.frames`) and
    #: the modes of the geometry, if it is uncertain.
    names: tuple[str, ...]
    #: (f, q, q), root T of the information Tᵀ T of each frame about the unknowns, relative for
    #: positive ones, otherwise in their units.
    triangles: FloatArray
    #: Unknown except for errors of pressures -> its prior standard deviation in the same terms.
    knowledge: Mapping[str, float]
    stated: Errors  #: errors of the pressures as stated

    def chosen(self, count: int) -> tuple[int, ...]:
        """The frames of a design of ``count``: spread evenly over the pressures."""
        if count == 1:
            return (0,)
        last = len(self.pressures_mmHg) - 1
        return tuple(np.round(np.linspace(0, last, count)).astype(int).tolist())

    def std(
        self, count: int, errors: Errors | None = None, known: tuple[str, ...] = ()
    ) -> dict[str, float]:
        """Posterior standard deviation of each unknown from ``count`` frames.

        By default the errors of the pressures are those stated. ``known`` are further unknowns that
        are known exactly, by the first part of their names.
        """
        errors, members = errors or self.stated, self.chosen(count)
        pressures = {SCALE: errors["factor"], OFFSET: errors["offset"]}
        pressures |= {f"{ERROR}.{k}": errors["each"] for k in members}
        prior = {**dict.fromkeys(self.names, 0.0), **self.knowledge, **pressures}
        stds = np.array(
            [0.0 if name.partition(".")[0] in known else prior[name] for name in self.names]
        )
        rows = [*(self.triangles[list(members)] * stds), np.eye(len(stds))]
        R = np.linalg.qr(np.concatenate(rows), mode="r")
        after = stds * np.linalg.norm(np.linalg.inv(R), axis=1)
        return dict(zip(self.names, after.tolist(), strict=True))

    def left(
        self, count: int, errors: Errors | None = None, known: tuple[str, ...] = ()
    ) -> dict[str, float]:
        """Standard deviation of each modulus as a share of the prior's; arguments as of `std`."""
        std = self.std(count, errors, known)
        return {n: std[n] / self.knowledge[n] for n in self.names if n.startswith("E_f.")}

    def rows(self) -> Iterator[dict[str, Any]]:
        """Tidy rows: the error ``left`` of each modulus by each design, in percent of the prior's.

        Errors of pressures are of one kind with a size in mmHg, or as stated, then with nothing or
        one group of unknowns ``known``.
        """
        unknowns = {n.partition(".")[0] for n in self.names}
        groups = {words: group for words, group in GROUPS.items() if unknowns & set(group)}
        designs: list[tuple[str, float, str, Errors | None, tuple[str, ...]]] = [
            (kind, mmhg, "", errors_of(kind, mmhg, self.pressures_mmHg[0]), ())
            for kind, mmhg in product(KINDS, ERRORS_MMHG)
        ]
        designs += [
            ("stated", 0.0, words, None, group) for words, group in {"": (), **groups}.items()
        ]
        counts = range(1, 1 + len(self.pressures_mmHg))
        for (kind, mmhg, words, errors, known), count in product(designs, counts):
            for modulus, share in self.left(count, errors, known).items():
                yield {
                    "errors": kind,
                    "error": mmhg,
                    "known": words,
                    "frames": count,
                    "modulus": modulus,
                    "left": 100.0 * share,
                }


def design_case(
    case: ValveCase, settings: PersonaliseSettings, model: ClosureModel | None = None
) -> FrameDesigns | str:
    """Information of several closed frames of a case, or why it is unknown.

    The frames have the boundary and errors of the closed one, under shares of its pressure
    (`SHARES`). That takes one closure, and an equilibrium with its derivatives for each frame.
    Error samples are left out. Parameters are those of `expect_case`.
    """
    model = build_model(case, settings) if model is None else model
    closed = case.frame(Role.CLOSED)
    pressures = tuple(share * closed.pressure_mmHg for share in SHARES)
    frames = [replace(closed, name="0")]
    for k, p in enumerate(pressures[1:], start=1):
        time, role = closed.time + k, Role.FITTED
        frames.append(replace(closed, name=str(k), time=time, role=role, pressure_mmHg=p))
    case = replace(case, frames=(case.frame(Role.REFERENCE), *frames), error_samples=None)
    stated = settings.pressures or PressureErrors(0.0, 0.0)
    # Errors of pressures are unknowns for their derivatives; the designs set their size.
    free = [u.name for u in settings.unknowns if not u.fixed]
    differentiated = PressureErrors(1.0, 1.0) if SCALE in free else None
    problem = CaseProblem.of(case, replace(settings, pressures=differentiated), model=model)
    generic = problem.generic()
    if not generic.prediction.converged:
        return generic.prediction.reason
    errors = linearised(generic).errors
    observation, columns = problem.fitted.observation(), errors.columns()
    # Prior standard deviations: relative for positive unknowns, 1 for modes of the geometry.
    knowledge = {
        u.name: u.std / (u.mean if u.is_positive else 1.0)
        for u in problem.unknowns
        if not is_frame_pressure(u.name)
    }
    modes = [f"geometry.{k}" for k in range(sum(own.shape[1] for own in columns.values()))]
    knowledge |= dict.fromkeys(modes, 1.0)
    seen = predict(observation.of(lambda _: generic.prediction), generic.m, derivatives=True)
    scale = np.array([u.mean if u.is_positive else 1.0 for u in problem.unknowns])
    H = np.concatenate([seen.jacobian * scale, *columns.values()], axis=1)
    noise = errors.single_noise()
    # Errors of different frames are independent, so a frame's information is that of its rows.
    of_frame = np.repeat([int(frame.name) for frame in problem.fitted.frames], observation.sizes)
    white = [noise.whiten(np.where(of_frame[:, None] == k, H, 0.0)) for k in range(len(frames))]
    triangles = np.stack([np.linalg.qr(own, mode="r") for own in white])
    factor = knowledge.get(SCALE, 0.0)
    sizes = {"factor": factor, "offset": stated.offset_mmHg, "each": stated.each_mmHg}
    return FrameDesigns(pressures, (*problem.names, *modes), triangles, knowledge, sizes)
