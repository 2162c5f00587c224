"""The page of one case. What it shows is made up; see `tests.reporting.case.made_up_case`."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.reporting.case import words
from mvest.reporting.case.findings import About, CaseFindings
from mvest.reporting.case.report import write_case_report
from tests.reporting.case.made_up_case import LINE, PROVENANCE, made_up_case, poisoned

SECTIONS = (
    "case", "valve-shapes", "figure3", "estimates", "identifiability", "iterations", "innovation",
    "held-out", "measurements", "narrow", "settings",
)  # fmt: skip
PICTURES = (
    "shapes", "figure3", "estimates", "identifiability", "iterations", "innovation",
    "innovation_map", "distances", "narrow",
)  # fmt: skip
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


def quickly(*arguments):
    """The same report with coarse pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvest.reporting.figures.DPI", 30)
        patch.setattr("mvest.reporting.case.drawing.MAX_SPLITS", 0)
        return write_case_report(*arguments)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return made_up_case(tmp_path_factory.mktemp("case"))


@pytest.fixture(scope="module")
def written(case, tmp_path_factory):
    return write_case_report(tmp_path_factory.mktemp("report") / "new", *case, LINE, PROVENANCE)


@pytest.fixture(scope="module")
def html(written):
    return written[0].read_text(encoding="utf-8")


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


def test_the_answer_stands_at_the_top(html) -> None:
    # 5.8 ± 1.96 x 0.8 and 2.2 ± 1.96 x 0.3, to two digits.
    told = Page(html).text.replace("\N{NO-BREAK SPACE}", " ")
    assert (
        "E_f anterior 5.8 MPa (95 % interval 4.2 to 7.4); "
        "E_f posterior 2.2 MPa (95 % interval 1.6 to 2.8)."
    ) in told
    assert told.index("E_f anterior 5.8 MPa") < told.index("Contents")


def test_what_was_learned_of_the_errors_stands_beside_what_was_believed(case) -> None:
    (row,) = words.error_rows(case[0].errors)
    assert row == {
        "errors of the closed frame": "rough part [mm]",
        "believed": "0.12",
        "95 %": "0.014 to 1.03",
        "learned": "0.205",
        "its 95 % interval": "0.198 to 0.212",
    }


def test_what_the_data_hardly_tell_apart_is_named(html) -> None:
    assert (
        "The data hardly tell apart E_f anterior and slack of the chordae (correlations of at "
        "least 0.957): +10 % of E_f anterior with −3.1 % of slack of the chordae looks almost the "
        "same."
    ) in Page(html).text


def test_the_page_loads_nothing_and_is_not_too_large(written, html) -> None:
    local = {path.name for path in written}
    outside = [
        a for a in Page(html).addresses if not a.startswith(("#", "data:")) and a not in local
    ]
    assert outside == []
    # Whatever a script might ask for, the policy refuses it.
    assert "default-src 'none'" in html
    assert not re.search(r"(script|img|connect|default)-src[^;\"]*https?:", html)
    assert written[0].stat().st_size < MAX_BYTES


def test_pictures_are_written_as_png_and_pdf(written) -> None:
    found = {path.name for path in written[1:]}
    assert found == {f"{name}.{kind}" for name in PICTURES for kind in ("png", "pdf")}
    starts = {".png": b"\x89PNG", ".pdf": b"%PDF"}
    assert all(path.read_bytes().startswith(starts[path.suffix]) for path in written[1:])
    assert b"commit 0123456789ab" in written[1].read_bytes()


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
    """Findings in which every name and sentence is a script."""
    findings, path = case

    def hostile(value):
        return poisoned(value, HOSTILE + "$\\frac$")

    poisonous = replace(
        hostile(findings),
        settings={HOSTILE: HOSTILE},
        measurements={HOSTILE: {HOSTILE: {HOSTILE: 1.0}}},
    )
    folder = tmp_path_factory.mktemp("hostile")
    written = quickly(folder, poisonous, path, hostile(LINE), hostile(PROVENANCE))
    return written[0].read_text(encoding="utf-8")


def test_text_of_the_record_is_escaped(hostile_page, html) -> None:
    assert HOSTILE not in hostile_page
    # As many scripts as in the page of the harmless record.
    assert Page(hostile_page).scripts == Page(html).scripts
    assert "alert(1)" in Page(hostile_page).text


def test_the_closing_anew_answers_whether_there_is_another_closed_state(html) -> None:
    # And not whether one closed frame determines the moduli, which the run does not ask.
    assert "Is the closed state the only one?</strong> Closed anew from the open valve" in html


@pytest.fixture(scope="module")
def bare_page(case, tmp_path_factory):
    """Of almost empty findings, and fields of a run that gave up before it predicted anything."""
    folder = tmp_path_factory.mktemp("bare")
    with np.load(case[1]) as stored:
        kept = ("triangles", "region", "rest", "annulus", "frames", "seen")
        np.savez(folder / "fields.npz", **{name: stored[name] for name in kept})
    bare = CaseFindings(about=About("Nothing yet"), converged=False, reason="no equilibrium")
    pages = [quickly(folder / name, bare, folder / "fields.npz") for name in ("page", "again")]
    assert pages[0][0].read_bytes() == pages[1][0].read_bytes()
    return pages[0]


def test_what_is_missing_is_said(bare_page) -> None:
    page = Page(bare_page[0].read_text(encoding="utf-8"))
    assert [name for name in page.ids if name in SECTIONS] == list(SECTIONS)
    for sentence in (
        "No stiffness was estimated: no equilibrium.",
        "The run did not check whether the fitted closed state",
        "The record names nothing that was derived",
        "The record lists no moduli.",
        "The record lists no parameters.",
        "The record has no analysis of identifiability.",
        "The record has no tests of the innovation.",
        "The errors of the frame were taken as they are stated.",
        "No frame was held out",
        "The record has no distances.",
        "The record has no measurements.",
        "The record has no settings.",
        "The record does not say where it came from.",
        "Figure 3 needs",
        "the run kept no iterates",
        "the run stored no sensitivities",
    ):
        assert sentence in page.text
    # Only what was stored is drawn, and nothing says nan or None.
    assert [path.name for path in bare_page[1:]] == ["shapes.png", "shapes.pdf"]
    assert not re.search(r"\b(nan|None)\b", page.text)


@pytest.fixture(scope="module")
def partial_page(case, tmp_path_factory):
    """What a run may leave out is None, and the closed frame was seen as points."""
    findings, path = case
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["observed_points_closed"] = arrays.pop("observed")[0, 4:]
    folder = tmp_path_factory.mktemp("partial")
    np.savez(folder / "fields.npz", **arrays)
    partial = replace(
        findings,
        without_nuisances=None,
        identifiability=None,
        innovation=None,
        confirmed_mm=None,
        moduli=tuple(replace(m, truth=None) for m in findings.moduli),
        unknowns=tuple(replace(p, truth=None) for p in findings.unknowns),
        distances=tuple(replace(d, to_truth=None) for d in findings.distances),
    )
    return quickly(folder, partial, folder / "fields.npz")[0].read_text(encoding="utf-8")


def test_nulls_are_left_out(partial_page) -> None:
    page = Page(partial_page)
    assert "did not repeat the estimation with the nuisances taken as known" in page.text
    assert "truth within the interval" not in page.text
    assert "true values are known" not in " ".join(page.text.split())
    assert not re.search(r"\b(nan|None)\b", page.text)


def test_a_frame_that_does_not_correspond_is_shown_as_points(partial_page) -> None:
    labels = re.findall(r'data-shown="[^"]*">([^<]*)<', partial_page)
    assert "closed, observed" in labels
    assert "observed (grey) over personalised" in labels
    assert "picture-shapes" in partial_page


def test_an_unusable_place_or_file_is_one_clear_error(case, tmp_path) -> None:
    with pytest.raises(InputError, match="no fields of a case"):
        write_case_report(tmp_path, case[0], tmp_path / "none.npz")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        write_case_report(tmp_path / "file" / "page", *case)


# --- words --------------------------------------------------------------------------------------


def test_a_donor_tricuspid_valve_is_named_as_one(case) -> None:
    findings, _ = case
    about = replace(findings.about, simulated=False, source="a donor's tricuspid valve")
    donor = replace(findings, about=about)
    assert words.badges(donor) == ["DONOR TRICUSPID", "NOT FOR DIAGNOSIS"]
    assert words.badges(findings) == ["SIMULATED", "NOT FOR DIAGNOSIS"]


def test_the_steps_of_a_failed_run_are_of_all_unknowns_or_say_of_which(case) -> None:
    findings = case[0]
    every = words.iterate_rows(findings)
    shown = [p.label for p in findings.unknowns if p.treatment == "estimated"]
    assert [row["unknown"].partition(" [")[0] for row in every[:-1]] == shown
    assert every[0]["start"] == "4"
    assert every[0]["3"] == "5.8"
    # The objective of a step at which the model failed is not known.
    failed = replace(findings, converged=False, objective=(920.0, 340.0, 301.0, None))
    assert words.iterate_rows(failed)[-1]["3"] == "–"
    # Two columns of three estimated unknowns: those of the moduli, and what of the third.
    moduli = replace(findings, iterates=((4.0, 3.0), (5.2, -2.4)))
    assert len(words.iterate_rows(moduli)) == 3
    assert "Without steps: " in words.iterate_words(moduli)
    assert findings.unknowns[2].label in words.iterate_words(moduli)
    odd = replace(findings, iterates=((4.0,),))
    assert words.iterate_rows(odd)[0]["unknown"] == "value 1"
    assert "which value is whose it does not say" in words.iterate_words(odd)


def test_a_run_that_did_not_converge_says_so_at_the_top(case) -> None:
    # Its last iterate still stands in the answer.
    assert "RUN FAILED" in words.badges(replace(case[0], converged=False))
    assert "RUN CONVERGED" not in words.badges(case[0])


def test_a_truth_outside_its_interval_is_not_hidden(case) -> None:
    findings, _ = case
    outside = tuple(replace(m, truth=m.high + 0.1) for m in findings.moduli)
    rows = words.moduli_rows(replace(findings, moduli=outside))
    assert [row["truth within the interval"] for row in rows] == ["NO", "NO"]


def test_a_worse_prediction_of_a_held_out_frame_is_not_hidden(case) -> None:
    findings, _ = case
    worse = tuple(
        replace(d, generic=d.personalised, personalised=d.generic) for d in findings.distances
    )
    assert "NOT nearer" not in words.distance_words(findings)
    assert "NOT nearer" in words.distance_words(replace(findings, distances=worse))


def test_the_best_knowledge_is_named(case) -> None:
    # 0.8 to 0.5 is less by 37.5 %.
    said = words.narrow_words(case[0].narrow)
    assert "if the chordae were known" in said
    assert "by 38\N{NO-BREAK SPACE}%, from 0.8 to 0.5" in said


def test_units_of_measurements_are_read_from_their_names(case) -> None:
    rows = words.measurement_rows(case[0])
    assert [row["measurement"] for row in rows][:3] == [
        "AP diameter [mm]",
        "commissural diameter [mm]",
        "annulus height [mm]",
    ]
    assert list(rows[0])[1:] == [
        "open, observed",
        "closed, observed",
        "closed, generic",
        "closed, personalised",
    ]
    assert rows[4]["measurement"] == "tenting volume [mm³]"
    assert [rows[4]["closed, generic"], rows[5]["closed, generic"]] == ["1840", "–"]
