import re

from markdown_it import MarkdownIt

from mvest.reporting.markup import markdown_rows
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


def test_latex_prints_every_special_character() -> None:
    tex = table([{"a": HOSTILE, "b_c": "5 ± 1"}, {"a": "x-y\nz", "b_c": "–"}]).latex()
    lines = [line for line in tex.splitlines() if line.endswith(r"\\")]
    assert [len(re.findall(r"(?<!\\)&", line)) for line in lines] == [1, 1, 1]
    assert r"a & b c \\" in tex
    for escaped in (r"input\{f\}", r"\$x\$ ", r"5 \% \& ", r"\#1 \textasciitilde", "x-y z & –"):
        assert escaped in tex
    assert tex.startswith("\\begin{tabular}{lr}\n\\toprule\n")
