"""What frames of a case will tell, found out before anything is estimated.

The information of an observation needs a model, where it is believed to be, and how well what is
seen; it needs no observed value. `expect_case` closes the generic valve once on the coarse mesh of
the guide and says which intervals to expect, what they rest on and what would narrow them
(`mvest.personalisation.known`). `design_case` says how many more frames it takes: information adds
up over frames whose errors are independent; what is not known of pressures, chordae, displacement
and geometry is common to them. Each design is a few small matrices, and all need one set of
closures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from mvest.cases.case import Role, ValveCase
from mvest.closure.frames import ERROR, OFFSET, SCALE, is_frame_pressure
from mvest.closure.model import ClosureModel
from mvest.estimation.information.design import Design, together
from mvest.estimation.information.identifiability import Identifiability
from mvest.estimation.prediction import predict
from mvest.estimation.transform import to_filter
from mvest.personalisation.errors import FrameErrors, linearise
from mvest.personalisation.estimation import CaseProblem, linearised, sampled
from mvest.personalisation.known import LinearModel, narrower, variance_shares
from mvest.personalisation.model import build_coarse, build_model
from mvest.personalisation.result import Expected
from mvest.personalisation.settings import PersonaliseSettings, PressureErrors
from mvest.problem.estimate import expected_intervals


def expect_case(
    case: ValveCase, settings: PersonaliseSettings, model: ClosureModel | None = None
) -> Expected:
    """What an estimate of a case could tell, to first order about the generic valve.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    model : ClosureModel, optional
        The closure of the case; by default on the mesh of the guide.
    """
    model = build_coarse(case, settings) if model is None else model
    problem = CaseProblem.of(case, settings, model=model)
    place = problem.generic()
    if not place.prediction.converged:
        return Expected(reason=place.prediction.reason)
    place = linearised(place, problem)
    if case.error_samples is not None:
        place = sampled(place)
    seen = predict(
        place.errors.observation().of(lambda _: place.prediction), place.m, derivatives=True
    )
    transform, prior = problem.transform, to_filter(problem.transform, problem.prior)
    H = seen.jacobian * transform.derivative(transform.forward(place.m))
    linear = LinearModel(problem.names, prior.covariance, H, place.errors)
    after = np.sqrt(linear.variances())
    unknowns = expected_intervals(problem.names, transform, place.m, prior.std, after)
    return Expected(unknowns, variance_shares(linear), narrower(problem, linear))


SHARES = (1.0, 0.875, 0.75, 0.625, 0.5)
"""Of the closed frame's pressure, under which the frames of designs are: 120 to 60 mmHg."""

HALF = 0.5
"""Of the prior's standard deviation: half the error of the generic guess."""

ERRORS_MMHG = (0.0, 2.0, 5.0, 10.0, 20.0)
"""Errors of pressures that designs are compared with."""

KINDS = {
    "factor": "as a factor on all",
    "offset": "as an offset of all",
    "each": "of each by itself",
}
"""Of errors of pressures, and what a reader calls them."""

GROUPS: dict[str, tuple[str, ...]] = {
    "the pressures": (SCALE, OFFSET, ERROR),
    "the chordae": ("chord_stiffness", "chord_rest_length"),
    "the displacement": ("shift", "turn"),
    "the geometry": ("geometry",),
}
"""Unknowns that might be known exactly, by the first part of their names."""

EXACT = 1e-9
"""Relative error of a factor that is known; zero would take it out of what is estimated."""

Errors: TypeAlias = Mapping[str, float]
"""Standard deviation of each of `KINDS`: relative of the factor, the others in mmHg."""


def errors_of(kind: str, mmhg: float, pressure_mmHg: float) -> dict[str, float]:
    """Errors of one of `KINDS` and of no other, of a size under a pressure."""
    relative = max(mmhg / pressure_mmHg if kind == "factor" else 0.0, EXACT)
    return {"factor": relative} | {k: mmhg * (k == kind) for k in ("offset", "each")}


@dataclass(frozen=True, slots=True, eq=False)
class FrameDesigns:
    """What closed frames of one valve say together.

    Attributes
    ----------
    pressures_mmHg : tuple of float
        Stated of the frames, the closed one's first.
    frames : tuple of Design
        What each of them says of all unknowns: those of the case, the pressures' errors in mmHg
        (`mvest.closure.frames`) and, where it is marginalised, the geometry's.
    knowledge : mapping
        Unknown but those errors -> its prior's standard deviation, relative or in its unit.
    stated : mapping
        Errors of the pressures as they are stated.
    """

    pressures_mmHg: tuple[float, ...]
    frames: tuple[Design, ...]
    knowledge: Mapping[str, float]
    stated: Errors

    def chosen(self, count: int) -> tuple[int, ...]:
        """Which frames make a design of ``count``: spread evenly over the pressures."""
        if count == 1:
            return (0,)
        return tuple(np.round(np.linspace(0, len(self.frames) - 1, count)).astype(int).tolist())

    def at(
        self, count: int, errors: Errors | None = None, known: tuple[str, ...] = ()
    ) -> Identifiability:
        """What ``count`` frames and the prior say together.

        Parameters
        ----------
        count : int
        errors : mapping, optional
            Of the pressures; default as stated.
        known : tuple of str
            Further unknowns that are taken to be known exactly, by the first part of their names.
        """
        errors, members = errors or self.stated, self.chosen(count)
        knowledge = dict(self.knowledge)
        for name in self.frames[0].names:
            kind, _, number = name.partition(".")
            if kind in known:
                knowledge[name] = 0.0
            elif kind == SCALE:
                knowledge[name] = errors["factor"]
            elif kind == OFFSET:
                knowledge[name] = errors["offset"]
            elif kind == ERROR:
                knowledge[name] = errors["each"] if int(number) in members else 0.0
        return together(*(self.frames[k] for k in members)).at(1.0, knowledge)

    def left(
        self, count: int, errors: Errors | None = None, known: tuple[str, ...] = ()
    ) -> dict[str, float]:
        """Standard deviation of each modulus as a share of the prior's; arguments as of `at`.

        The generic guess has 1: it is what is left of its error.
        """
        bound = self.at(count, errors, known)
        return {
            name: float(std) / self.knowledge[name]
            for name, std in zip(bound.names, bound.std, strict=True)
            if name.startswith("E_f.")
        }

    def rows(self) -> Iterator[dict[str, Any]]:
        """Tidy rows of what each design leaves of each modulus' error, ``left`` in percent of it.

        The pressures' errors are of one kind and have a size in mmHg, or are as stated, with
        nothing or one group of unknowns ``known``.
        """
        closed, unknowns = (
            self.pressures_mmHg[0],
            {n.partition(".")[0] for n in self.frames[0].names},
        )
        groups = {words: group for words, group in GROUPS.items() if unknowns & set(group)}
        designs: list[tuple[str, float, str, Errors | None, tuple[str, ...]]] = [
            (kind, mmhg, "", errors_of(kind, mmhg, closed), ())
            for kind, mmhg in product(KINDS, ERRORS_MMHG)
        ]
        designs += [
            ("stated", 0.0, words, None, group) for words, group in {"": (), **groups}.items()
        ]
        for (kind, mmhg, words, errors, known), k in product(designs, range(len(self.frames))):
            for modulus, share in self.left(k + 1, errors, known).items():
                yield {
                    "errors": kind,
                    "error": mmhg,
                    "known": words,
                    "frames": k + 1,
                    "modulus": modulus,
                    "left": 100.0 * share,
                }


def design_case(
    case: ValveCase, settings: PersonaliseSettings, model: ClosureModel | None = None
) -> FrameDesigns | str:
    """What several closed frames of a case would tell, or why that is not known.

    The frames are held and seen as the closed one, under shares of its pressure (`SHARES`): one
    closure, and an equilibrium with its derivatives for each. Errors of which samples tell are left
    out. Parameters are those of `expect_case`.
    """
    model = build_model(case, settings) if model is None else model
    closed = case.frame(Role.CLOSED)
    pressures = tuple(share * closed.pressure_mmHg for share in SHARES)
    frames = [
        replace(
            closed,
            name=str(k),
            time=closed.time + k,
            role=Role.FITTED if k else Role.CLOSED,
            pressure_mmHg=pressure,
        )
        for k, pressure in enumerate(pressures)
    ]
    case = replace(case, frames=(case.frame(Role.REFERENCE), *frames), error_samples=None)
    stated = settings.pressures or PressureErrors(0.0, 0.0)
    # As unknowns they are differentiated by; how large they are is for the designs to say.
    free = [u.name for u in settings.unknowns if not u.fixed]
    differentiated = PressureErrors(1.0, 1.0) if SCALE in free else None
    problem = CaseProblem.of(case, replace(settings, pressures=differentiated), model=model)
    registered, start = problem.stated.registered, problem.start
    generic = registered(start)
    if not generic.converged:
        return generic.reason
    errors = linearise(FrameErrors(problem.fitted), registered, start, generic.y)
    observation, columns = problem.fitted.observation(), errors.columns()
    # Prior standard deviations: relative of what is positive, 1 of the geometry's modes.
    knowledge = {
        u.name: u.std / (u.mean if u.is_positive else 1.0)
        for u in problem.unknowns
        if not is_frame_pressure(u.name)
    }
    modes = [f"geometry.{k}" for k in range(sum(own.shape[1] for own in columns.values()))]
    knowledge |= dict.fromkeys(modes, 1.0)
    H = predict(observation.of(lambda _: generic), start, derivatives=True).jacobian
    H = np.concatenate([H, *columns.values()], axis=1)
    at = np.array([u.mean if u.is_positive else 1.0 for u in problem.unknowns] + [1.0] * len(modes))
    names = (*problem.names, *modes)
    noise = errors.single_noise()
    # Errors of different frames are independent: without the others' rows a frame is by itself.
    of_frame = np.repeat([int(frame.name) for frame in problem.fitted.frames], observation.sizes)
    return FrameDesigns(
        pressures,
        tuple(
            Design.of(np.where(of_frame[:, None] == k, H, 0.0), noise, at, names)
            for k in range(len(problem.fitted.frames))
        ),
        knowledge,
        {
            "factor": knowledge.get(SCALE, 0.0),
            "offset": stated.offset_mmHg,
            "each": stated.each_mmHg,
        },
    )
