"""The picture of who imports whom, read from the source whenever the site is built."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterable
from pathlib import Path

from matplotlib.figure import Figure
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]

WIDTH_OF_ROOM = 1.9
INK, PAPER, FILE = "0.25", ("#f4f6f8", "#e3eaf1", "#d0dce8"), "#2f6f9f"
LEAVES = ("errors", "units", "typing", "elements", "provenance", "quantities")


def room_of(module: str) -> str:
    """The room of a module of mvest; importers and exporters of cases are one of their own."""
    _, room, *rest = module.split(".")
    with_cases = room == "exchange" and rest[:1] in (["importing"], ["exporting"])
    return "import, export" if with_cases else room


def imports_of(path: Path) -> Iterable[str]:
    """Rooms of mvest that a module imports from."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        yield from (room_of(name) for name in names if name.startswith("mvest."))


def import_graph() -> dict[str, set[str]]:
    """Room -> rooms that it imports, ``experiments`` as one room."""
    graph: dict[str, set[str]] = {}
    for path in sorted((ROOT / "mvest").glob("*/**/*.py")):
        room = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
        graph.setdefault(room, set()).update(set(imports_of(path)) - {room, *LEAVES})
    used = {name for path in (ROOT / "experiments").rglob("*.py") for name in imports_of(path)}
    graph["experiments"] = used - set(LEAVES)
    return {room: {name for name in names if name in graph} for room, names in graph.items()}


def imports_figure() -> Figure:
    """Rooms in layers, each below all that import it; arrows that others imply are left out."""
    graph = import_graph()
    users = {room: {one for one, names in graph.items() if room in names} for room in graph}
    level: dict[str, int] = {}

    def depth(room: str) -> int:
        if room not in level:
            level[room] = 1 + max((depth(name) for name in users[room]), default=-1)
        return level[room]

    def reach(room: str) -> set[str]:
        return graph[room].union(*(reach(name) for name in graph[room]))

    arrows = {
        room: names - set().union(*(reach(name) for name in names)) for room, names in graph.items()
    }
    layers: dict[int, list[str]] = {}
    for room in graph:
        layers.setdefault(depth(room), []).append(room)
    figure = Figure(figsize=(8.6, 0.92 * len(layers) + 0.2), layout="constrained")
    axes = figure.subplots()
    place: dict[str, tuple[float, float]] = {}
    for height, rooms in sorted(layers.items()):
        # Under the middle of those that import it; side by side where that is the same place.
        above = {room: [place[u][0] for u in users[room] if room in arrows[u]] for room in rooms}
        wanted = {room: sum(xs) / max(len(xs), 1) for room, xs in above.items()}
        order = sorted(rooms, key=lambda room: (wanted[room], room))
        x = -math.inf
        for room in order:
            x = max(x + WIDTH_OF_ROOM, wanted[room])
            place[room] = (x, -float(height))
        middle = sum(place[room][0] - wanted[room] for room in order) / len(order)
        for room in order:
            place[room] = (place[room][0] - middle, place[room][1])
    boxes = {
        room: axes.text(
            x, y, room, ha="center", va="center", fontsize=9, color=INK, zorder=3,
            bbox={"boxstyle": "round,pad=0.45", "facecolor": PAPER[1], "edgecolor": FILE},
        ).get_bbox_patch()
        for room, (x, y) in place.items()
    }  # fmt: skip
    for room, names in arrows.items():
        for name in sorted(names):
            shape = {"patchA": boxes[room], "patchB": boxes[name], "shrinkA": 0, "shrinkB": 2}
            look = {"arrowstyle": "-|>", "color": "0.55", "linewidth": 0.9}
            axes.annotate("", place[name], place[room], arrowprops={**shape, **look}, zorder=1)
    xs = [x for x, _ in place.values()]
    axes.set(xlim=(min(xs) - 1, max(xs) + 1), ylim=(0.5 - len(layers), 0.5))
    axes.set_axis_off()
    return figure


def setup(app: Sphinx) -> dict[str, bool]:
    """Draw it before Sphinx looks for its sources."""
    folder = Path(app.srcdir) / "pictures"
    folder.mkdir(exist_ok=True)
    figure = imports_figure()
    figure.savefig(folder / "imports.svg", metadata={"Date": None})
    figure.savefig(folder / "imports.png", dpi=110)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
