"""What follows from a sweep, in sentences that are computed from its numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from experiments.sweeps.collected import Sweep
from experiments.sweeps.families import (
    covariance_lines,
    discrepancies,
    filter_conditions,
    is_own_model,
    noise_groups,
)
from experiments.sweeps.rows import (
    FACTORS,
    Run,
    factor_names,
    kind_of,
    runs_of,
    short_names,
)
from experiments.sweeps.statistics import (
    BASIN_PERCENT,
    BOUND_FACTOR,
    COVERAGE_RANGE,
    accuracy,
    converged,
    coverage,
    grouped,
    in_basin,
    spread_of,
    verdict,
)
from mvest.reporting.markup import listed, number

__all__ = ["conclusions", "question"]

QUESTIONS = {
    "initial_guess": "From which initial guesses does the filter find the true moduli?",
    "covariance": "How much do the prior's, the process's and the observation's covariance matter?",
    "noise": "How large is the error under noise, and can the reported intervals be trusted?",
    "discrepancy": "What does an estimate cost when the truth is not the filter's own model?",
    "filter": "Which filter finds the moduli, how well, and with how many forward solves?",
}
NEXT, NOTABLE_PERCENT = 3, 5.0
"""Of the errors after the largest, these many are named, and all that are as large as this."""

UNKNOWN_QUESTION = "How do the estimates depend on what was varied?"


def question(sweep: Sweep) -> str:
    """What the sweep asks."""
    return QUESTIONS.get(kind_of(sweep), UNKNOWN_QUESTION)


def conclusions(sweep: Sweep) -> list[str]:
    """Sentences for readers, the answer first, failures last."""
    by_kind: Mapping[str, Callable[[Sweep, list[Run]], list[str]]] = {
        "initial_guess": _initial_guess,
        "covariance": _covariance,
        "noise": _noise,
        "discrepancy": _discrepancy,
        "filter": _filter,
    }
    runs = runs_of(sweep)
    if not runs:
        return ["The sweep has no jobs, so nothing follows from it."]
    if not converged(runs):
        return [f"None of the {len(runs)} runs converged, so nothing follows.", *_failures(runs)]
    if not any(np.isfinite(run.truth).all() for run in runs):
        return ["The truth is unknown here, so there are no errors to compare.", *_failures(runs)]
    return by_kind.get(kind_of(sweep), _anything)(sweep, runs) + _failures(runs)


def _failures(runs: Sequence[Run]) -> list[str]:
    lost = [run for run in runs if not run.converged]
    if not lost:
        return [f"{_count(len(runs), 'run')}, none failed."]
    counts = Counter(run.ended for run in lost)
    reasons = "; ".join(f"{n} × {reason}" for reason, n in counts.most_common())
    whole = sum(run.seed is None for run in lost)
    jobs = f" ({_count(whole, 'job')} left no result at all)" if whole else ""
    return [f"{len(lost)} of {len(runs)} runs failed{jobs}: {reasons}."]


def _count(n: int, what: str) -> str:
    return f"{n} {what}" + ("" if n == 1 else "s")


def _worst(runs: Sequence[Run]) -> Run | None:
    known = [run for run in converged(runs) if np.isfinite(run.largest_error)]
    return max(known, key=lambda run: run.largest_error) if known else None


def _initial_guess(sweep: Sweep, runs: list[Run]) -> list[str]:
    groups = {mode: group for (mode,), group in grouped(runs, ["filter"]).items()}
    counts = [f"{sum(map(in_basin, group))} of {len(group)}" for group in groups.values()]
    modes = [f"in the {mode} mode" for mode in groups]
    first = f"{counts[0]} starts converge to within {BASIN_PERCENT:g} % {modes[0]}"
    following = [f"{n} {mode}" for n, mode in zip(counts[1:], modes[1:], strict=True)]
    sentences = [f"{', '.join([first, *following])}."]
    starts = np.array([run.start for run in runs])
    if np.isfinite(starts).all():
        ranges = [
            f"{number(low)} to {number(high)} ({name})"
            for name, low, high in zip(
                short_names(sweep.parameters), starts.min(0), starts.max(0), strict=True
            )
        ]
        sentences.append(f"The starts range over {listed(ranges)}.")
    for mode, group in groups.items():
        outside = [run for run in group if not in_basin(run)]
        if outside:
            failed = sum(not run.converged for run in outside)
            sentences.append(
                f"Of the {_count(len(outside), 'start')} outside this basin in the {mode} mode, "
                f"{failed} failed and {len(outside) - failed} converged elsewhere."
            )
    for mode, group in groups.items():
        worst, solves = _worst(group), spread_of([r.forward_solves for r in converged(group)])
        if worst is not None:
            start = "/".join(number(value) for value in worst.start)
            sentences.append(
                f"In the {mode} mode the largest error of a converged run is "
                f"{number(worst.largest_error)} %, from the start {start}; a run takes "
                f"{number(solves['median'])} forward solves (median), at most "
                f"{number(solves['max'])}."
            )
    return sentences


def _covariance(sweep: Sweep, runs: list[Run]) -> list[str]:
    """Which covariance moves the error most, along lines where the others are kept."""
    swings: list[tuple[float, str]] = []
    growths: list[tuple[float, str]] = []
    quiet: dict[str, bool] = {}
    for line in covariance_lines(runs):
        good = [(value, group) for value, group in line.points if converged(group)]
        errors = [
            max(accuracy(group, k).rmse_percent for k in range(len(sweep.parameters)))
            for _, group in good
        ]
        if len(good) < 2 or not np.isfinite(errors).all():
            continue
        kept = f", {line.others}" if line.others and line.others != "all runs" else ""
        where = f"{_quantity(line.quantity)} in the {line.mode} mode"
        swing = max(errors) - min(errors)
        swings.append(
            (
                swing,
                f"{where}: from {good[0][0]:g} to {good[-1][0]:g}{kept}, the largest error of a "
                f"modulus lies between {number(min(errors))} and {number(max(errors))} %",
            )
        )
        std = np.array([np.mean([run.std for run in converged(g)], axis=0) for _, g in good])
        growths.append((float(np.max(std.max(axis=0) / std.min(axis=0))), where))
        quiet[where] = quiet.get(where, True) and max(errors) <= BASIN_PERCENT
    if not swings:
        return []
    sentences = [f"The error depends most on {max(swings)[1]}."]
    if still := [where for where, all_small in quiet.items() if all_small]:
        sentences.append(
            f"It stays within {BASIN_PERCENT:g} % at every value tried of {listed(still)}."
        )
    growth, where = max(growths)
    sentences.append(
        f"The reported standard deviation depends most on {where}: it changes by a factor of "
        f"{number(growth)}."
    )
    return sentences


def _quantity(name: str) -> str:
    return "P0, Q and R together" if name == "all" else name


def _noise(sweep: Sweep, runs: list[Run]) -> list[str]:
    names = short_names(sweep.parameters)
    ratios: list[tuple[float, str]] = []
    shares: list[tuple[float, str]] = []
    verdicts: Counter[str] = Counter()
    above: dict[str, None] = {}
    outside: dict[str, None] = {}
    groups = [group for group in noise_groups(runs) if group.level]
    for group in groups:  # Without noise there is nothing that an interval should cover.
        for k, name in enumerate(names):
            found, covered = accuracy(group.runs, k), coverage(group.runs, k)
            where = f"{group.label}; {name}"
            if np.isfinite(found.ratio):
                ratios.append((found.ratio, where))
                if found.ratio > BOUND_FACTOR:
                    above[f"“{group.label}”"] = None
            if covered.n:
                shares.append((covered.share, where))
                verdicts[verdict(covered)] += 1
                if verdict(covered) == "no":
                    outside[f"“{group.label}”"] = None
    sentences = []
    if ratios:
        near = sum(ratio <= BOUND_FACTOR for ratio, _ in ratios)
        largest = max(ratios)
        sentences.append(
            f"The root mean square error is within {BOUND_FACTOR:g} times the Cramér–Rao bound in "
            f"{near} of {len(ratios)} combinations of noise, level and parameter; the largest "
            f"ratio is {number(largest[0])} ({largest[1]})."
        )
        if above:
            sentences.append(f"It is above that for {listed(list(above))}.")
    if shares:
        low, high = COVERAGE_RANGE
        smallest = min(shares)
        sentences.append(
            f"The nominal 95 % interval covers the truth in {100 * low:.0f}–{100 * high:.0f} % of "
            f"the runs in {verdicts['yes']} of {len(shares)} combinations, in {verdicts['no']} it "
            f"does not, in {verdicts['too few runs to tell']} there are too few runs to tell; the "
            f"smallest coverage is {100 * smallest[0]:.0f} % ({smallest[1]})."
        )
        if outside:
            sentences.append(f"It does not for {listed(list(outside))}.")
    strongest = {group.kind: group for group in groups if converged(group.runs)}
    for group in strongest.values():
        errors = [
            f"{number(accuracy(group.runs, k).rmse_percent, 2)} % ({name})"
            for k, name in enumerate(names)
        ]
        sentences.append(f"Under “{group.label}” the root mean square error is {listed(errors)}.")
    return sentences


def _discrepancy(sweep: Sweep, runs: list[Run]) -> list[str]:
    """The largest error under each discrepancy, of any modulus on any mesh."""
    names = short_names(sweep.parameters)
    effects = []
    groups = discrepancies(runs)
    meshes = len({run.cells for run in runs}) > 1
    for what, group in groups.items():
        worst = _worst(group)
        if worst is not None:
            k = int(np.argmax(np.abs(worst.error)))
            on = f" on {' x '.join(map(str, worst.cells))} cells" if meshes else ""
            effects.append((worst.largest_error, worst.error[k], names[k], what, on))
    effects.sort(key=lambda effect: -effect[0])
    own = {what for what, group in groups.items() if is_own_model(group)}
    real = [effect for effect in effects if effect[3] not in own]
    if not real:
        return ["No discrepancy left a result, so nothing can be said about what dominates."]
    first = real[0]
    sentences = [
        f"The largest error comes from “{first[3]}”: {first[1]:+.3g} % of the {first[2]} modulus"
        f"{first[4]}."
    ]
    following = [e for n, e in enumerate(real[1:]) if n < NEXT or e[0] >= NOTABLE_PERCENT]
    if following:
        shown = listed([f"“{e[3]}” ({e[1]:+.3g} %, {e[2]}{e[4]})" for e in following])
        sentences.append(f"Next come {shown}.")
    alone = [effect for effect in effects if effect[3] in own]
    if alone:
        sentences.append(f"Without any discrepancy the error is {number(alone[0][0])} %.")
    checked = [
        coverage(group, k)
        for what, group in groups.items()
        if what not in own
        for k in range(len(names))
    ]
    checked = [found for found in checked if found.n]
    if checked:
        sentences.append(
            f"The filter's 95 % interval contains the truth in "
            f"{sum(found.inside == found.n for found in checked)} of {len(checked)} moduli under a "
            f"discrepancy."
        )
    return sentences


def _filter(sweep: Sweep, runs: list[Run]) -> list[str]:
    """The best and the cheapest filter under each condition."""
    sentences = []
    for condition, filters in filter_conditions(runs).items():
        entries = []
        for name, group in filters.items():
            good = converged(group)
            errors = [accuracy(group, k).rmse_percent for k in range(len(sweep.parameters))]
            if good and np.isfinite(errors).all():
                solves = spread_of([run.forward_solves for run in good])["mean"]
                entries.append((max(errors), solves, name))
        if not entries:
            continue
        best, cheapest = min(entries), min(entries, key=lambda entry: entry[1])
        where = f" ({condition})" if condition else ""
        sentences.append(
            f"The smallest error{where} is that of “{best[2]}”: {number(best[0])} % (root mean "
            f"square, worst modulus), with {number(best[1])} forward solves."
        )
        if cheapest[2] != best[2]:
            sentences.append(
                f"“{cheapest[2]}” takes the fewest forward solves{where}: "
                f"{number(cheapest[1])}, at an error of {number(cheapest[0])} %."
            )
        if len(entries) > 2:
            worst = max(entries)
            sentences.append(
                f"The largest error{where} is that of “{worst[2]}”: {number(worst[0])} %."
            )
    return sentences


def _anything(sweep: Sweep, runs: list[Run]) -> list[str]:
    worst = _worst(runs)
    kind, needed = sweep.kind, FACTORS.get(sweep.kind)
    missing = sorted(needed[0] - set(factor_names(sweep))) if needed else []
    why = (
        f"This sweep of the kind “{kind}” lacks the factor {listed(missing)} in a job and has"
        if needed and missing
        else f"Sweeps of the kind “{kind}” have"
    )
    sentences = [f"{why} no figures of their own: the table lists every setting."]
    if worst is not None:
        sentences.append(f"The largest error is {number(worst.largest_error)} % ({worst.row}).")
    return sentences
