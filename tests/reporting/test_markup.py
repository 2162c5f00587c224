import pytest
from markdown_it import MarkdownIt

from mvest.reporting.markup import (
    latex_text,
    markdown_rows,
    markdown_text,
    number,
)
from mvest.reporting.tables import table

HOSTILE = r"<script>alert('x')</script> | `a` *b* [c](javascript:d) _e_ 5 % & $x$ \input{f} #1 ~"


def test_markdown_shows_hostile_text_as_it_stands() -> None:
    html = MarkdownIt("commonmark").enable("table").render(markdown_rows([{"name": HOSTILE}]))
    assert html.count("<td>") == 1
    for tag in ("<script", "<code", "<em", "<a "):
        assert tag not in html
    shown = html.split("<td>")[1].split("</td>")[0]
    for escaped, character in (("&lt;", "<"), ("&gt;", ">"), ("&amp;", "&")):
        shown = shown.replace(escaped, character)
    assert shown == HOSTILE


def test_ordinary_names_stay_legible_in_markdown() -> None:
    assert markdown_text("error E_f.anterior [%]") == "error E_f.anterior [%]"
    assert markdown_text("two\nlines") == "two lines"


def test_latex_prints_every_special_character() -> None:
    text = latex_text(HOSTILE)
    assert r"\textbackslash{}input\{f\}" in text
    assert r"\$x\$ " in text
    assert r"5 \% \& " in text
    assert r"\#1 \textasciitilde{}" in text
    assert "_" not in text.replace(r"\_", "")


def test_latex_table_has_equal_rows_and_true_numbers() -> None:
    tex = table([{"a": "P & Q", "b": "-3.5e-05 ± 1.0e-06"}, {"a": "x-y", "b": "–"}]).latex()
    lines = [line for line in tex.splitlines() if line.endswith(r"\\")]
    assert [line.count(" & ") for line in lines] == [1, 1, 1]
    assert r"P \& Q & $-$$3.5\times10^{-5}$ $\pm$ $1.0\times10^{-6}$ \\" in tex
    assert r"x-y & -- \\" in tex
    assert tex.startswith("\\begin{tabular}{lr}\n\\toprule\n")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (0, "0"),
        (6.2296, "6.23"),
        (123.4, "123"),
        (2e-5, "2.0e-05"),
    ],
)
def test_numbers_are_rounded(value: float | None, text: str) -> None:
    assert number(value) == text
