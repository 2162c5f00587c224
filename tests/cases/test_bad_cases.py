"""Every fault of a case is one clear error: the file, the field, and what would be right.

Each row breaks one thing of a folder that is otherwise in order.
"""

import copy
import shutil

import numpy as np
import pytest

from mvest.cases.folder import read_case
from mvest.cases.schema import files_of_case
from mvest.errors import InputError
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
    assert len(read_case(save(folder, document)).surface.vertices) == 192


# --- ways to break it ---------------------------------------------------------------------------
DROPPED = "dropped"


def put(path, value=DROPPED):
    """Set a field of the document, or drop it; frame 0 is open, 1 closed."""

    def change(folder, document):
        *parents, last = (int(part) if part.isdigit() else part for part in path.split("."))
        for key in parents:
            document = document[key]
        document[last] = copy.deepcopy(value)
        if value == DROPPED:
            del document[last]

    return change


def both(*changes):
    return lambda folder, document: [one(folder, document) for one in changes]


def text(content, name):
    return lambda folder, _: (folder / name).write_text(content)


def tree(*rows):
    """Chordae of these tips, starts and ends."""
    head = "tip,x,y,z,family,rest_length_mm,stiffness_n,start,end"
    table = [head, *(f"{tip},0,0,0,a,9,9,{start},{end}" for tip, start, end in rows)]
    return text("\n".join(table), "chordae.csv")


def surface(edit, *names):
    """Replace surfaces by what ``edit`` makes of their vertices, triangles and labels."""

    def change(folder, document):
        for name in names or ("open", "closed"):
            file = folder / f"{name}.vtp"
            old = read_surface(file)
            region = old.cell_data["region"].copy()
            save_surface(file, *edit(old.vertices.copy(), old.triangles.copy(), region))

    return change


def scaled(factor):
    def change(folder, document):
        surface(lambda x, t, r: (x * factor, t, r))(folder, document)
        for entry in document["frames"]:
            entry["papillary_tips"] = [[v * factor for v in p] for p in entry["papillary_tips"]]

    return change


def without(gone, x, t, r):
    return x, t[~gone], r[~gone]


def hole(x, t, r):
    """One vertex in the middle of a leaflet is missing, with its triangles."""
    x, t, r = without((t == 84).any(axis=1), x, t, r)
    return np.delete(x, 84, axis=0), t - (t > 84), r


def handle(x, t, r):
    """A tube between two triangles, both of which are taken away."""
    a, b = t[60], t[75][[0, 2, 1]]
    tube = [
        corners
        for i, j in ((0, 1), (1, 2), (2, 0))
        for corners in ([a[i], a[j], b[i]], [a[j], b[j], b[i]])
    ]
    x, t, r = without(np.isin(np.arange(len(t)), (60, 75)), x, t, r)
    return x, np.vstack([t, tube]), np.append(r, [0] * 6)


def twice(x, t, r):
    return np.vstack([x, x + 60.0]), np.vstack([t, t + len(x)]), np.append(r, r)


def crossed(x, t, r):
    """One vertex of a leaflet is pushed through the other side of the valve."""
    x[156] += 1.3 * (x[168] - x[156]) + np.array([0.0, 0.0, 0.1])
    return x, t, r


POINTS = "x,y,z\n1,2,3\n4,5,6\n7,8,9\n"
TIPS = "frames.{}.papillary_tips".format
THREE = [[16.0, 0, -25], [-16.0, 0, -25], [0.0, 0, -25]]
OPEN, CLOSED = "frames.0.surface", "frames.1.surface"
EDGE = list(range(168, 192))

CASES = {
    # The surface.
    "hole": (surface(hole), OPEN, r"3 boundary loops .*6 vertices.*close the 1 holes"),
    "self-intersecting": (surface(crossed), OPEN, "self-intersection: triangles"),
    "flipped normals": (
        surface(lambda x, t, r: (x, t[:, ::-1], r)), OPEN, "flipped normals.*reverse every triangle"
    ),
    "handle": (surface(handle, "closed"), CLOSED, "Euler number -2, expected 0: .* has 1 handle"),
    "two pieces": (surface(twice), OPEN, r"2 pieces that do not touch \(192, 192 vertices\)"),
    "unused vertex": (
        surface(lambda x, t, r: (np.vstack([x, x[:1]]), t, r)), OPEN, r"vertices \[192\]"
    ),
    "metres": (scaled(0.001), OPEN, r"0\.036 mm across.*units.length.*would fit m "),
    "no labels": (surface(lambda x, t, r: (x, t, None)), OPEN, "labels; expected cell data"),
    "another region": (
        surface(lambda x, t, r: (x, t, 1 - r), "closed"), CLOSED, "belong to another region than in"
    ),
    "does not correspond": (
        both(
            put("frames.1.corresponds", True),
            surface(lambda x, t, r: (x, t[::-1], r[::-1]), "closed"),
        ),
        "frames.1.corresponds", "identical triangles",
    ),
    # The loops and the tips.
    "annulus not closed": (
        put("frames.0.annulus", list(range(23))),
        "frames.0", r"annulus is not closed: its 23 vertices .*misses \[23\]",
    ),
    "annulus is the free edge": (
        both(put("frames.0.annulus", EDGE), put("frames.0.free_edge", EDGE)),
        "frames.0", "the same boundary loop",
    ),
    "too few points of the annulus": (
        both(text(POINTS, "f.csv"), put("frames.1.annulus", "f.csv")),
        "frames.1.annulus", "3 points, expected 24: one for every annulus vertex",
    ),
    "other free edge of a corresponding frame": (
        put("frames.1.free_edge", list(range(24))),
        "frames.1.free_edge", "other vertices than in the reference",
    ),
    "points for the reference": (
        both(text(POINTS, "f.csv"), put("frames.0.annulus", "f.csv")),
        "frames.0.annulus", "holds points; expected vertex numbers",
    ),
    "tips above the annulus": (
        put(TIPS(0), [[16.0, 0, 25], [-16.0, 0, 25]]), "frames.0", "wider edge.*atrial side"
    ),
    "tips in other units": (
        put(TIPS(1), [[16.0, 0, -25], [-16.0, 0, -250]]), TIPS(1), r"tip 1 is 2\d\d mm .*same unit"
    ),
    "number of tips": (put(TIPS(1), THREE[:1]), TIPS(1), "1 tips, but 2 in frame 'open'"),
    # Pressures.
    "kPa": (put("frames.1.pressure", 16.0), "frames.1.pressure", "16 mmHg.*is it in kPa"),
    "no pressure": (put("frames.1.pressure"), "frames.1.pressure", "is missing; expected a number"),
    # Frames.
    "frames out of order": (put("frames.1.time", -1.0), "frames.1.time", "-1 of 'closed' is not"),
    "a time is text": (put("frames.1.time", "1e-3"), "frames.1.time", "text: YAML wants .* 1.0e-3"),
    "two references": (
        put("frames.1.role", "reference"), "frames", r"2 frames have the role reference \(open, cl"
    ),
    "names that look the same": (
        both(put("frames.0.name", "syst\u00f6le"), put("frames.1.name", " SYSTO\u0308LE")),
        "frames", "look the same; expected different names",
    ),
    # Tissue and chordae.
    "thickness 0": (put("thickness", 0), "thickness", "0 mm at vertex 0.*above 0 and at most 5"),
    "thickness of no region": (
        put("thickness", {"anterior": 1.0}), "thickness", "none for the region posterior"
    ),
    "unknown family": (
        put("chordae", {"file": "chordae.csv", "families": ["marginal"]}),
        "chordae", "'basal'; known are marginal",
    ),
    "no column end": (
        text("tip,x,y,z,family,rest_length_mm,stiffness_n,start\n0,0,0,0,a,1,1,\n", "chordae.csv"),
        "chordae", r"columns tip,.*start, expected tip,.*,stiffness_n, and both or none of start,e",
    ),
    "unknown parent": (
        tree((0, "a", ""), (0, "", "b"), (0, "b", "")),
        "chordae", r"chordae.csv: start of row 0 is 'a', expected a name in the column end \(b\)",
    ),
    "two trunks": (
        tree((0, "", "a"), (0, "", "a"), (0, "a", "")),
        "chordae", r"chordae.csv: end of row 1 is 'a' as that of row 0, expected one row",
    ),
    "cycle of branches": (
        tree((0, "", ""), (0, "a", "b"), (0, "b", "a"), (0, "a", "")),
        "chordae", r"chordae.csv: start of row 1 is 'a', in a cycle; expected a way from a papi",
    ),
    "branch without a leaflet end": (
        tree((0, "", ""), (0, "", "a")),
        "chordae", r"chordae.csv: end of row 1 is 'a', expected a name in the column start, or not",
    ),
    "two tips in one tree": (
        tree((0, "", "a"), (0, "a", ""), (1, "a", "")),
        "chordae", r"chordae.csv: tip of row 2 is 1, expected 0 as in row 0, from which it branch",
    ),
    "no chordae and three tips": (
        both(put("chordae"), put(TIPS(0), THREE), put(TIPS(1), THREE)),
        "chordae", "two papillary tips .*3 tips",
    ),
    # Files.
    "missing file": (put("frames.0.surface", "opne.vtp"), OPEN, "'opne.vtp': no such file in"),
    "path out of the folder": (
        put("frames.0.surface", "../case/open.vtp"), OPEN, "leads out of the folder"
    ),
    # The document.
    "unknown version": (put("version", 2), "version", "2 is not known; expected 1"),
    "unknown key": (put("frames.0.tiem", 1.0), "frames.0.tiem", "did you mean time"),
    "no units": (put("units"), "units", "is missing; expected a mapping with length"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "field", "message"), CASES.values(), ids=CASES)
def test_every_fault_is_one_clear_error(bad, change, field, message):
    folder, document = bad
    change(folder, document)
    save(folder, document)
    with pytest.raises(InputError, match=message) as caught:
        read_case(folder)
    error = str(caught.value)
    assert error.startswith(f"{folder / 'case.yaml'}: {field}"), error
    assert "\n" not in error
    assert len(error) < 1000


def test_no_case_at_all(tmp_path):
    with pytest.raises(InputError, match=r"no such folder"):
        read_case(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"no case\.yaml in this folder"):
        read_case(tmp_path)


def test_only_files_that_the_case_names_within_its_folder_are_hashed(bad):
    folder, document = bad
    (folder / "note.txt").write_text("note")
    save(folder, document | {"description": "../secret.txt", "source": "note.txt"})
    assert set(files_of_case(folder)) == {"case.yaml", "open.vtp", "closed.vtp", "chordae.csv"}
    shutil.copy(folder / "closed.vtp", folder.parent)
    put("frames.1.surface", "../closed.vtp")(folder, document)
    assert "../closed.vtp" not in files_of_case(save(folder, document))
    (folder / "case.yaml").rename(folder.parent / "elsewhere.yaml")
    (folder / "case.yaml").symlink_to(folder.parent / "elsewhere.yaml")
    with pytest.raises(InputError, match=r"case\.yaml: link: 'case\.yaml' leads out of the folder"):
        read_case(folder)
    assert files_of_case(folder) == {}
