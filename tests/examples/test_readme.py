"""The README and a page beside it: examples run, Table 1 is the published one, links lead on."""

import pkgutil
import re

import pytest

from tests.places import ROOT

TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_prints_what_it_says(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    lines = [line for line in code.splitlines() if line.strip()]
    assert len([line for line in lines if not line.startswith((" ", "import"))]) <= 12
    exec(compile(code, "README.md", "exec"), {})
    promised = re.search(r"# (\[.*\]) MPa$", lines[-1])
    assert promised is not None
    assert capsys.readouterr().out.strip() == promised[1]


def test_the_page_on_own_models_is_right(capsys):
    page = (ROOT / "docs" / "own_model.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", page, flags=re.DOTALL)
    assert code is not None
    names = {}
    exec(compile(code[1], "own_model.md", "exec"), names)
    assert names["estimate"].converged
    assert names["estimate"].mean[0] == pytest.approx(2.0, rel=0.02)
    assert "stiffness" in capsys.readouterr().out


def cells(line):
    return [cell.strip().strip("*") for cell in line.strip("|").split("|")]


def test_table_1_is_the_published_one():
    published = (ROOT / "results" / "table1.md").read_text(encoding="utf-8")
    rows = {row[0]: row for row in map(cells, published.splitlines()) if len(row) > 8}
    wanted = [*range(5), *map(rows["run"].index, ("distance (mm)", "forward solves", "ended"))]
    section = TEXT.partition("## Table 1")[2].partition("\n## ")[0]
    shown = [cells(line) for line in section.splitlines() if line.startswith("|")][2:]
    assert [row[0] for row in shown] == list(rows)[2:]
    for row in shown:
        # Of the columns of the published table: estimates, their errors, distance, solves and end.
        assert row == [rows[row[0]][k] for k in wanted]


def test_local_links_lead_somewhere():
    targets = re.findall(r"\]\((?!https?:|#)([^)#]+)", TEXT)
    assert len(targets) > 15
    assert [target for target in targets if not (ROOT / target).exists()] == []


PAGES = [
    *(
        path
        for folder in ("docs", "docs/study_notes")
        for path in sorted((ROOT / folder).glob("*.md"))
    ),
    *sorted((ROOT / "mvest").rglob("README.md")),
    *(ROOT / name for name in ("CONTRIBUTING.md", "README.md", "CHANGELOG.md")),
]
MADE = ("tenting", "NAME", "HASH", "_build", "*")
"""Parts of paths that are placeholders, or that a page explains how to make."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_a_page_names_exists(page):
    quoted = re.findall(r"`([^`\n]+)`", page.read_text(encoding="utf-8"))
    paths = [q for q in quoted if re.fullmatch(r"(mvest|experiments|tests|conf|docs)/[\w./*-]+", q)]
    missing = [p for p in paths if not any(m in p for m in MADE) and not (ROOT / p).exists()]
    assert missing == []
    for name in (q for q in quoted if re.fullmatch(r"mvest(\.\w+)+", q)):
        assert resolves(name), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_line_of_a_page_is_a_comment(page):
    # MyST hides a line that begins with a percent sign, as a wrapped number may leave it.
    lines = page.read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if line.lstrip().startswith("%")] == []


def resolves(name):
    """Whether a dotted name is a module or something in one."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True
