"""Numbers of texts come from results: each source is read, and no text holds another number."""

import re
import shutil
from pathlib import Path

import pytest

from experiments.results.believed import MODES, TARGETS, believed, missed
from experiments.results.quoted import MARKED, quoted, requote, requoted
from mvest.errors import InputError
from tests.places import ROOT

RESULTS = ROOT / "results"
CSV = """# a: the line of its origin
group,which,share [%],n,factor
one,a,12.345,3,1.0
one,b,-0.04567,4,
two,"a, b",100.0,5,1234.5
"""


@pytest.fixture
def results(tmp_path) -> Path:
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "made_up.csv").write_text(CSV)
    (tmp_path / "results" / "made_up.md").write_text(
        "# A\n\n| run | E (MPa) | n |\n| --- | --- | --- |\n"
        "| one | 6.2 ± 0.1 | 7 |\n| two | – | 8 |\n"
    )
    return tmp_path / "results"


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("made_up > one > a > share", "12"),
        ("made_up > one > b > share", "-0.046"),
        ("made_up > one > b > share : +.1e", "-4.6e-02"),
        ("made_up > one > a > n", "3"),
        ("made_up > one > a > factor", "1"),
        ("made_up > two > share", "100"),
        ("made_up > two > a, b > factor : .0f", "1234"),
    ],
)
def test_a_source_names_one_number(results, source, text):
    assert quoted(source, results) == text


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("made_up > one > share", "has 2 rows one, expected one"),
        ("made_up > three > share", "has 0 rows three"),
        ("made_up > two > width", "has no width"),
        ("made_up > one > a > which", "'a' is no number"),
        ("made_up > one > b > factor", "'' is no number"),
        ("nowhere > one > share", "nowhere.csv: there is no such table"),
        ("made_up > share", "expected TABLE > ROW > COLUMN"),
    ],
)
def test_a_wrong_source_is_refused_in_one_line(results, source, words):
    with pytest.raises(InputError, match=words) as refused:
        quoted(source, results)
    assert "\n" not in str(refused.value)


def test_a_text_is_written_again_where_results_have_moved(results):
    text = (
        "A share of 11<!-- made_up > one > a > share --> %, not 11 %; "
        "**-0.4<!-- made_up > one > b > share : .1f -->**.\n\n"
        "<!-- made_up.md > n > run -->\n\n| count | name |\n|---|---|\n| 1 | x |\n"
        "\nAn end <!-- that is a > comment --> of 5 <!-- words -->.\n"
    )
    path = results.parent / "README.md"
    path.write_text(text)
    assert requote(path, results) == [path]
    expected = text.replace("11<", "12<").replace("-0.4<", "-0.0<")
    assert path.read_text() == expected.replace("| 1 | x |", "| 7 | one |\n| 8 | two |")
    assert requote(path, results) == []
    assert requote(results / "no such file", results) == []


def test_the_readme_says_what_results_say():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(MARKED.findall(text)) > 20
    assert requoted(text, RESULTS) == text, "run `mvest tables`"


def test_every_number_of_the_documentation_has_a_source():
    texts = [ROOT / "docs" / "limits.md", *(ROOT / "docs" / "study_notes").glob("*.md")]
    sources = [
        source
        for path in texts
        for source in re.findall(r"\{result\}`([^`]*)`", path.read_text(encoding="utf-8"))
    ]
    assert len(sources) > 100
    for source in sources:
        assert re.fullmatch(r"[-+]?[\d.]+", quoted(source, RESULTS)), source


# --- what may be believed -----------------------------------------------------------------------


def test_modes_of_use_agree_with_the_tables_of_their_studies():
    rows = {row["mode"]: row for row in believed(RESULTS).rows}
    assert set(rows) == {mode.name for mode in MODES if mode.runs(RESULTS)}
    assert len(rows) >= 5
    for mode, key, source in (
        ("volume", "median error", "volume_skill > the volume > median error"),
        ("volume", "guess", "volume_skill > the volume > generic guess"),
        ("volume", "bias posterior", "volume_bias > the volume, E_f.posterior > bias"),
        ("volume", "SE posterior", "volume_bias > the volume, E_f.posterior > bias SE"),
        ("volume", "coverage", "volume_verdicts > trustworthy > coverage"),
        ("known geometry", "mean square", "population_verdicts > trustworthy > mean square"),
        (
            "known geometry",
            "ratio",
            "population_quantities > ratio of E_f anterior to posterior > median error",
        ),
        ("five patients", "median error", "patients_moduli > with nuisances > median error"),
        ("Table 1", "anterior off", "table1 > independent truth > error E_f.anterior"),
    ):
        found, expected = abs(rows[mode][key]), float(quoted(f"{source} : .12g", RESULTS))
        assert found == pytest.approx(abs(expected), rel=1e-9), (mode, key)
    # The scenario without a wrong assumption is none; each run has two moduli.
    every = int(quoted("calibration_warning > moduli > intervals", RESULTS))
    right = int(quoted("calibration > reference > n", RESULTS))
    assert rows["wrong assumptions"]["n"] == (every - right) // 2


def test_a_mode_that_misses_a_target_says_by_how_much_and_comes_first():
    found = believed(RESULTS).rows
    counts = [len(missed(row)) for row in found]
    assert counts == sorted(counts, reverse=True)
    row = {
        "error over guess": 0.4,
        "anterior in SE": -1.9,
        "posterior in SE": 3.0,
        "posterior off": -18.2,
        "posterior off SE": 5.0,
        "judged coverage": None,
        "judged square": 1.26,
        "lost": 2 / 30,
        "without": 2,
        "n": 30,
    }
    assert missed(row) == [
        "posterior moduli off by -18 ± 5 % on average (within two standard errors)",
        "mean square of trusted errors 1.26 (0.8 to 1.25)",
    ]
    assert (
        missed({**row, "lost": 3 / 30, "without": 3})[-1]
        == "3 of 30 without an estimate (at most 4 of 60)"
    )
    assert {target.column for target in TARGETS} <= set(found[0])


def test_modes_without_records_have_no_row(tmp_path):
    place = tmp_path / "records"
    place.mkdir()
    shutil.copy(RESULTS / "records" / "population.jsonl", place)
    assert believed(tmp_path).values["mode"] == ["known geometry"]
