"""The page of one case. What it shows is made up; see `tests.reporting.case.made_up_case`."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.problem.record import EstimateRecord
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY, FailedCheck, Verdict
from mvest.reporting.case.report import report
from mvest.reporting.case.tables import estimate_text, report_tables
from tests.reporting.case.made_up_case import (
    LINE,
    PROVENANCE,
    made_up_case,
    poisoned,
    poisoned_record,
)

SECTIONS = (
    "estimates", "figure3", "valve-shapes", "narrower", "fit", "measurements", "case", "settings",
)  # fmt: skip
PICTURES = ("estimates", "figure3", "shapes")
MAX_BYTES = 8_000_000
HOSTILE = "<script>alert(1)</script>"


class Page(HTMLParser):
    """Ids, addresses, and the text that a reader sees."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.scripts = 0
        self.text = ""
        self._hidden = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self._hidden = tag in ("script", "style")
        self.scripts += tag == "script"
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "action", "data", "poster", "srcset"):
                self.addresses.append(value)

    def handle_endtag(self, tag):
        self._hidden = False

    def handle_data(self, data):
        if not self._hidden:
            self.text += data


def quickly(folder, record, fields, line="", provenance=None):
    """A report with coarse pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvest.reporting.figures.DPI", 30)
        patch.setattr("mvest.reporting.case.drawing.MAX_SPLITS", 0)
        return report(record, folder, arrays=fields, line=line, provenance=provenance)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return made_up_case(tmp_path_factory.mktemp("case"))


@pytest.fixture(scope="module")
def written(case, tmp_path_factory):
    record, fields = case
    folder = tmp_path_factory.mktemp("report") / "new"
    return report(record, folder, arrays=fields, line=LINE, provenance=PROVENANCE)


@pytest.fixture(scope="module")
def html(written):
    return written[1].read_text(encoding="utf-8")


def test_every_section_and_every_picture_is_there(html) -> None:
    page = Page(html)
    assert [name for name in page.ids if name in SECTIONS] == list(SECTIONS)
    assert [name for name in page.ids if name.startswith("picture-")] == [
        f"picture-{name}" for name in PICTURES
    ]
    assert "Not shown" not in page.text
    assert "SIMULATED" in page.text
    assert "NOT FOR DIAGNOSIS" in page.text
    assert "Thickness of the leaflets: taken from the literature." in page.text


ANSWER = "stiffness estimate 95 % interval E_f anterior 5.8 MPa 4.2 to 7.4 MPa"


def shown(page: str) -> str:
    """The text of a page on one line, cells apart."""
    return " ".join(Page(re.sub("</t[dh]>", " ", page)).text.split())


def test_the_answer_stands_at_the_top(html) -> None:
    # 5.8 ± 1.96 x 0.8 and 2.2 ± 1.96 x 0.3, to two digits.
    text = shown(html)
    assert f"{ANSWER} E_f posterior 2.2 MPa 1.6 to 2.8 MPa" in text
    assert text.index(ANSWER) < text.index("Contents")


def test_what_the_data_hardly_tell_apart_is_named(html) -> None:
    assert (
        "The data hardly tell apart E_f anterior and slack of the chordae (correlations of at "
        "least 0.957): +10 % of E_f anterior with −3.1 % of slack of the chordae looks almost the "
        "same."
    ) in Page(html).text


def test_the_caption_of_figure_3_tells_which_panel_is_which(case, html) -> None:
    with np.load(case[1]) as stored:
        off = [stored[f"distance_{name}"][0] for name in ("generic", "fitted")]
    told, spreads = Page(html).text, [f"{np.nanmean(d):.2f} ± {np.nanstd(d):.2f} mm" for d in off]
    assert "frame “closed”" in told
    assert f"over {np.isfinite(off[1]).sum()} points" in told
    assert f"Left: generic stiffness, {spreads[0]}" in told
    assert f"Right: personalised stiffness, {spreads[1]}" in told


def test_the_page_loads_nothing_and_is_not_too_large(written, html) -> None:
    local = {path.name for path in written}
    outside = [
        a for a in Page(html).addresses if not a.startswith(("#", "data:")) and a not in local
    ]
    assert outside == []
    # Whatever a script might ask for, the policy refuses it.
    assert "default-src 'none'" in html
    assert not re.search(r"(script|img|connect|default)-src[^;\"]*https?:", html)
    assert written[1].stat().st_size < MAX_BYTES


def test_pictures_lie_beside_the_page_with_their_provenance(written) -> None:
    names = [path.name for path in written]
    assert names[:2] == ["unknowns.csv", "report.html"]
    assert set(names[2:]) == {f"{name}.png" for name in PICTURES}
    assert b"commit 0123456789ab" in written[2].read_bytes()


def test_unknowns_are_a_table_for_programs(written) -> None:
    header, first = written[0].read_text(encoding="utf-8").splitlines()[:2]
    values = dict(zip(header.split(","), first.split(","), strict=True))
    assert (values["name"], values["unit"], float(values["estimate"])) == (
        "E_f.anterior", "MPa", 5.8
    )  # fmt: skip


def test_the_scene_shows_one_state_at_a_time(html) -> None:
    shown = re.findall(r'data-shown="([^"]*)">([^<]*)<', html)
    assert [label for _, label in shown] == [
        "open",
        "closed, observed",
        "closed, generic",
        "closed, personalised",
        "distance, generic",
        "distance, personalised",
        "observed (grey) over personalised",
    ]
    visible = np.array([[word == "true" for word in re.findall(r"\w+", v)] for v, _ in shown])
    # Every trace belongs to exactly one state.
    assert (visible.sum(axis=0) == 1).all()
    assert visible.any(axis=1).all()


@pytest.fixture(scope="module")
def hostile_page(case, tmp_path_factory):
    """A record in which every name and sentence is a script."""
    record, path = case
    attack = HOSTILE + "$\\frac$"
    poisonous = poisoned_record(
        record,
        attack,
        settings=[{"setting": HOSTILE, "value": HOSTILE}],
        measurements=[{"frame": HOSTILE, "shape": HOSTILE, HOSTILE: 1.0}],
    )
    folder = tmp_path_factory.mktemp("hostile")
    written = quickly(folder, poisonous, path, poisoned(LINE, attack), poisoned(PROVENANCE, attack))
    return written[1].read_text(encoding="utf-8")


def test_text_of_the_record_is_escaped(hostile_page, html) -> None:
    assert HOSTILE not in hostile_page
    # As many scripts as in the page of the harmless record.
    assert Page(hostile_page).scripts == Page(html).scripts
    assert "alert(1)" in Page(hostile_page).text


@pytest.fixture(scope="module")
def bare_page(case, tmp_path_factory):
    """Of an almost empty record, and fields of a run that ended before it predicted anything."""
    folder = tmp_path_factory.mktemp("bare")
    with np.load(case[1]) as stored:
        kept = ("triangles", "region", "rest", "annulus", "frames", "seen")
        np.savez(folder / "fields.npz", **{name: stored[name] for name in kept})
    bare = EstimateRecord(case="Nothing yet", status="failed", reason="no equilibrium")
    pages = [quickly(folder / name, bare, folder / "fields.npz") for name in ("page", "again")]
    assert pages[0][1].read_bytes() == pages[1][1].read_bytes()
    return pages[0]


def test_what_is_missing_is_said(bare_page) -> None:
    page = Page(bare_page[1].read_text(encoding="utf-8"))
    assert [name for name in page.ids if name in SECTIONS] == list(SECTIONS)
    for sentence in (
        "No stiffness was estimated: no equilibrium.",
        "RUN FAILED",
        "The run did not judge its estimate.",
        "The run did not check whether the fitted closed state",
        "No modulus is stated.",
        "The errors of the closed frame were taken as they are stated.",
        "No frame was held out",
        "The record has no distances.",
        "The record has no measurements.",
        "The record does not say where it came from.",
        "Figure 3 needs",
    ):
        assert sentence in page.text
    # Only what was stored is drawn, and nothing says nan or None.
    assert [path.name for path in bare_page[2:]] == ["shapes.png"]
    assert not re.search(r"\b(nan|None)\b", page.text)


@pytest.fixture(scope="module")
def partial_page(case, tmp_path_factory):
    """What a run may leave out is missing, and the closed frame was seen as points."""
    record, path = case
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["observed_points_closed"] = arrays.pop("observed")[0, 4:]
    plain = record.model_dump() | {"alternatives": {}, "innovation": None}
    plain["unknowns"] = [row | {"truth": None} for row in plain["unknowns"]]
    for frame in plain["frames"]:
        frame |= {name: None for name in frame if name.endswith("_to_truth")}
    del plain["details"]["errors"]
    folder = tmp_path_factory.mktemp("partial")
    # Arrays may also be given as they are.
    written = quickly(folder, EstimateRecord.model_validate(plain), arrays)
    return written[1].read_text(encoding="utf-8")


def test_what_is_not_known_is_left_out(partial_page) -> None:
    page = Page(partial_page)
    assert "With all nuisances taken as known" not in page.text
    assert "true value" not in page.text
    assert not re.search(r"\b(nan|None)\b", page.text)


def test_a_frame_that_does_not_correspond_is_shown_as_points(partial_page) -> None:
    labels = re.findall(r'data-shown="[^"]*">([^<]*)<', partial_page)
    assert "closed, observed" in labels
    assert "observed (grey) over personalised" in labels
    assert "picture-shapes" in partial_page


def test_an_unusable_place_or_file_is_one_clear_error(case, tmp_path) -> None:
    with pytest.raises(InputError, match="no fields of a case"):
        report(case[0], tmp_path, arrays=tmp_path / "none.npz")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        report(case[0], tmp_path / "file" / "page", arrays=case[1])


# --- what is to be believed ---------------------------------------------------------------------

LEAKS = FailedCheck("closure", NONE, "the fitted valve leaves 121 mm² free", "check the chordae")
WIDE = FailedCheck("data against prior", DOUBTFUL, "the data narrow it to 80 %", "add a frame")


def judged(case, folder, *arguments) -> tuple[str, str]:
    """The text of a page and of the terminal with a verdict."""
    record = case[0].model_copy(update={"verdict": Verdict(*arguments)})
    page = quickly(folder, record, case[1])[1].read_text(encoding="utf-8")
    return shown(page), estimate_text(record)


def test_no_number_is_stated_of_what_is_not_to_be_believed(case, tmp_path) -> None:
    page, terminal = judged(case, tmp_path, NONE, (LEAKS, WIDE), ("geometry",))
    assert "No stiffness can be stated: the fitted valve leaves 121 mm² free." in page
    assert "NOT TO BE BELIEVED" in page
    assert "The fitted valve leaves 121 mm² free. Next: check the chordae." in page
    assert "5.8 MPa" not in page
    assert terminal.startswith("made_up: NONE")
    assert "5.8" not in terminal


def test_a_doubt_stands_before_the_numbers(case, tmp_path) -> None:
    page, terminal = judged(case, tmp_path, DOUBTFUL, (WIDE,), ("geometry",), ("closure",))
    assert f"Doubtful, since the data narrow it to 80 %. {ANSWER}" in page
    assert "Not checked: closure." in page
    assert terminal.index("narrow it to 80 %") < terminal.index("5.8")


def test_what_is_trusted_is_answered_by_its_numbers(case, tmp_path) -> None:
    page, _ = judged(case, tmp_path, TRUSTWORTHY, (), ("geometry", "closure"))
    assert "Trustworthy: all 2 checks were passed." in page
    assert page.index(ANSWER) < page.index("May it be believed?")


# --- tables -------------------------------------------------------------------------------------


def test_a_truth_outside_its_interval_is_marked(case) -> None:
    outside = case[0].with_truth({"E_f.anterior": 9.0, "E_f.posterior": 2.1})
    first, second = report_tables(outside)["moduli"].readable()
    assert first["estimate (95 % interval)"].endswith("✗")
    assert not second["estimate (95 % interval)"].endswith("✗")


def test_a_worse_prediction_of_a_held_out_frame_is_not_hidden(html) -> None:
    # The made-up late frame is nearer to the personalised valve.
    assert "Frame late was not shown to the filter" in html
    assert "NOT nearer" not in html


def test_what_narrows_most_stands_first(case) -> None:
    rows = report_tables(case[0])["narrower"].rows
    # 0.5 and 0.71 over 0.8, in per cent.
    assert [row["E_f anterior"] for row in rows] == pytest.approx([62.5, 88.75])
    assert rows[0]["what"] == "if the chordae were known"


def test_where_the_variance_comes_from_is_told_as_far_as_it_matters(case, html) -> None:
    rows = report_tables(case[0])["shares"].rows
    assert [(row["source"], row["E_f anterior"]) for row in rows] == [
        ("thickness", 60.0),
        ("pressure (factor)", 39.5),
    ]
    assert "ratio of E_f anterior to posterior" in Page(html).text


def test_units_of_measurements_are_read_from_their_names(case) -> None:
    rows = report_tables(case[0])["measurements"].rows
    assert [row["measurement"] for row in rows][:2] == [
        "AP diameter [mm]",
        "commissural diameter [mm]",
    ]
    assert list(rows[0])[1:] == [
        "open, observed",
        "closed, observed",
        "closed, generic",
        "closed, personalised",
    ]
    assert rows[4]["measurement"] == "tenting volume [mm³]"
    assert [rows[4]["closed, generic"], rows[5]["closed, generic"]] == [1840.0, None]
