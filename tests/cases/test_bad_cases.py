"""Whatever is wrong with a case is one clear error: the file, the field, and what would be right.

Every row breaks one thing of a folder that is otherwise in order.
"""

import copy
import os
import shutil

import numpy as np
import pytest

from mvest.cases.folder import read_case
from mvest.cases.schema import files_of_case
from mvest.errors import GeometryError, InputError
from mvest.exchange.surfaces import read_surface
from tests.cases.folders import plain_folder, save, save_surface


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    return folder, plain_folder(folder)


@pytest.fixture
def bad(plain, tmp_path):
    """A fresh copy of the folder and its document, to be broken."""
    folder, document = plain
    shutil.copytree(folder, tmp_path / "case")
    return tmp_path / "case", copy.deepcopy(document)


def test_the_folder_is_in_order_before_it_is_broken(bad):
    folder, document = bad
    read_case(save(folder, document))
    # A hundred-thousandth of the diagonal (45 mm) is 0.00045 mm.
    seam(0.0002)(folder, document)
    assert len(read_case(save(folder, document)).surface.vertices) == 192


# --- ways to break it ---------------------------------------------------------------------------


DROPPED = object()


def put(*path_and_value):
    """Set a field of the document, or drop it."""
    *path, last, value = path_and_value

    def change(folder, document):
        for key in path:
            document = document[key]
        if value is DROPPED:
            del document[last]
        else:
            document[last] = value

    return change


def drop(*path):
    return put(*path, DROPPED)


def both(*changes):
    def change(folder, document):
        for one in changes:
            one(folder, document)

    return change


def surface(edit, name="open"):
    """Replace a surface by what ``edit`` makes of its vertices, triangles and labels."""

    def change(folder, document):
        file = folder / f"{name}.vtp"
        old = read_surface(file)
        save_surface(file, *edit(old.vertices.copy(), old.triangles.copy(), region_of(old)))

    return change


def region_of(old):
    return old.cell_data["region"].copy()


def surfaces(edit):
    return both(surface(edit), surface(edit, "closed"))


def cell(row, column, value):
    """Set one cell of chordae.csv."""

    def change(folder, document):
        lines = (folder / "chordae.csv").read_text().splitlines()
        cells = lines[row + 1].split(",")
        cells[lines[0].split(",").index(column)] = value
        lines[row + 1] = ",".join(cells)
        (folder / "chordae.csv").write_text("\n".join(lines))

    return change


def text(content, name="case.yaml"):
    def change(folder, document):
        if name == "case.yaml":
            document.clear()
            document["text"] = content
        else:
            (folder / name).write_text(content)

    return change


def scaled(factor):
    def change(folder, document):
        surfaces(lambda x, t, r: (x * factor, t, r))(folder, document)
        for entry in document["frames"]:
            entry["papillary_tips"] = [[v * factor for v in p] for p in entry["papillary_tips"]]

    return change


def without(*numbers):
    return lambda x, t, r: (x, np.delete(t, numbers, axis=0), np.delete(r, numbers))


def hole(x, t, r):
    """All triangles round one vertex in the middle of the leaflets are gone; and the vertex."""
    gone = (t == 84).any(axis=1)
    t = t[~gone]
    return np.delete(x, 84, axis=0), t - (t > 84), r[~gone]


def cut(x, t, r):
    """A cut from the annulus to the free edge."""
    column = t % 24
    gap = (column == 3).any(axis=1) & (column == 4).any(axis=1)
    return without(*np.flatnonzero(gap))(x, t, r)


def lid(x, t, r):
    """The orifice is closed by triangles."""
    edge = np.arange(168, 192)
    more = np.column_stack([np.full(24, 192), np.roll(edge, -1), edge])
    return np.vstack([x, x[-24:].mean(axis=0)]), np.vstack([t, more]), np.append(r, [0, 1] * 12)


def handle(x, t, r):
    """A tube from one triangle to another, both of which are taken away."""
    a, b = t[60], t[75][[0, 2, 1]]
    tube = [
        corners
        for i, j in ((0, 1), (1, 2), (2, 0))
        for corners in ([a[i], a[j], b[i]], [a[j], b[j], b[i]])
    ]
    x, t, r = without(60, 75)(x, t, r)
    return x, np.vstack([t, tube]), np.append(r, [0] * 6)


def seam(gap):
    """One STL for each leaflet, those of the second moved by a gap (mm)."""

    def change(folder, document):
        for entry in document["frames"]:
            old = read_surface(folder / entry["surface"])
            files = {n: f"{entry['name']}_{n}.vtp" for n in document["regions"]}
            for number, file in enumerate(files.values()):
                moved = old.vertices + np.array([0.0, 0.0, gap * number])
                save_surface(folder / file, moved, old.triangles[region_of(old) == number], None)
            entry["surface"] = files

    return change


def labels_as_text(content):
    """The labels of the reference surface are replaced by some text."""

    def change(folder, document):
        text = (folder / "open.vtp").read_text()
        start = text.rindex("<", 0, text.index('Name="region"'))
        end = text.index("</DataArray>", start)
        array = f'<DataArray type="Float64" Name="region" format="ascii">{content}'
        (folder / "open.vtp").write_text(text[:start] + array + text[end:])

    return change


def torn(x, t, r):
    """Each leaflet with vertices of its own, those of the seams twice."""
    used, t = np.unique(np.where(r[:, None] == 1, t + len(x), t), return_inverse=True)
    return np.vstack([x, x])[used], t.reshape(-1, 3), r


def turned(some):
    def edit(x, t, r):
        t[some] = t[some][:, ::-1]
        return x, t, r

    return edit


def fin(x, t, r):
    """A third triangle on an edge."""
    x = np.vstack([x, x[84] + [0.0, 0.0, 3.0]])
    return x, np.vstack([t, [84, 85, len(x) - 1]]), np.append(r, 0)


def crossed(x, t, r):
    """One vertex of a leaflet is pushed through the other side of the valve."""
    x[156] += 1.3 * (x[168] - x[156]) + np.array([0.0, 0.0, 0.1])
    return x, t, r


def labelled(value, some=slice(0, 3)):
    def edit(x, t, r):
        r = r.astype(float)
        r[some] = value
        return x, t, r

    return edit


def not_a_number(name):
    def change(folder, document):
        file = folder / f"{name}.obj"
        old = read_surface(folder / f"{name}.vtp")
        rows = [f"v {a} {b} {c}" for a, b, c in old.vertices]
        rows[7] = "v 1 nan 2"
        rows += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in old.triangles]
        file.write_text("\n".join(rows))
        document["frames"][0 if name == "open" else 1]["surface"] = file.name

    return change


def frame(number, role, time):
    """One more frame, like the closed one."""

    def change(folder, document):
        more = dict(
            copy.deepcopy(document["frames"][1]), name=f"more {number}", role=role, time=time
        )
        document["frames"].insert(number, more)

    return change


def link_out(folder, document):
    secret = folder.parent / "elsewhere.vtp"
    shutil.copy(folder / "open.vtp", secret)
    (folder / "link.vtp").symlink_to(secret)
    document["frames"][0]["surface"] = "link.vtp"


def tip_table(folder, document):
    (folder / "loop.csv").write_text("x,y,z\n1,2,3\n4,5,6\n7,8,9\n")
    document["frames"][1]["annulus"] = "loop.csv"


OPEN, CLOSED = "frames.0.surface", "frames.1.surface"
I, G = InputError, GeometryError

CASES = {
    # The surface.
    "hole": (surfaces(hole), G, OPEN, r"3 boundary loops .*6 vertices.*close the 1 holes"),
    "cut open": (surfaces(cut), G, OPEN, r"1 boundary loops .*expected two.*open it along"),
    "disc": (surfaces(lid), G, OPEN, r"1 boundary loops .*24 vertices.*expected two"),
    "self-intersecting": (surfaces(crossed), G, OPEN, "self-intersection: triangles"),
    "flipped normals": (
        surfaces(turned(slice(None))), G, OPEN, "flipped normals.*reverse every triangle"
    ),
    "flipped normals of the closed frame": (
        surface(turned(slice(None)), "closed"), G, CLOSED, "flipped normals.*reverse every"
    ),
    "inconsistent orientation": (
        surfaces(turned(slice(40, 45))), G, OPEN, r"inconsistent orientation.*orient all"
    ),
    "non-manifold": (surfaces(fin), G, OPEN, "non-manifold edge.*more than two triangles"),
    "two pieces": (
        surfaces(lambda x, t, r: (
            np.vstack([x, x + 60.0]), np.vstack([t, t + len(x)]), np.append(r, r)
        )), G, OPEN, r"2 pieces that do not touch \(192, 192 vertices\)",
    ),
    "double vertices along the seams": (
        surfaces(torn), G, OPEN, "2 pieces that do not touch .* sharing the vertices of their seam"
    ),
    "handle": (
        surface(handle, "closed"), G, CLOSED, "Euler number -2, expected 0: .* has 1 handle"
    ),
    "NaN in vertices": (not_a_number("open"), G, OPEN, r"open.obj: points \[7\] are not finite"),
    "another region": (
        surface(lambda x, t, r: (x, t, 1 - r), "closed"),
        I, CLOSED, r"belong to another region than in the reference",
    ),
    "a seam that gapes": (
        seam(0.01), G, OPEN, r"2 pieces that do not touch .* sharing the vertices of their seams"
    ),
    "unused vertex": (
        surfaces(lambda x, t, r: (np.vstack([x, x[:1]]), t, r)), G, OPEN, r"vertices \[192\]"
    ),
    # Labels.
    "too few labels": (labels_as_text("0 1 1"), I, OPEN, 'damaged: .*"region"'),
    "no labels": (
        surfaces(lambda x, t, r: (x, t, None)), I, OPEN, "without labels; expected cell data"
    ),
    "a label is NaN": (
        surfaces(labelled(np.nan)), I, OPEN, r"unknown label nan at triangles \[0, 1, 2\]"
    ),
    "unknown label": (
        surfaces(labelled(7)), I, OPEN, r"unknown label 7 .*known are 0 \(anterior\), 1 \(post"
    ),
    "region missing": (
        put("regions", ["anterior", "posterior", "cleft"]),
        G, OPEN, "no triangle belongs to the region cleft",
    ),
    "file for an unknown region": (
        put("frames", 0, "surface", {"anterior": "open.vtp", "posterio": "open.vtp"}),
        I, OPEN, "file for the region 'posterio'; known are anterior, posterior",
    ),
    "no file for a region": (
        put("frames", 0, "surface", {"anterior": "open.vtp"}), I, OPEN, "no file for .*posterior"
    ),
    # The loops and the tips.
    "annulus not closed": (
        put("frames", 0, "annulus", list(range(23))),
        G, "frames.0", r"annulus is not closed: its 23 vertices .*misses \[23\]",
    ),
    "annulus out of order": (
        put("frames", 0, "annulus", [1, 0, *range(2, 24)]), G, "frames.0", "not in the order"
    ),
    "annulus is the free edge": (
        both(
            put("frames", 0, "annulus", list(range(168, 192))),
            put("frames", 0, "free_edge", list(range(168, 192))),
        ), G, "frames.0", "the same boundary loop",
    ),
    "too few points of the annulus": (
        tip_table, I, "frames.1.annulus", "3 points, expected 24: one for every annulus vertex"
    ),
    "other free edge of a corresponding frame": (
        put("frames", 1, "free_edge", list(range(24))),
        I, "frames.1.free_edge", "other vertices than in the reference",
    ),
    "a free edge of one point": (
        both(text("x,y,z\n1,2,3\n", "f.csv"), put("frames", 1, "free_edge", "f.csv")),
        I, "frames.1.free_edge", "1 points, expected three",
    ),
    "points for the reference": (
        both(text("x,y,z\n1,2,3\n4,5,6\n7,8,9", "f.csv"), put("frames", 0, "annulus", "f.csv")),
        I, "frames.0.annulus", "holds points; expected vertex numbers",
    ),
    "a loop in another file": (
        put("frames", 1, "annulus", "open.vtp"), I, "frames.1.annulus", "extension '.vtp'"
    ),
    "tips above the annulus": (
        put("frames", 0, "papillary_tips", [[16.0, 0.0, 25.0], [-16.0, 0.0, 25.0]]),
        G, "frames.0", "nearest to the wider edge.*atrial side",
    ),
    "one tip above the annulus": (
        put("frames", 1, "papillary_tips", [[16.0, 0.0, -25.0], [-16.0, 0.0, 12.0]]),
        G, "frames.1.papillary_tips", r"tip 1 at .* above the annulus, on the atrial side",
    ),
    "tips in metres": (
        put("frames", 1, "papillary_tips", [[16.0, 0.0, -25.0], [-16.0, 0.0, -250.0]]),
        G, "frames.1.papillary_tips", r"tip 1 is 2\d\d mm from the centre.*same unit",
    ),
    "NaN in tips": (
        put("frames", 0, "papillary_tips", 1, 2, float("nan")),
        I, "frames.0.papillary_tips.1.2", "found '.nan'; expected a list of",
    ),
    "tips of two coordinates": (
        put("frames", 0, "papillary_tips", 1, [1.0, 2.0]), I, "frames.0.papillary_tips.1", "x, y, z"
    ),
    "number of tips": (
        put("frames", 1, "papillary_tips", [[16.0, 0.0, -25.0]]),
        I, "frames.1.papillary_tips", "1 tips, but 2 in frame 'open'",
    ),
    # Units.
    "metres": (scaled(0.001), G, OPEN, r"0\.036 mm across.*units.length.*would fit m "),
    "centimetres": (scaled(0.1), G, OPEN, r"3\.6 mm across.*units.length.*would fit cm "),
    "micrometres": (scaled(1000.0), G, OPEN, r"3\.6e\+04 mm across, expected 15 to 80 mm"),
    "pressure in kPa": (
        put("frames", 1, "pressure", 16.0), I, "frames.1.pressure", "16 mmHg.*is it in kPa"
    ),
    "pressure in mmHg": (
        put("units", {"length": "mm", "pressure": "kPa"}),
        I, "frames.1.pressure", "900.* mmHg .*is it in mmHg",
    ),
    "pressure of a held-out frame": (
        both(frame(2, "held_out", 0.5), put("frames", 2, "pressure", 5.0)),
        I, "frames.2.pressure", "5 mmHg on the closed valve, expected 20 to 250",
    ),
    "time outside the curve": (
        drop("frames", 1, "pressure"),
        I, "frames.1.pressure", r"time 0.35 s lies outside .* 0.4 to 0.7 s; give the pressure",
    ),
    "curve runs back": (
        both(
            text("time,pressure\n0,0\n0.4,100\n0.3,110\n", "p.csv"), put("pressure_curve", "p.csv")
        ),
        I, "pressure_curve", r"time 0.3 s of point 2 does not follow",
    ),
    "unknown unit": (put("units", "length", "inch"), I, "units.length", "'inch'; expected mm, cm"),
    # Frames.
    "frames out of order": (
        put("frames", 1, "time", -1.0), I, "frames.1.time", "-1 of 'closed' is not after 0 of"
    ),
    "a time is text": (
        put("frames", 1, "time", "1e-3"), I, "frames.1.time", "this is text: YAML wants .* 1.0e-3"
    ),
    "a time is true": (put("frames", 1, "time", True), I, "frames.1.time", "found True"),
    "two references": (
        put("frames", 1, "role", "reference"),
        I, "frames", r"2 frames have the role reference \(open, closed\)",
    ),
    "no closed frame": (
        put("frames", 1, "role", "held_out"), I, "frames", r"0 frames .* closed \(none\)"
    ),
    "two closed frames": (frame(2, "closed", 0.5), I, "frames", r"2 frames have the role closed"),
    "same name": (put("frames", 1, "name", "open"), I, "frames", "'open' occurs twice"),
    **{
        f"names that look the same: {what}": (
            both(put("frames", 0, "name", "syst\u00f6le"), put("frames", 1, "name", name)),
            I, "frames", "look the same; expected different names",
        )
        for what, name in (
            ("normal form", "systo\u0308le"),
            ("case", "SYST\u00d6LE"),
            ("spaces", " syst\u00f6le "),
        )
    },
    "unknown role": (put("frames", 1, "role", "shut"), I, "frames.1.role", "found 'shut'"),
    "no frame": (put("frames", []), I, "frames", "a list of frames"),
    "a closed frame alone": (drop("frames", 0), I, "frames", r"0 frames .* reference \(none\)"),
    "does not correspond": (
        both(put("corresponds", True), surface(lambda x, t, r: (x, t[::-1], r[::-1]), "closed")),
        I, "corresponds", "identical triangles",
    ),
    # Tissue.
    "thickness 0": (put("thickness", 0), G, "thickness", "0 mm at vertex 0.*above 0 and at most 5"),
    "thickness negative": (
        put("thickness", {"anterior": -1.0, "posterior": 1.0}), G, "thickness", "-1 mm at vertex"
    ),
    "thickness absurd": (put("thickness", 13.2), G, "thickness", "13.2 mm .* at most 5 mm"),
    "thickness of no region": (
        put("thickness", {"anterior": 1.0}), I, "thickness", "none for the region posterior"
    ),
    "thickness of another region": (
        put("thickness", {"anterior": 1.0, "posterior": 1.0, "cleft": 1.0}),
        I, "thickness", "unknown region 'cleft'",
    ),
    "thickness of unnamed leaflets": (
        put("regions", ["septal", "mural"]), I, "thickness", "none for the region septal, mural"
    ),
    "no such point data": (
        put("thickness", {"point_data": "depth"}),
        I, "thickness", "no point data 'depth'; found none",
    ),
    "no such fibres": (put("fibre", "fibres"), I, "fibre", "no point data 'fibres'"),
    # Chordae.
    "chord disconnected": (cell(3, "z", "40"), G, "chordae", r"chord 3 is disconnected.* mm from"),
    "tip index out of range": (cell(5, "tip", "2"), I, "chordae", "chord 5 starts at papillary"),
    "negative tip index": (cell(5, "tip", "-1"), I, "chordae", "tip of row 5 is '-1'"),
    "rest length 0": (cell(2, "rest_length_mm", "0"), I, "chordae", "rest_length of chord 2 is 0"),
    "stiffness negative": (cell(2, "stiffness_n", "-1"), I, "chordae", "stiffness of .* 2 is -1"),
    "NaN in chordae": (cell(1, "x", "nan"), I, "chordae", "x of row 1 is 'nan'"),
    "another column": (
        text("tip,x,y,z\n0,1,2,3\n", "chordae.csv"), I, "chordae", "columns tip,x,y,z, expected tip"
    ),
    "toe strain": (
        put("chordae", {"file": "chordae.csv", "toe_strain": 2.0}),
        I, "chordae.toe_strain", r"found 2.0; expected strain",
    ),
    "unknown family": (
        put("chordae", {"file": "chordae.csv", "families": ["marginal"]}),
        I, "chordae", "'basal'; known are marginal",
    ),
    "no chordae and three tips": (
        both(
            drop("chordae"),
            put("frames", 0, "papillary_tips", [[16.0, 0, -25], [-16.0, 0, -25], [0.0, 0, -25]]),
            put("frames", 1, "papillary_tips", [[16.0, 0, -25], [-16.0, 0, -25], [0.0, 0, -25]]),
        ), I, "chordae", "two papillary tips .*3 tips",
    ),
    # Files.
    "missing file": (
        put("frames", 0, "surface", "opne.vtp"), I, OPEN, "'opne.vtp': no such file in"
    ),
    "unknown extension": (
        both(text("x", "open.off"), put("frames", 0, "surface", "open.off")),
        I, OPEN, r"extension '.off', expected .vtu, .vtp, .stl, .obj, .ply",
    ),
    "truncated file": (
        lambda folder, document: os.truncate(folder / "closed.vtp", 3000), I, CLOSED, "damaged"
    ),
    "a folder instead of a file": (
        both(lambda folder, _: (folder / "d.csv").mkdir(), put("chordae", "d.csv")),
        I, "chordae", "no such file",
    ),
    "path out of the folder": (
        put("frames", 0, "surface", "../case/open.vtp"), I, OPEN, "leads out of the folder"
    ),
    "a long name": (put("chordae", "x" * 300), I, "chordae", "expected a .csv file"),
    "a link to itself": (
        both(
            lambda folder, _: (folder / "a.csv").symlink_to(folder / "a.csv"),
            put("chordae", "a.csv"),
        ), I, "chordae", "cannot be found|no such file",
    ),
    "absolute path": (put("chordae", "/" + "etc/hosts"), I, "chordae", "leads out of the folder"),
    "link out of the folder": (link_out, I, OPEN, "leads out of the folder"),
    # The document.
    "unknown version": (put("version", 2), I, "version", "2 is not known; expected 1"),
    "version is true": (put("version", True), I, "version", "True is not known; expected 1"),
    "no version": (drop("version"), I, "version", "is missing; expected 1"),
    "unknown key": (put("frames", 0, "tiem", 1.0), I, "frames.0.tiem", "did you mean time"),
    "unknown key far from all": (put("patient", 1), I, "patient", "expected one of version, name"),
    "unknown key of a part": (
        put("observation", {"std": 1.0}), I, "observation.std_mm", "is missing|did you mean std_mm"
    ),
    "no units": (drop("units"), I, "units", "is missing; expected a mapping with length"),
    "no name of a frame": (drop("frames", 0, "name"), I, "frames.0.name", "is missing"),
    "a list of regions with a number": (put("regions", ["a", 1]), I, "regions.1", "found 1"),
    "regions of one name": (put("regions", ["a", "b", "a"]), I, "regions", "'a' occurs twice"),
    "a merge key in quotes": (put("<<", {"name": "x"}), I, "<<", "unknown key; expected one of"),
    "a key like a kind": (put("<text>", 1), I, "<text>", "unknown key; expected one of"),
    "regions as text": (put("regions", "anterior"), I, "regions", "found 'anterior'; expected a"),
    "standard deviation 0": (
        put("observation", {"std_mm": 0, "correlation_length_mm": 1}),
        I, "observation.std_mm", "found 0; expected standard deviation",
    ),
    "correlation negative": (
        put("observation", {"std_mm": 1, "correlation_length_mm": -1.0}),
        I, "observation.correlation_length_mm", "found -1.0; expected mm along .* >= 0",
    ),
    "an object": (
        text("version: !!python/object/apply:os.system ['true']"),
        I, "no valid YAML", "no constructor|constructor for the tag",
    ),
    "a repeated key": (text("version: 1\nname: a\nname: b"), I, "name", r"twice \(again in line 3"),
    "no YAML": (text("version: [1"), I, "no valid YAML", "expected"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "error", "field", "message"), CASES.values(), ids=CASES)
def test_what_is_wrong_is_one_clear_error(bad, change, error, field, message):
    folder, document = bad
    change(folder, document)
    save(folder, document.get("text", document) if "text" in document else document)
    with pytest.raises(InputError, match=message) as caught:
        read_case(folder)
    assert type(caught.value) is error
    said = str(caught.value)
    assert said.startswith(f"{folder / 'case.yaml'}: {field}"), said
    assert "\n" not in said
    assert len(said) < 1000


def test_no_case_at_all(tmp_path):
    with pytest.raises(InputError, match=r"no such folder"):
        read_case(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"no case\.yaml in this folder"):
        read_case(tmp_path)


def test_only_files_that_the_case_names_within_its_folder_are_hashed(bad):
    folder, document = bad
    (folder.parent / "secret.txt").write_text("secret")
    (folder / "note.txt").write_text("note")
    save(folder, document | {"description": "../secret.txt", "source": "note.txt"})
    assert set(files_of_case(folder)) == {"case.yaml", "open.vtp", "closed.vtp", "chordae.csv"}
    read_case(folder)
    shutil.copy(folder / "closed.vtp", folder.parent)
    put("frames", 1, "surface", "../closed.vtp")(folder, document)
    assert "../closed.vtp" not in files_of_case(save(folder, document))
    (folder / "case.yaml").rename(folder.parent / "elsewhere.yaml")
    (folder / "case.yaml").symlink_to(folder.parent / "elsewhere.yaml")
    with pytest.raises(InputError, match=r"case\.yaml: link: 'case\.yaml' leads out of the folder"):
        read_case(folder)
    assert files_of_case(folder) == {}
