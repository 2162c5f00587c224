"""Directives whose tables are computed from the code, the configuration and ``results/``.

``{parameter-table}``, ``{setting-groups}``, ``{sweep-list}`` and ``{guess-comparison}`` take no
options and no content.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median

import yaml
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from study_pages import comment_of

from mvest.mechanics.parameters import KINDS

ROOT = Path(__file__).resolve().parents[2]

NOT_SETTINGS = ("experiment", "sweep", "hydra", "launcher", "imaging")
"""Groups of the configuration that other pages are about."""


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def parameter_table() -> str:
    """All kinds of parameters that the mechanics differentiate by."""
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
    return markdown(["name", "what it is", "unit", "positive"], rows)


def setting_groups() -> str:
    """The folders of ``conf/`` with the names that each offers."""
    rows = []
    for folder in sorted((ROOT / "conf").iterdir()):
        names = sorted(path.stem for path in folder.glob("*.yaml")) if folder.is_dir() else []
        if names and folder.name not in NOT_SETTINGS:
            rows.append([f"`{folder.name}=`", ", ".join(f"`{name}`" for name in names)])
    return markdown(["group", "known names"], rows)


def sweep_list() -> str:
    """The sweeps, each with what its file says of it."""
    rows = []
    for path in sorted((ROOT / "conf" / "sweep").glob("*.yaml")):
        about = comment_of(path.read_text(encoding="utf-8"))
        page = (ROOT / "docs" / "studies" / f"sweep_{path.stem}.md").is_file()
        name = f"[`{path.stem}`](studies/sweep_{path.stem}.md)" if page else f"`{path.stem}`"
        rows.append([name, about])
    return markdown(["sweep", "what it does"], rows)


def guess_comparison() -> str:
    """Median errors of estimates, and of guessing the generic moduli for everybody."""
    nuisances = ROOT / "conf" / "personal" / "nuisances.yaml"
    unknowns = yaml.safe_load(nuisances.read_text(encoding="utf-8"))["unknowns"]
    generic = {
        leaflet: float(unknowns[f"E_f.{leaflet}"]["mean"]) for leaflet in ("anterior", "posterior")
    }

    def row(title: str, found: list[tuple[str, float, float]]) -> list[str]:
        """One row; ``found`` are leaflets with their true and estimated modulus."""
        cells = [title]
        for wanted in (("anterior",), ("posterior",), tuple(generic)):
            some = [(name, true, value) for name, true, value in found if name in wanted]
            estimate = median(abs(value / true - 1) for _, true, value in some)
            guess = median(abs(generic[name] / true - 1) for name, true, _ in some)
            cells.append(f"{100 * estimate:.1f} / {100 * guess:.1f}")
        return cells

    drawn = [
        (line["name"].removeprefix("E_f."), float(line["truth"]), float(line["estimate"]))
        for line in read_csv("population")
        if line["name"].startswith("E_f.") and line["estimation"] == "with nuisances"
    ]
    imaged = [
        (line["modulus"], float(line["truth [MPa]"]), float(line["estimate [MPa]"]))
        for line in read_csv("volume")
    ]
    head = ["median size of the error: estimate / generic guess (%)", *generic, "both"]
    rows = [
        row(f"known geometry, {len(drawn) // 2} virtual patients", drawn),
        row(f"simulated volumes, {len(imaged) // 2} virtual patients", imaged),
    ]
    return markdown(head, rows)


def read_csv(name: str) -> list[dict[str, str]]:
    """The rows of a table of ``results/``, its comments left out."""
    lines = (ROOT / "results" / f"{name}.csv").read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def directive(table: Callable[[], str]) -> type[SphinxDirective]:
    """A directive that shows a table."""

    class ComputedTable(SphinxDirective):
        def run(self) -> list[nodes.Node]:
            holder = nodes.container()
            self.state.nested_parse(StringList(table().splitlines()), 0, holder)
            return list(holder.children)

    return ComputedTable


def setup(app: Sphinx) -> dict[str, bool]:
    """Make the directives known."""
    for table in (parameter_table, setting_groups, sweep_list, guess_comparison):
        app.add_directive(table.__name__.replace("_", "-"), directive(table))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
