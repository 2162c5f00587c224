"""Directives for tables computed from code, configuration and ``results/``.

``{parameter-table}``, ``{check-table}``, ``{unknown-table}``, ``{personal-choices}``,
``{setting-groups}``, ``{setting-ranges}``, ``{sweep-list}``, ``{believed-failures}`` and
``{believed-table}`` take no options and no content.
The role ``{result}`` shows one number of the results (see `experiments.results.quoted`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass, replace
from itertools import takewhile
from math import inf
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from docutils import nodes
from docutils.parsers.rst.states import Inliner
from docutils.statemachine import StringList
from omegaconf import OmegaConf
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from experiments.common.config import Config
from experiments.common.schema import hints_of
from experiments.common.study import load_study, study_names
from experiments.results.believed import MODES, believed, missed
from experiments.results.quoted import quoted
from experiments.results.renewal import configured
from mvest.errors import InputError
from mvest.mechanics.parameters import KINDS
from mvest.problem.registration import unit_of
from mvest.problem.verdict import CHECKS
from mvest.quantities import Within

ROOT = Path(__file__).resolve().parents[2]

RESULTS = ROOT / "results"

NOT_SETTINGS = ("experiment", "sweep", "hydra", "launcher", "imaging")
"""Groups of the configuration described on other pages."""


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def parameter_table() -> str:
    """All kinds of parameters that the mechanics can differentiate by."""
    rows = []
    for name, kind in KINDS.items():
        names = [f"`{name}`"] if kind.whole else []
        names += [f"`{name}.{kind.part.value}`"] if kind.part.value else []
        names = [text.replace(" or ", f"`, `{name}.") for text in names]
        rows.append(
            [
                ", ".join(names),
                kind.description,
                kind.unit or "–",
                "yes" if kind.positive else "no",
            ]
        )
    return markdown(["name", "meaning", "unit", "positive"], rows)


def check_table() -> str:
    """All checks of an estimate, with their limits and what to do if one fails."""

    def shown(limit: float) -> str:
        return {0.0: "any", inf: "–"}.get(limit, f"{limit:g}")

    rows = [
        [check.name, check.value, *map(shown, check.limits), check.advice.replace("{what}", "it")]
        for check in CHECKS.values()
    ]
    return markdown(["check", "value", "doubtful above", "none above", "if it fails"], rows)


def unknown_table() -> str:
    """The unknowns of a case with their priors."""
    unknowns = OmegaConf.load(ROOT / "conf/personal/nuisances.yaml").unknowns
    rows = [
        [f"`{name}`", f"{prior.mean:g}", f"{prior.std:g}", unit_of(name) or "–"]
        for name, prior in unknowns.items()
    ]
    return markdown(["unknown", "mean", "standard deviation", "unit"], rows)


def personal_choices() -> str:
    """The files of ``conf/personal`` with the comments at their heads."""
    rows = []
    for path in sorted((ROOT / "conf/personal").glob("*.yaml")):
        lines = path.read_text(encoding="utf-8").splitlines()
        head = takewhile(lambda line: line.startswith("#"), lines)
        rows.append([f"`{path.stem}`", " ".join(line.removeprefix("# ") for line in head)])
    return markdown(["`personal=`", "what it is"], rows)


def setting_groups() -> str:
    """The folders of ``conf/`` with their files."""
    rows = []
    for folder in sorted((ROOT / "conf").iterdir()):
        names = sorted(path.stem for path in folder.glob("*.yaml")) if folder.is_dir() else []
        if names and folder.name not in NOT_SETTINGS:
            rows.append([f"`{folder.name}=`", ", ".join(f"`{name}`" for name in names)])
    return markdown(["group", "known names"], rows)


def setting_ranges() -> str:
    """Ranges of settings, by kind of quantity."""
    found: dict[tuple[str, ...], set[str]] = {}
    studies = map(load_study, study_names())
    for kind, part in [(Config, ""), *((study.settings, study.part) for study in studies)]:
        for key, mark in marks_in(kind, part):
            if not isinstance(mark, Within):
                continue
            row = (f"{mark.low:.10g}", f"{mark.high:.10g}", mark.unit, mark.why)
            found.setdefault(row, set()).add(key.rpartition(".")[2] if "*" not in key else key)
    return markdown(
        ["from", "to", "unit", "reason", "settings"],
        [[*row, ", ".join(f"`{name}`" for name in sorted(names))] for row, names in found.items()],
    )


def marks_in(kind: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names of the settings of a schema with each mark; names within mappings are ``*``."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        kind, *marks = arguments
        yield from ((key, mark) for mark in marks)
        yield from marks_in(kind, key)
    elif isinstance(kind, type) and is_dataclass(kind):
        for name, hint in hints_of(kind).items():
            yield from marks_in(hint, f"{key}.{name}".lstrip("."))
    elif origin in (dict, Mapping):
        yield from marks_in(arguments[1], f"{key}.*")
    else:
        for part in arguments:
            yield from marks_in(part, key)


def sweep_list() -> str:
    """The sweeps with their descriptions."""
    rows = []
    for one in configured(ROOT / "conf" / "sweep"):
        page = (ROOT / "docs" / "studies" / f"{one.name}.md").is_file()
        name = f"[`{one.stem}`](studies/{one.name}.md)" if page else f"`{one.stem}`"
        rows.append([name, one.about])
    return markdown(["sweep", "question"], rows)


def believed_failures() -> str:
    """The modes of use that were not run, then the targets that each other one misses."""
    found = {row["mode"]: missed(row) for row in believed(RESULTS).rows}
    never = [mode.name for mode in MODES if mode.name not in found]
    lines = [f"* **{mode}**: not run with the present estimator" for mode in never]
    lines += [f"* **{mode}**: {'; '.join(texts)}" for mode, texts in found.items() if texts]
    return "\n".join(lines) or "All targets are met."


def believed_table() -> str:
    """How good each mode of use is, worst first; stale rows say so."""
    found, stale = believed(RESULTS), {mode.name for mode in MODES if mode.is_stale(RESULTS)}
    names = [f"{name} (stale)" if name in stale else name for name in found.values["mode"]]
    return replace(found, values={**found.values, "mode": names}).markdown()


def result(
    name: str, raw: str, text: str, line: int, inliner: Inliner, *_: Any
) -> tuple[list[nodes.Node], list[nodes.system_message]]:
    """A number of the results; a wrong source is an error of the build."""
    try:
        return [nodes.Text(quoted(text, RESULTS))], []
    except InputError as error:
        return [], [inliner.reporter.error(str(error), line=line)]


def directive(table: Callable[[], str]) -> type[SphinxDirective]:
    """A directive that shows a table."""

    class ComputedTable(SphinxDirective):
        def run(self) -> list[nodes.Node]:
            holder = nodes.container()
            self.state.nested_parse(StringList(table().splitlines()), 0, holder)
            return list(holder.children)

    return ComputedTable


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_role("result", result)
    for table in (
        parameter_table,
        check_table,
        unknown_table,
        personal_choices,
        setting_groups,
        setting_ranges,
        sweep_list,
        believed_failures,
        believed_table,
    ):
        app.add_directive(table.__name__.replace("_", "-"), directive(table))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
