"""What follows from a sweep, in sentences that are computed from its numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from mvest.reporting.markup import number
from mvest.reporting.sweep_rows import (
    FACTORS,
    Run,
    Sweep,
    factor_names,
    factor_text,
    kind_of,
    runs_of,
    short_names,
)
from mvest.reporting.sweep_statistics import (
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

__all__ = ["conclusions", "question"]

QUESTIONS = {
    "initial_guess": "From which initial guesses does the filter find the true moduli?",
    "covariance": "How much do the prior's, the process's and the observation's covariance matter?",
    "noise": "How large is the error under noise, and can the reported intervals be trusted?",
    "discrepancy": "What does an estimate cost when the truth is not the filter's own model?",
    "filter": "Which filter finds the moduli, how well, and with how many forward solves?",
}
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
    counts = Counter(run.reason for run in lost)
    reasons = "; ".join(f"{n} × {reason}" for reason, n in counts.most_common())
    whole = sum(run.seed is None for run in lost)
    jobs = f" ({_count(whole, 'job')} left no result at all)" if whole else ""
    return [f"{len(lost)} of {len(runs)} runs failed{jobs}: {reasons}."]


def _count(n: int, what: str) -> str:
    return f"{n} {what}" + ("" if n == 1 else "s")


def _listed(items: Sequence[str]) -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"


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
                short_names(sweep["parameters"]), starts.min(0), starts.max(0), strict=True
            )
        ]
        sentences.append(f"The starts range over {_listed(ranges)}.")
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
    effects = []
    for (varied, mode), group in grouped(runs, ["varied", "filter"]).items():
        good = [run for run in converged(group) if np.isfinite(run.largest_error)]
        if not good:
            continue
        errors = [run.largest_error for run in good]
        scales = [float(run.factors["scale"]) for run in good]
        std = np.array([run.std for run in good])
        growth = float(np.max(std.max(axis=0) / std.min(axis=0)))
        what = "P0, Q and R together" if varied == "all" else str(varied)
        effects.append((max(errors), min(errors), growth, min(scales), max(scales), what, mode))
    if not effects:
        return []
    effects.sort(key=lambda effect: -effect[0])
    most, least, _, low, high, varied, mode = effects[0]
    sentences = [
        f"The error depends most on {varied}: scaled from {low:g} to {high:g} times in the {mode} "
        f"mode, the largest error of a modulus lies between {number(least)} and {number(most)} %."
    ]
    quiet = [f"{e[5]} ({e[6]} mode)" for e in effects if e[0] <= BASIN_PERCENT]
    if quiet:
        sentences.append(
            f"The error stays within {BASIN_PERCENT:g} % at every scale tried of {_listed(quiet)}."
        )
    grown = max(effects, key=lambda effect: effect[2])
    sentences.append(
        f"The reported standard deviation depends most on {grown[5]} ({grown[6]} mode): it changes "
        f"by a factor of {number(grown[2])}."
    )
    return sentences


def _noise(sweep: Sweep, runs: list[Run]) -> list[str]:
    names = short_names(sweep["parameters"])
    ratios: list[tuple[float, str]] = []
    verdicts: Counter[str] = Counter()
    worst_coverage: list[tuple[float, str]] = []
    for (kind, level), group in grouped(runs, ["kind", "noise_mm"]).items():
        if not level:
            continue  # Without noise there is nothing that an interval should cover.
        for k, name in enumerate(names):
            where = f"{factor_text(kind)} noise of {factor_text(level)} mm, {name}"
            found, covered = accuracy(group, k), coverage(group, k)
            if np.isfinite(found.ratio):
                ratios.append((found.ratio, where))
            if covered.n:
                verdicts[verdict(covered)] += 1
                worst_coverage.append((covered.share, where))
    sentences = []
    if ratios:
        near = sum(ratio <= BOUND_FACTOR for ratio, _ in ratios)
        largest = max(ratios)
        sentences.append(
            f"The root mean square error is within {BOUND_FACTOR:g} times the Cramér–Rao bound in "
            f"{near} of {len(ratios)} combinations of noise, level and parameter; the largest "
            f"ratio is {number(largest[0])} ({largest[1]})."
        )
    if worst_coverage:
        low, high = COVERAGE_RANGE
        least = min(worst_coverage)
        sentences.append(
            f"The nominal 95 % interval covers the truth in {100 * low:.0f}–{100 * high:.0f} % of "
            f"the runs in {verdicts['yes']} of {len(worst_coverage)} combinations, in "
            f"{verdicts['no']} it does not, in {verdicts['too few runs to tell']} there are too "
            f"few runs to tell; the smallest coverage is {100 * least[0]:.0f} % ({least[1]})."
        )
    for (kind,), group in grouped(runs, ["kind"]).items():
        if not (noisy := [run for run in group if run.factors.get("noise_mm")]):
            continue
        level = max(run.factors["noise_mm"] for run in noisy)
        top = [run for run in noisy if run.factors["noise_mm"] == level]
        errors = [
            f"{number(accuracy(top, k).rmse_percent, 2)} % ({name})" for k, name in enumerate(names)
        ]
        if converged(top):
            sentences.append(
                f"At {factor_text(level)} mm of {factor_text(kind)} noise the root mean square "
                f"error is {_listed(errors)}."
            )
    return sentences


def _discrepancy(sweep: Sweep, runs: list[Run]) -> list[str]:
    names = short_names(sweep["parameters"])
    effects = []
    for (what,), group in grouped(runs, ["discrepancy"]).items():
        found = [accuracy(group, k) for k in range(len(names))]
        if found[0].n and np.isfinite([f.bias_percent for f in found]).all():
            k = int(np.argmax([abs(f.bias_percent) for f in found]))
            effects.append((abs(found[k].bias_percent), found[k].bias_percent, names[k], what))
    effects.sort(key=lambda effect: -effect[0])
    real = [effect for effect in effects if effect[3] != "none"]
    if not real:
        return ["No discrepancy left a result, so nothing can be said about what dominates."]
    first = real[0]
    sentences = [
        f"The largest error comes from “{first[3]}”: {first[1]:+.3g} % of the {first[2]} modulus."
    ]
    if len(real) > 1:
        following = _listed([f"“{e[3]}” ({e[1]:+.3g} %, {e[2]})" for e in real[1:4]])
        sentences.append(f"Next come {following}.")
    alone = [effect for effect in effects if effect[3] == "none"]
    if alone:
        sentences.append(f"Without any discrepancy the error is {number(alone[0][0])} %.")
    checked = [
        coverage(group, k)
        for (what,), group in grouped(runs, ["discrepancy"]).items()
        if what != "none"
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
    entries = []
    for (name,), group in grouped(runs, ["filter"]).items():
        good = converged(group)
        errors = [accuracy(group, k).rmse_percent for k in range(len(sweep["parameters"]))]
        if good and np.isfinite(errors).all():
            solves = spread_of([run.forward_solves for run in good])["mean"]
            entries.append((max(errors), solves, factor_text(name)))
    if not entries:
        return []
    best, least = min(entries), min(entries, key=lambda entry: entry[1])
    sentences = [
        f"The smallest error is that of “{best[2]}”: {number(best[0])} % (root mean square, worst "
        f"modulus), with {number(best[1])} forward solves."
    ]
    if least[2] != best[2]:
        sentences.append(
            f"“{least[2]}” takes the fewest forward solves ({number(least[1])}), at an error of "
            f"{number(least[0])} %."
        )
    worst = max(entries)
    if len(entries) > 2:
        sentences.append(f"The largest error is that of “{worst[2]}”: {number(worst[0])} %.")
    return sentences


def _anything(sweep: Sweep, runs: list[Run]) -> list[str]:
    worst = _worst(runs)
    kind, needed = sweep["sweep"]["kind"], FACTORS.get(str(sweep["sweep"]["kind"]))
    missing = sorted((needed or set()) - set(factor_names(sweep)))
    why = (
        f"This sweep of the kind “{kind}” lacks the factor {_listed(missing)} in a job and has"
        if needed and missing
        else f"Sweeps of the kind “{kind}” have"
    )
    sentences = [f"{why} no figures of their own: the table lists every setting."]
    if worst is not None:
        sentences.append(f"The largest error is {number(worst.largest_error)} % ({worst.row}).")
    return sentences
