"""The import graph of the packages, read from the source when the site is built."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterable
from pathlib import Path

from matplotlib.figure import Figure
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]

WIDTH_OF_PACKAGE = 1.9
INK, PAPER, FILE = "0.25", ("#f4f6f8", "#e3eaf1", "#d0dce8"), "#2f6f9f"
LEAVES = ("errors", "units", "typing", "elements", "provenance", "quantities")


def package_of(module: str) -> str:
    """The package of a module of mvest; importers and exporters of cases count as one."""
    _, package, *rest = module.split(".")
    with_cases = package == "exchange" and rest[:1] in (["importing"], ["exporting"])
    return "import, export" if with_cases else package


def imports_of(path: Path) -> Iterable[str]:
    """Packages of mvest that a module imports from."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        yield from (package_of(name) for name in names if name.startswith("mvest."))


def import_graph() -> dict[str, set[str]]:
    """Package -> packages that it imports, ``experiments`` as one package."""
    graph: dict[str, set[str]] = {}
    for path in sorted((ROOT / "mvest").glob("*/**/*.py")):
        package = package_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
        graph.setdefault(package, set()).update(set(imports_of(path)) - {package, *LEAVES})
    used = {name for path in (ROOT / "experiments").rglob("*.py") for name in imports_of(path)}
    graph["experiments"] = used - set(LEAVES)
    return {package: {name for name in names if name in graph} for package, names in graph.items()}


def imports_figure() -> Figure:
    """Packages in layers, each below all that import it, without implied arrows."""
    graph = import_graph()
    users = {
        package: {one for one, names in graph.items() if package in names} for package in graph
    }
    level: dict[str, int] = {}

    def depth(package: str) -> int:
        if package not in level:
            level[package] = 1 + max((depth(name) for name in users[package]), default=-1)
        return level[package]

    def reach(package: str) -> set[str]:
        return graph[package].union(*(reach(name) for name in graph[package]))

    arrows = {
        package: names - set().union(*(reach(name) for name in names))
        for package, names in graph.items()
    }
    layers: dict[int, list[str]] = {}
    for package in graph:
        layers.setdefault(depth(package), []).append(package)
    figure = Figure(figsize=(8.6, 0.92 * len(layers) + 0.2), layout="constrained")
    axes = figure.subplots()
    place: dict[str, tuple[float, float]] = {}
    for height, packages in sorted(layers.items()):
        # Centred below its importers; side by side if positions coincide.
        above = {
            package: [place[u][0] for u in users[package] if package in arrows[u]]
            for package in packages
        }
        wanted = {package: sum(xs) / max(len(xs), 1) for package, xs in above.items()}
        order = sorted(packages, key=lambda package: (wanted[package], package))
        x = -math.inf
        for package in order:
            x = max(x + WIDTH_OF_PACKAGE, wanted[package])
            place[package] = (x, -float(height))
        middle = sum(place[package][0] - wanted[package] for package in order) / len(order)
        for package in order:
            place[package] = (place[package][0] - middle, place[package][1])
    boxes = {
        package: axes.text(
            x, y, package, ha="center", va="center", fontsize=9, color=INK, zorder=3,
            bbox={"boxstyle": "round,pad=0.45", "facecolor": PAPER[1], "edgecolor": FILE},
        ).get_bbox_patch()
        for package, (x, y) in place.items()
    }  # fmt: skip
    for package, names in arrows.items():
        for name in sorted(names):
            shape = {"patchA": boxes[package], "patchB": boxes[name], "shrinkA": 0, "shrinkB": 2}
            look = {"arrowstyle": "-|>", "color": "0.55", "linewidth": 0.9}
            axes.annotate("", place[name], place[package], arrowprops={**shape, **look}, zorder=1)
    xs = [x for x, _ in place.values()]
    axes.set(xlim=(min(xs) - 1, max(xs) + 1), ylim=(0.5 - len(layers), 0.5))
    axes.set_axis_off()
    return figure


def setup(app: Sphinx) -> dict[str, bool]:
    """Draw it before Sphinx reads its sources."""
    folder = Path(app.srcdir) / "pictures"
    folder.mkdir(exist_ok=True)
    figure = imports_figure()
    figure.savefig(folder / "imports.svg", metadata={"Date": None})
    figure.savefig(folder / "imports.png", dpi=110)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
