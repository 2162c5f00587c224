"""Pages in a real browser whose every text is an attack: nothing runs, no page is broken."""

import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest

from mvest.reporting.case.report import report
from tests.experiments.runner.screenshot import look_at
from tests.reporting.case.made_up_case import (
    LINE,
    PROVENANCE,
    made_up_case,
    poisoned,
    poisoned_record,
)

needs_browser = pytest.mark.skipif(
    not (shutil.which("chromium") or shutil.which("chromium-browser")),
    reason="Chromium is not installed (Debian: apt install chromium)",
)

RUN = "document.documentElement.dataset.ran=1"
"""What an attack does, if it runs, for the test to see."""

HOSTILE = (
    f"<script>{RUN}</script></script></title></style><script>{RUN}</script>"
    f'<img src=x onerror={RUN}><svg onload={RUN}></svg>" onerror="{RUN}" onmouseover=\'{RUN}\' '
    "{{7*7}} {% raw %} ]]> --> $\\frac$ \u202egnp.exe\u202c \u2066a\u200f\n\r\n\u2028\ta"
)
LONG = HOSTILE + "W" * 10_000

ACTING = re.compile("[\u200e\u200f\u202a-\u202e\u2066-\u2069\u2028]")


class Seen(HTMLParser):
    """What a browser made of a page: its elements, its handlers of events, and its root."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.handlers: list[str] = []
        self.addresses: list[str] = []
        self.root: dict[str, str | None] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.handlers += [name for name, _ in attrs if name.startswith("on")]
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag == "html":
            self.root = dict(attrs)


STEP = {"unlike": LONG, "sentences": [LONG], "files": [LONG, f"javascript:{RUN}"], "volume": LONG}
"""From images to a valve, all of whose words are an attack."""


@pytest.fixture(scope="module")
def case_page(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("case")
    record, shapes = made_up_case(folder)
    hostile = poisoned_record(
        record,
        LONG,
        settings=[{"setting": LONG, "value": LONG}],
        measurements=[{"frame": LONG, "shape": LONG, LONG: 1.0}],
        image_step=[STEP],
        image_frames=[{"frame": 1}],
        pictures=[{"file": LONG, "caption": LONG}, {"file": "missing.png", "caption": LONG}],
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvest.reporting.figures.DPI", 30)
        patch.setattr("mvest.reporting.case.drawing.MAX_SPLITS", 0)
        written = report(
            hostile,
            folder,
            arrays=shapes,
            line=poisoned(LINE, LONG),
            provenance=poisoned(PROVENANCE, LONG),
        )
    return written[1]


@needs_browser
def test_nothing_that_a_record_says_runs_nor_a_script_that_slipped_in(case_page) -> None:
    slipped, attack = case_page.with_name("slipped.html"), f"<img src=x onerror={RUN}>"
    text = case_page.read_text(encoding="utf-8")
    slipped.write_text(text.replace("<header>", f"<header>{attack}"), encoding="utf-8")
    page = look_at(slipped.as_uri(), "--dump-dom")
    seen = Seen(page)
    assert "data-ran" not in seen.root
    assert seen.handlers == ["onerror"]  # that of the attack, which the policy stops
    assert not {"iframe", "object", "embed", "base"} & set(seen.tags)
    assert not [address for address in seen.addresses if address.startswith("javascript:")]
    assert "js-plotly-plot" in page
    # It runs on a page without the policy.
    slipped.write_text(f"<html><body>{attack}</body></html>", encoding="utf-8")
    assert Seen(look_at(slipped.as_uri(), "--dump-dom")).root["data-ran"] == "1"


def test_characters_that_act_are_named_and_what_is_cut_is_said(case_page) -> None:
    text = case_page.read_text(encoding="utf-8")
    text = re.sub("<script.*?</script>", "", text, flags=re.DOTALL)
    assert not ACTING.search(text)
    assert "[U+202E]gnp.exe[U+202C]" in text
    assert "characters)" in text
