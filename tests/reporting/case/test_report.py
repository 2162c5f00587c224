"""The page of one case. Its content is made up; see `tests.reporting.case.made_up_case`."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.problem.record import UNCALIBRATED, EstimateRecord
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY, FailedCheck, Verdict
from mvest.reporting.case.report import report
from mvest.reporting.case.tables import estimate_text, report_tables
from tests.reporting.case.made_up_case import LINE, PROVENANCE, made_up_case

SECTIONS = (
    "verdict", "estimates", "figure3", "valve-shapes", "narrower", "fit", "measurements", "case",
    "settings",
)  # fmt: skip
PICTURES = ("estimates", "figure3", "shapes")
MAX_BYTES = 8_000_000


class Page(HTMLParser):
    """Ids, addresses, and the text that a reader sees, on one line with cells apart."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.text = ""
        self._hidden = False
        self.feed(re.sub("</t[dh]>", " ", text))
        self.text = " ".join(self.text.split())

    def handle_starttag(self, tag, attrs):
        self._hidden = tag in ("script", "style")
        self.ids += [value for name, value in attrs if name == "id"]
        self.addresses += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag):
        self._hidden = False

    def handle_data(self, data):
        self.text += "" if self._hidden else data


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return made_up_case(tmp_path_factory.mktemp("case"))


@pytest.fixture(autouse=True, scope="module")
def _coarse_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvest.reporting.figures.DPI", 30)
        patch.setattr("mvest.reporting.case.drawing.MAX_SPLITS", 0)
        yield


@pytest.fixture(scope="module")
def written(case, tmp_path_factory):
    record, fields = case
    folder = tmp_path_factory.mktemp("report") / "new"
    return report(record, folder, arrays=fields, line=LINE, provenance=PROVENANCE)


@pytest.fixture(scope="module")
def html(written):
    return written[1].read_text(encoding="utf-8")


ANSWER = "stiffness estimate 95 % interval E_f anterior 5.8 MPa 4.2 to 7.4 MPa"


def test_a_page_begins_with_the_moduli_and_has_every_section_and_picture(case, html) -> None:
    page = Page(html)
    assert [name for name in page.ids if name in SECTIONS] == list(SECTIONS)
    pictures = [name for name in page.ids if name.startswith("picture-")]
    assert pictures == [f"picture-{name}" for name in PICTURES]
    # 5.8 ± 1.96 x 0.8 and 2.2 ± 1.96 x 0.3, to two digits.
    assert f"{ANSWER} E_f posterior 2.2 MPa 1.6 to 2.8 MPa" in page.text
    assert page.text.index(ANSWER) < page.text.index("Contents")
    for part in ("SIMULATED", "NOT FOR DIAGNOSIS", "Frame late was not shown"):
        assert part in page.text
    # The made-up late frame is nearer to the personalised valve.
    assert "NOT nearer" not in page.text
    with np.load(case[1]) as stored:
        off = [stored[f"distance_{name}"][0] for name in ("generic", "fitted")]
    generic, fitted = (f"{np.nanmean(d):.2f} ± {np.nanstd(d):.2f} mm" for d in off)
    assert f"Left: generic stiffness, {generic}" in page.text
    assert f"Right: personalised stiffness, {fitted}" in page.text


def test_the_page_loads_nothing_and_is_not_too_large(written, html) -> None:
    local = {path.name for path in written}
    assert [a for a in Page(html).addresses if not a.startswith(("#", "data:"))] == [
        path.name for path in written[2:]
    ]
    assert local == {"unknowns.csv", "report.html", *(f"{name}.png" for name in PICTURES)}
    # The policy refuses all requests of scripts.
    assert "default-src 'none'" in html
    assert not re.search(r"(script|img|connect|default)-src[^;\"]*https?:", html)
    assert written[1].stat().st_size < MAX_BYTES
    assert b"commit 0123456789ab" in written[2].read_bytes()
    header, first = written[0].read_text(encoding="utf-8").splitlines()[:2]
    values = dict(zip(header.split(","), first.split(","), strict=True))
    assert (values["name"], float(values["estimate"])) == ("E_f.anterior", 5.8)


def test_an_almost_empty_record_has_a_page(case, tmp_path) -> None:
    with np.load(case[1]) as stored:
        kept = ("triangles", "region", "rest", "annulus", "frames", "seen")
        arrays = {name: stored[name] for name in kept}
    bare = EstimateRecord(case="Nothing yet", status="failed", reason="no equilibrium")
    one, again = (report(bare, tmp_path / name, arrays=arrays) for name in ("page", "again"))
    assert one[1].read_bytes() == again[1].read_bytes()
    page = Page(one[1].read_text(encoding="utf-8"))
    assert [name for name in page.ids if name in SECTIONS] == list(SECTIONS)
    assert "No stiffness was estimated: no equilibrium." in page.text
    assert "RUN FAILED" in page.text
    # Only what was stored is drawn, and nothing says nan or None.
    assert [path.name for path in one[2:]] == ["shapes.png"]
    assert not re.search(r"\b(nan|None)\b", page.text)


def test_an_unusable_place_or_file_is_one_clear_error(case, tmp_path) -> None:
    with pytest.raises(InputError, match="no fields of a case"):
        report(case[0], tmp_path, arrays=tmp_path / "none.npz")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        report(case[0], tmp_path / "file" / "page", arrays=case[1])


LEAKS = FailedCheck("closure", NONE, "the fitted valve leaves 121 mm² free", "check the chordae")
WIDE = FailedCheck("data against prior", DOUBTFUL, "the data narrow it to 80 %", "add a frame")


@pytest.mark.parametrize(
    ("verdict", "begins", "says"),
    [
        (Verdict(NONE, (LEAKS, WIDE), ("geometry",)), "NO ESTIMATE", "Next: check the chordae."),
        (Verdict(DOUBTFUL, (WIDE,), ("geometry",), ("closure",)), "DOUBTFUL", ANSWER),
        (Verdict(TRUSTWORTHY, (), ("geometry", "closure")), "TRUSTWORTHY", ANSWER),
    ],
)
def test_a_verdict_decides_what_is_stated(case, tmp_path, verdict, begins, says) -> None:
    record = case[0].model_copy(update={"verdict": verdict})
    written = report(record, tmp_path, arrays=case[1])
    page, terminal = Page(written[1].read_text(encoding="utf-8")).text, estimate_text(record)
    assert begins in page[:200]
    assert says in page
    assert terminal.startswith(f"made_up: {verdict.trust.upper()}")
    stated = verdict.trust != NONE
    assert ("5.8 MPa" in page, "5.8" in terminal) == (stated, stated)
    for one in verdict.failed_checks:
        assert one.text in terminal.partition("E_f anterior")[0]
        assert page.index(one.text[1:]) < page.index("Contents")


def test_moduli_before_their_calibration_stand_beside_them(case, tmp_path) -> None:
    row = {"patients": 57, "why": ""}
    plain = case[0].alternatives["moduli_only"]
    details = {**case[0].details, "calibration": (row,)}
    others = {**case[0].alternatives, UNCALIBRATED: plain}
    known = case[0].model_copy(update={"alternatives": others, "details": details})
    missing = {**details, "calibration": ({"patients": 0, "why": "the package has none"},)}
    none = case[0].model_copy(update={"details": missing})
    line = "Calibrated with 57 simulated patients; uncalibrated: E_f anterior 5.5 (4.9 to 6.1) MPa"
    absent = "The moduli are not calibrated with simulated patients: the package has none."
    for record, says in ((known, line), (none, absent)):
        written = report(record, tmp_path, arrays=case[1])
        page = Page(written[1].read_text(encoding="utf-8")).text
        assert page.count(says) == estimate_text(record).count(says) == 1
        assert page.index(says) < page.index("Verdict")
    assert "alibrated" not in estimate_text(case[0])


def test_tables_of_a_record(case) -> None:
    outside = case[0].with_truth({"E_f.anterior": 9.0, "E_f.posterior": 2.1})
    tables = report_tables(outside)
    marked = [row["estimate (95 % interval)"][-1] == "✗" for row in tables["moduli"].readable()]
    assert marked == [True, False]
    # 0.5 and 0.71 over 0.8, in per cent, the most useful first.
    assert [row["E_f anterior"] for row in tables["narrower"].rows] == pytest.approx([62.5, 88.75])
    strain, tenting, gap = tables["physiology"].readable()
    assert strain["value (5 to 95 % of the area)"] == "-0.9 (-3.6 to 1.2)"
    assert [row["mark"] for row in (strain, tenting, gap)] == [
        "", "outside", "inside",
    ]  # fmt: skip
    assert [row["published range"] for row in (tenting, gap)] == ["4 to 6", "at most 0"]
    (share,) = tables["resistance"].readable()
    assert share == {"leaflet": "anterior", "share of": "information on E_f"} | {
        "tension (%)": "1", "bending (%)": "99",
    }  # fmt: skip
    *_, volume, length = tables["measurements"].rows
    assert (volume["closed, generic"], length["closed, generic"]) == (1840.0, None)
