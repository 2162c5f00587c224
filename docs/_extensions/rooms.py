"""Pictures of the rooms: the earlier layout beside the present one, and who imports whom.

The present layout and the imports are read from the source whenever the site is built; the earlier
one is a list, since a checkout need not have its history.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]

EARLIER = {
    "mvest": {
        "": 17, "cases": 18, "cycle": 4, "estimation": 26, "external": 5, "imaged_case": 4,
        "imaged_valve": 3, "imaging": 7, "imaging/detection": 24, "imaging/reading": 12,
        "imaging/simulator": 12, "imaging/writing": 5, "mechanics": 23, "personalise": 6,
        "prediction": 6, "reporting": 53, "sheet": 5, "simulated_motion": 6, "valve": 32,
    },
    "experiments": {"": 55},
}  # fmt: skip
"""Modules in each folder at commit 3885179, before the rooms."""

SQUARE, GAP, LABEL, CHARACTER = 1.0, 0.25, 1.9, 0.98
SHELF = 46.0
WIDTH_OF_ROOM = 1.9
INK, PAPER, FILE = "0.25", ("#f4f6f8", "#e3eaf1", "#d0dce8"), "#2f6f9f"
LEAVES = ("errors", "units", "typing", "elements", "provenance")


@dataclass
class Room:
    """A folder: how many modules lie in it, and the folders in it."""

    name: str
    files: int = 0
    rooms: list[Room] = field(default_factory=list)
    size: tuple[float, float] = (0.0, 0.0)
    places: list[tuple[float, float]] = field(default_factory=list)
    columns: int = 1

    def lay_out(self, shelf: float) -> None:
        """Find the size of the folder and the places of those in it, row after row."""
        for room in self.rooms:
            room.lay_out(shelf)
        step = SQUARE + GAP
        wide = self.files if self.files <= 7 else math.ceil(math.sqrt(2.5 * self.files))
        self.columns = max(1, wide)
        own_rows = math.ceil(self.files / self.columns)
        width = max(self.columns * step if self.files else 0.0, CHARACTER * len(self.name))
        y = LABEL + own_rows * step
        x, row = 0.0, 0.0
        self.places = []
        for room in self.rooms:
            if x and x + room.size[0] > shelf:
                x, y, row = 0.0, y + row + 2 * GAP, 0.0
            self.places.append((x, y))
            x += room.size[0] + 2 * GAP
            row = max(row, room.size[1])
            width = max(width, x - 2 * GAP)
        self.size = (width + 3 * GAP, y + row + 2 * GAP)

    def draw(self, axes: Axes, x: float, y: float, depth: int) -> None:
        """Draw the folder with its upper left corner at (x, y)."""
        width, height = self.size
        paper = PAPER[min(depth, len(PAPER) - 1)]
        axes.add_patch(
            FancyBboxPatch(
                (x, y), width, height, "round,pad=0,rounding_size=0.5",
                facecolor=paper, edgecolor=INK, linewidth=0.5,
            )
        )  # fmt: skip
        weight = "bold" if depth == 0 else "normal"
        axes.text(x + GAP, y + 0.35, self.name, va="top", fontsize=6.2, weight=weight, color=INK)
        step = SQUARE + GAP
        for k in range(self.files):
            corner = (
                x + 1.5 * GAP + step * (k % self.columns),
                y + LABEL + step * (k // self.columns),
            )
            axes.add_patch(Rectangle(corner, SQUARE, SQUARE, facecolor=FILE, linewidth=0))
        for room, (left, top) in zip(self.rooms, self.places, strict=True):
            room.draw(axes, x + 1.5 * GAP + left, y + top, depth + 1)


def room_of(name: str, counts: dict[str, int]) -> Room:
    """A folder from the modules in each of its folders, by their paths."""
    root = Room(name)
    for path, count in sorted(counts.items()):
        room = root
        for part in filter(None, path.split("/")):
            inner = next((one for one in room.rooms if one.name == part), None)
            if inner is None:
                inner = Room(part)
                room.rooms.append(inner)
            room = inner
        room.files = count
    return root


def present(package: str) -> dict[str, int]:
    """Modules in each folder of a package, as they are; files that only mark a folder left out."""
    counts: dict[str, int] = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        folder = path.parent.relative_to(ROOT / package).as_posix()
        marks = path.name == "__init__.py" and len(path.read_text(encoding="utf-8")) < 200
        folder = "" if folder == "." else folder
        counts[folder] = counts.get(folder, 0) + (not marks)
    return counts


def layouts_figure() -> Figure:
    """The earlier layout above the present one."""
    now = {package: present(package) for package in EARLIER}
    figure = Figure(figsize=(9.6, 9.6), layout="constrained")
    heights, drawn = [], []
    for title, packages in (("Earlier: commit 3885179", EARLIER), ("Now", now)):
        rooms = [room_of(name, counts) for name, counts in packages.items()]
        for room in rooms:
            room.lay_out(SHELF)
        drawn.append((title, rooms))
        heights.append(max(room.size[1] for room in rooms))
    parts = figure.subplots(2, 1, height_ratios=heights)
    widest = max(sum(room.size[0] + 2 for room in rooms) for _, rooms in drawn)
    for axes, (title, rooms), height in zip(parts, drawn, heights, strict=True):
        x = 0.0
        for room in rooms:
            room.draw(axes, x, 0.0, 0)
            x += room.size[0] + 2
        axes.set(xlim=(-0.5, widest), ylim=(height + 0.5, -0.5), aspect="equal")
        axes.set_axis_off()
        count = sum(sum(counts.values()) for counts in (EARLIER, now)[title == "Now"].values())
        axes.set_title(f"{title}: {count} modules", loc="left", fontsize=9, weight="bold")
    return figure


def imports_of(path: Path) -> Iterable[str]:
    """Rooms of mvest that a module imports from."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("mvest."):
            yield node.module.split(".")[1]
        if isinstance(node, ast.Import):
            yield from (a.name.split(".")[1] for a in node.names if a.name.startswith("mvest."))


def import_graph() -> dict[str, set[str]]:
    """Room -> rooms that it imports, ``experiments`` as one room."""
    graph: dict[str, set[str]] = {}
    for folder in sorted((ROOT / "mvest").iterdir()):
        if (folder / "__init__.py").is_file():
            found = {name for path in folder.rglob("*.py") for name in imports_of(path)}
            graph[folder.name] = found - {folder.name, *LEAVES}
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
    """Draw both before Sphinx looks for its sources."""
    folder = Path(app.srcdir) / "pictures"
    folder.mkdir(exist_ok=True)
    for name, figure in (("layouts", layouts_figure()), ("imports", imports_figure())):
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        figure.savefig(folder / f"{name}.png", dpi=110)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
