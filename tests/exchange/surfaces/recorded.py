"""A made-up closure in the form of Texas TriValve: an Abaqus deck and its frames."""

from pathlib import Path

import meshio
import numpy as np

REGIONS = ("anterior", "septal", "posterior")
NAMES = {
    "leaflets": {name: f"{name}_Quads" for name in REGIONS},
    "annulus": "Rim",
    "free_edge": "free_edge",
}
ROUND, DOWN = 48, 6
CASE = "Skirt"

OGDEN = {
    "anterior": (0.35, "18.884147787615671, 98.2536, 22.682992, 98.251894, 19.502933, 98.2532"),
    "septal": (0.27, "33.7534784879460, 0.0001531, 0.0000146, 0.000348, 0.0203, 113.44738"),
    "posterior": (0.33, "4.2415539, 55.914887, 2.724796, 55.915477, 0.0000372, 70.71507"),
}
"""Cross section and pairs of each leaflet's chordae."""


def skirt(tips_mm: float = 0.0) -> dict:
    """A cylindrical skirt of 48 x 6 quads that hangs from a circle, with three chord trees.

    Four frames at equal times, so the smooth step passes 0, 17/81, 64/81 and 1. The rim narrows by
    a tenth; the tips move down by ``tips_mm`` until half of the time.
    """
    angle = np.arange(ROUND) * 2 * np.pi / ROUND
    rings = [
        np.column_stack([10 * np.cos(angle), 10 * np.sin(angle), np.full(ROUND, -1.5 * k)])
        for k in range(DOWN + 1)
    ]
    leaflet = np.concatenate(rings)
    i, k = np.meshgrid(np.arange(ROUND), np.arange(DOWN), indexing="ij")
    a, b = (i + ROUND * k).ravel(), ((i + 1) % ROUND + ROUND * k).ravel()
    quads = np.column_stack([b, a, a + ROUND, b + ROUND])  # normals outwards, to the ventricle
    leaflet_of = np.searchsorted([16, 32], i.ravel(), side="right")
    n = len(leaflet)
    chord_nodes, edges, anchors = [], [], []
    for tree in range(3):
        first = n + len(chord_nodes)
        at = leaflet[n - ROUND + 16 * tree]
        # Anchor, a branching point straight above it, and two branches to the free edge.
        chord_nodes += [at * [0.5, 0.5, 0] - [0, 0, 20.0], at * [0.5, 0.5, 0] - [0, 0, 15.0]]
        edges += [[first, first + 1], [first + 1, n - ROUND + 16 * tree]]
        edges += [[first + 1, n - ROUND + 16 * tree + 1]]
        anchors.append(first)
    nodes = np.vstack([leaflet, chord_nodes])
    rim = np.arange(ROUND)
    constrained = np.concatenate([rim, anchors])
    displacement = np.zeros((len(constrained), 3))
    displacement[:ROUND] = -0.1 * leaflet[:ROUND]
    displacement[ROUND:, 2] = -tips_mm
    phase = np.array([0, 17 / 81, 64 / 81, 1])
    frames = np.repeat(nodes[None], 4, axis=0)
    frames[:, rim] += phase[:, None, None] * displacement[:ROUND]
    early = np.array([0, 64 / 81, 1, 1])
    frames[:, anchors] += early[:, None, None] * displacement[ROUND:]
    return {
        "nodes": nodes,
        "quads": {name: quads[leaflet_of == r] for r, name in enumerate(REGIONS)},
        "edges": np.array(edges),
        "rim": rim,
        "free_edge": np.arange(n - ROUND, n),
        "held": constrained,
        "displacement": displacement,
        "frames": frames,
        "pressure": -0.00133322,
    }


def write(folder: Path, data: dict) -> Path:
    """The case in a folder; returns the deck."""
    place = folder / CASE
    place.mkdir(exist_ok=True)
    (place / f"{CASE}.inp").write_text(deck(data))
    cells = np.concatenate(list(data["quads"].values()))
    for k, points in enumerate(data["frames"]):
        mesh = meshio.Mesh(points, [("quad", cells)])
        meshio.vtu.write(place / f"{CASE}_{k}.vtu", mesh, binary=False)
    return place / f"{CASE}.inp"


def deck(data: dict) -> str:
    """The text of the input deck."""
    lines = ["** made up", "*Part, name=Leaflet", "*Node, nset=all"]
    lines += [f"{k + 1}, {x!r}, {y!r}, {z!r}" for k, (x, y, z) in enumerate(data["nodes"].tolist())]
    label, sections = 1, []
    for name, quads in data["quads"].items():
        lines.append(f"*ELEMENT, TYPE=S4R, ELSET={name}_Quads")
        lines += [f"{label + k},{row[0]},{row[1]},{row[2]},{row[3]}" for k, row in
                  enumerate((quads + 1).tolist())]  # fmt: skip
        label += len(quads)
        sections += [f"*Shell Section, elset={name}_Quads, material={name}", ".65, 5"]
    for k, name in enumerate(REGIONS):
        lines.append(f"*Element, type=T3D2, elset={name}_Chordae")
        # One tree in each leaflet's material.
        for a, b in (data["edges"][3 * k : 3 * k + 3] + 1).tolist():
            lines.append(f"{label}, {a}, {b} ")
            label += 1
        sections += [f"*Solid Section, elset={name}_Chordae, material={name}_Chordae"]
        sections += [f"{OGDEN[name][0]!r},"]
    lines += ["*Nset, nset=Rim", *(f"{k + 1}," for k in data["rim"].tolist())]
    lines += ["*Nset, nset=free_edge", *(f"{k + 1}," for k in data["free_edge"].tolist())]
    lines += ["*Elset, elset=Both", "anterior_Quads, septal_Quads", *sections, "*End Part"]
    lines += ["*Assembly, name=Assembly", "*Instance, name=Valve, part=Leaflet", "*End Instance"]
    lines += ["*Surface, type=ELEMENT, name=Outside", "Valve.Both, SPOS"]
    lines += ["Valve.posterior_Quads, SPOS", "*End Assembly"]
    lines += ["*Amplitude, name=Whole, definition=SMOOTH STEP", "0., 0., 1., 1."]
    lines += ["*Amplitude, name=Early, definition=SMOOTH STEP", "0., 0., 0.5, 1."]
    for name in REGIONS:
        lines += [f"*Material, name={name}_Chordae", "*Density", "1e-9"]
        lines += ["*Hyperelastic, OGDEN, N=3", f"{OGDEN[name][1]}, 1e-5, 0", "0.,"]
    lines += ['*Step, name="Closure of it", nlgeom=YES', "*Dynamic, Explicit", ", 1."]
    for node, vector in zip(data["held"].tolist(), data["displacement"].tolist(), strict=True):
        pace = "Whole" if node in data["rim"] else "Early"
        lines.append(f"*Boundary, op=NEW, amplitude={pace}")
        lines += [f"Valve.{node + 1}, {k + 1}, {k + 1}, {value!r}" for k, value in
                  enumerate(vector)]  # fmt: skip
    lines += ["*Dsload, op=NEW, amplitude=Whole", f"Outside, P, {data['pressure']!r}"]
    return "\n".join([*lines, "*End Step", ""])
