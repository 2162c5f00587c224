"""Case folders to read, made from the template and a made-up closed frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from mvest.cases.case import Frame, Role, Uncertainty, ValveCase
from mvest.cases.tissue import LeafletBand
from mvest.exchange.surfaces import Surface, write_surface
from mvest.valve.anatomy.dimensions import ChordLayout, TemplateParameters
from mvest.valve.anatomy.template import Template

TIPS = [[16.0, -0.24, -25.0], [-16.0, -0.24, -25.0]]


def closing(x, share=1.0):
    """A smooth motion of every vertex: the annulus shrinks and the leaflets swing inwards."""
    below = np.clip(-x[:, 2:] / 20.0, 0.0, 1.0)
    squeeze = np.array([0.008, 0.064, 0.0]) + below * np.array([0.1, 0.3, 0.1])
    return x * (1.0 - share * squeeze)


def template_case(columns=40, rows=12, branches=3):
    """The template, open, closed and held out, with something of its own in every field.

    Its marginal chordae have so many branches.
    """
    layout = replace(ChordLayout(), branches=branches)
    valve = Template(TemplateParameters(chordae=layout)).valve(columns, rows)
    surface = valve.surface

    def frame(name, time, role, pressure, share, corresponds=True):
        x = surface.vertices if share == 0 else closing(surface.vertices, share)
        tips = valve.papillary_tips + np.array([0.0, share / 3, share])
        loops = x[valve.annulus], x[valve.free_edge]
        shape = x, surface.triangles, surface.region
        return Frame(name, time, role, pressure, *shape, *loops, tips, corresponds)

    return ValveCase(
        name="template",
        description="zwei Segel: offen, zu",
        source="mvest",
        licence="CC0",
        simulated=True,
        surface=surface,
        annulus=valve.annulus,
        free_edge=valve.free_edge,
        frames=(
            frame("open", 0.1, Role.REFERENCE, -1 / 3, 0.0),
            frame("held", 0.3, Role.HELD_OUT, 80.1, 0.7, corresponds=False),
            frame("closed", 0.45, Role.CLOSED, 121.3, 1.0),
        ),
        chordae=valve.chordae,
        uncertainty=Uncertainty(0.9, 7.5),
        derived=("fibre: by a rule",),
    )


def nested(chordae, tips, where=0.4):
    """The template's chordae with a further branching point, at which the first two fans begin.

    ``where`` is its share of the way from the tip to theirs.
    """
    c, j, own = len(chordae.insertion), len(chordae.junction), tips[chordae.tip[0]]
    parent = np.append(chordae.parent, -1)
    parent[[c, c + 1]] = j
    place = own + where * (chordae.junction[:2].mean(axis=0) - own)
    trees = replace(
        chordae,
        tip=np.append(chordae.tip, chordae.tip[0]),
        family=np.append(chordae.family, 1),
        rest_length=np.ones(c + j + 1),
        axial_stiffness=np.append(chordae.axial_stiffness, 60.0),
        junction=np.vstack([chordae.junction, place]),
        parent=parent,
    )
    lengths = np.linalg.norm(np.diff(trees.ends(tips), axis=1)[:, 0], axis=1)
    return replace(trees, rest_length=1.02 * lengths)


def tree_case(columns=40, rows=12):
    """The template's case with `nested` chordae."""
    case = template_case(columns, rows)
    return replace(case, chordae=nested(case.chordae, case.frames[0].papillary_tips))


def plain_folder(folder: Path, columns=24, rows=8):
    """Write the surfaces of an open and a closed frame and a table of chordae; returns case.yaml.

    The chordae run straight to the template's insertions, and are as long as its own are to there.
    The fields are as a user would write them: thickness and fibres are left to be derived.
    """
    chordae = Template().chordae()
    folder.mkdir(exist_ok=True)
    save_frames(folder, columns=columns, rows=rows)
    table = ["tip,x,y,z,family,rest_length_mm,stiffness_n"]
    lengths = chordae.along(chordae.rest_length).tolist()
    for k, length in enumerate(lengths):
        x, y, z = chordae.insertion[k].tolist()
        family = chordae.family_names[chordae.family[k]]
        stiffness = float(chordae.axial_stiffness[k])
        table.append(f"{chordae.tip[k]},{x!r},{y!r},{z!r},{family},{length!r},{stiffness!r}")
    (folder / "chordae.csv").write_text("\n".join(table) + "\n")
    frames = (("open", 0.0, "reference", 0), ("closed", 0.35, "closed", 120.0))
    return {
        "version": 1,
        "name": "plain",
        "units": {"length": "mm"},
        "regions": ["anterior", "posterior"],
        "frames": [
            {
                "name": name, "time": time, "role": role, "surface": f"{name}.vtp",
                "papillary_tips": [list(tip) for tip in TIPS], "pressure": pressure,
            }
            for name, time, role, pressure in frames
        ],
        "chordae": "chordae.csv",
    }  # fmt: skip


def band_of(case, anterior=0):
    """The coordinates of a case or of a valve."""
    surface = case.surface
    parts = surface.vertices, surface.triangles, surface.region
    return LeafletBand.of(*parts, case.annulus, case.free_edge, anterior)


def save_frames(folder: Path, triangles=None, columns=24, rows=8, names=("open", "closed")):
    """Write the surfaces of the template, open and closed, perhaps with other triangles."""
    surface = Template().valve(columns, rows).surface
    shapes = {"open": surface.vertices, "closed": closing(surface.vertices)}
    for name in names:
        faces = surface.triangles if triangles is None else triangles
        save_surface(folder / f"{name}.vtp", shapes[name], faces, surface.region)


def save_surface(file, vertices, triangles, region):
    data = {} if region is None else {"region": region}
    write_surface(file, Surface(vertices, triangles, cell_data=data))


def save(folder: Path, document):
    folder.mkdir(exist_ok=True)
    text = document if isinstance(document, str) else yaml.safe_dump(document, sort_keys=False)
    (folder / "case.yaml").write_text(text, encoding="utf-8")
    return folder
