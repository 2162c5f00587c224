"""Tables 2 and 3, Figure 3 and the population, from made-up records."""

import copy
import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from experiments.common.cases.report import case_text, write_case_run
from experiments.results.keep import publish
from experiments.studies.patient import tables as patient_tables
from experiments.studies.patient.population import (
    population_figure,
    population_frame,
    write_population_tables,
)
from experiments.studies.patient.report import KEPT_ARRAYS
from experiments.studies.patient.study import STUDY
from experiments.studies.patient.tables import (
    figure3,
    in_order,
    table2,
    table3,
    write_patient_tables,
)
from mvest.errors import InputError
from mvest.problem.verdict import NONE, TRUSTWORTHY, Ground, Verdict
from mvest.reporting.case.fields import read_case_fields
from tests.experiments.studies.made_up_patients import (
    TRUTH,
    alone,
    distances,
    lost_patient,
    moduli,
    patient,
    unknown,
)
from tests.reporting.case.made_up_case import arrays

PLACE, DRAWN = Path("records") / "patients", Path("records") / "population"


def by_name(records) -> dict:
    """As the tables take them: in their order."""
    return in_order({record.findings.case.about.name: record for record in records})


def published(results, name, record, fields):
    """Publish a run that left ``fields`` in its folder."""
    folder = results / "run"
    folder.mkdir(exist_ok=True)
    shutil.copy(fields, folder / "fields.npz")
    return publish(STUDY, results, {name: (record, folder)})


@pytest.fixture(scope="module")
def fields_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("fields") / "fields.npz"
    stored = arrays(np.random.default_rng(1))
    known = {k: np.nan_to_num(v, nan=1.0) for k, v in stored.items() if k.startswith("distance")}
    np.savez(path, **stored | known)
    return path


def test_table2_lays_estimates_beside_the_truth():
    (anterior, posterior) = table2([patient()]).to_dict("records")
    assert anterior["patient"] == "normal_small"
    assert (anterior["modulus"], posterior["modulus"]) == ("E_f.anterior", "E_f.posterior")
    assert anterior["hidden truth [MPa]"] == 6.0
    assert anterior["estimate [MPa]"] == 5.8
    assert (anterior["95 % low [MPa]"], anterior["95 % high [MPa]"]) == pytest.approx((5.3, 6.3))
    assert anterior["inside"]
    assert anterior["without nuisances inside"]
    assert not posterior["without nuisances inside"]
    assert posterior["without nuisances [MPa]"] == 3.1
    assert posterior["paper's filter [MPa]"] == 4.0
    assert posterior["paper's filter ended"] == "no rounds left"
    assert [r["paper's estimate for its patient [MPa]"] for r in (anterior, posterior)] == [
        6.28, 2.61
    ]  # fmt: skip


def test_table3_says_how_much_closer_and_where_the_truth_is():
    closed, late = table3([patient()]).to_dict("records")
    # 2.0 mm to 0.5 mm is three quarters; 1.0 mm to 0.8 mm a fifth.
    assert closed["closer [%]"] == pytest.approx(75.0)
    assert late["closer [%]"] == pytest.approx(20.0)
    assert (closed["shown to the filter"], late["shown to the filter"]) == (True, False)
    assert closed["registered mean [mm]"] == 1.5
    assert closed["personalised to the truth [mm]"] == 0.25
    # The paper's distances are of the frame that its filter was shown.
    assert closed["paper generic [mm]"] == 1.5
    assert pd.isna(late["paper generic [mm]"])


def test_the_words_count_what_the_tables_hold(tmp_path):
    usual = patient().findings.case
    other = patient(
        "normal_large",
        unknowns=(*moduli(5.8, 4.0), *usual.unknowns[2:]),
        distances=(distances("closed", True, 1.0, 0.9, 1.2), usual.distances[1]),
    )
    write_patient_tables(tmp_path, by_name([patient(), other]), {})
    second = (tmp_path / "table2.md").read_text()
    assert "contains the truth for 3 of 4 moduli" in second
    assert "without nuisances for 2 of 4" in second
    assert "paper's filter for 0 of 4" in second
    # Widths of 1 MPa over 5.8, 2.1, 5.8 and 4.0 MPa: 0.17 to 0.48, mean 0.267.
    assert "over the estimate: 0.17 to 0.48, mean 0.27" in second
    # (1 - 0.3/0.4 + 1 - 0.1/0.4) / 2 = 50 %, and 5 %: the most first.
    assert "on average: pressure known by 50 %; registration known by 5 %." in second
    assert second.count("✗") == 1 + 2 + 4
    assert "Simulated valves" in second
    third = (tmp_path / "table3.md").read_text()
    # 75 % and -20 %: closer in one of two, 27.5 % on average.
    assert "shown: personalised closer than generic in 1 of 2, by 28 % on average" in third
    assert "laid rigidly on the closed frame in 1." in third
    assert "not shown: personalised closer than generic in 2 of 2, by 20 % on average" in third
    assert "laid rigidly on the closed frame in 0." in third


def test_patients_come_in_their_order_and_others_by_name(tmp_path):
    names = ["zebra", "prolapse", "aardvark", "normal_small", "fibroelastic"]
    assert list(by_name(patient(name) for name in names)) == [
        "normal_small", "prolapse", "fibroelastic", "aardvark", "zebra"
    ]  # fmt: skip


@pytest.mark.parametrize(
    "records", [[lost_patient()], [patient(), lost_patient()]], ids=["alone", "beside"]
)
def test_a_patient_without_an_estimate_is_in_the_tables(tmp_path, records):
    write_patient_tables(tmp_path, by_name(records), {})
    text = (tmp_path / "table2.md").read_text()
    assert "prolapse" in text
    assert "nan" not in text
    assert "prolapse" in (tmp_path / "table2.csv").read_text()
    if len(records) == 2:
        assert "contains the truth for 2 of 2 moduli" in text
        assert "prolapse" not in (tmp_path / "table3.md").read_text()
    else:
        assert "No estimation of these patients ended with moduli." in text


def test_moduli_whose_verdict_is_none_are_not_stated(tmp_path):
    # Both truths lie in its intervals; it is no less without an estimate.
    refused = patient("prolapse", verdict=Verdict(NONE, (Ground("gate", NONE, "open", "wait"),)))
    trusted = patient(verdict=Verdict(TRUSTWORTHY))
    kept = {"a": trusted, "b": refused}
    write_patient_tables(tmp_path, kept, {})
    text = (tmp_path / "table2.md").read_text(encoding="utf-8")
    row = next(line for line in text.splitlines() if line.startswith("| prolapse"))
    assert row.startswith("| prolapse | none | 6 | none |")
    third = (tmp_path / "table3.md").read_text(encoding="utf-8")
    assert third.count("| prolapse | none |") == third.count("| trustworthy |") == 2
    assert "none 1 of 1, by 20 %; trustworthy 1 of 1, by 20 % on average." in third
    assert "contains the truth for 2 of 2 moduli" in text
    assert "For 1 of 2 the verdict is that there is no estimate (prolapse)" in text
    write_population_tables(tmp_path, [trusted, refused])
    text = (tmp_path / "population.md").read_text(encoding="utf-8")
    assert "| with nuisances | E_f.anterior | 1 of 2 | 1 (100 %)" in text
    assert "with nuisances: the 95 % interval contains the truth 2 times of 2" in text
    assert "Called trustworthy: 1 patients, 2 of 2 moduli inside" in text


def test_a_patient_without_the_other_filters_is_in_the_tables(tmp_path):
    write_patient_tables(
        tmp_path, by_name([patient(without_nuisances=None, as_in_the_paper=None)]), {}
    )
    text = (tmp_path / "table2.md").read_text()
    assert "without nuisances for" not in text
    mixed = patient("prolapse", as_in_the_paper=alone(moduli(None, None), "no rounds left"))
    write_patient_tables(tmp_path, by_name([mixed]), {})
    text = (tmp_path / "table2.md").read_text()
    assert "without nuisances for 1 of 2" in text
    assert "paper's filter for" not in text


def test_publishing_keeps_a_patient_and_renews_the_tables(tmp_path, fields_file):
    written = published(tmp_path, "patients-normal-small", patient(), fields_file)
    assert {path.name for path in written} == {
        f"{table}.{kind}" for table in ("table2", "table3") for kind in ("csv", "md", "tex")
    } | {"figure3.png", "figure3.pdf"}
    kept = json.loads((tmp_path / PLACE / "patients-normal-small.json").read_text())
    assert kept["findings"]["case"]["unknowns"] == [
        asdict(row) for row in patient().findings.case.unknowns
    ]
    with np.load(tmp_path / PLACE / "patients-normal-small.npz") as stored:
        assert set(stored.files) <= set(KEPT_ARRAYS)
        assert "sensitivity" not in stored.files
        assert "truth" not in stored.files
    first = {path: path.read_bytes() for path in written}
    again = published(tmp_path, "patients-normal-small", patient(), fields_file)
    assert {path: path.read_bytes() for path in again} == first
    published(tmp_path, "patients-prolapse", patient("prolapse"), fields_file)
    table = pd.read_csv(tmp_path / "table2.csv", comment="#")
    assert list(table["patient"].unique()) == ["normal_small", "prolapse"]


def test_a_table_reads_back_as_it_was(tmp_path):
    write_patient_tables(tmp_path, by_name([patient(), patient("prolapse")]), {})
    back = pd.read_csv(tmp_path / "table3.csv", comment="#")
    pd.testing.assert_frame_equal(back, table3([patient(), patient("prolapse")]))
    assert (tmp_path / "table3.csv").read_text().startswith("# ")


def test_figure3_has_one_scale_for_all(fields_file, monkeypatch):
    fields = read_case_fields(fields_file)
    far = copy.copy(fields)
    object.__setattr__(far, "distance_generic", 5 * fields.distance_generic)
    seen = []
    true_colours = patient_tables.corner_colours
    monkeypatch.setattr(
        patient_tables,
        "corner_colours",
        lambda scale, *rest: seen.append(scale) or true_colours(scale, *rest),
    )
    figure = figure3({"near": fields, "far": far})
    assert len(seen) == 4
    assert len({id(scale) for scale in seen}) == 1
    (norm,) = {(scale.norm.vmin, scale.norm.vmax) for scale in seen}
    assert norm[0] == 0.0
    closed = far.distance_generic[far.closed]
    assert norm[1] > np.median(closed)
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert len(panels) == 4
    # The frame that the filter was shown, not the one that was held out.
    assert f"{np.mean(fields.distance_fitted[0]):.2f}" in panels[2].get_title()
    assert "five" not in figure.get_suptitle()
    assert "(simulated)" in figure.get_suptitle()


def test_figure3_says_where_there_is_no_estimate(fields_file):
    fields = read_case_fields(fields_file)
    figure = figure3({"sound": fields, "lost": fields}, ["lost"])
    titles = [axes.get_title() for axes in figure.axes[:4]]
    assert [title.startswith("NO ESTIMATE") for title in titles] == [False, False, False, True]


def test_figure3_needs_distances(fields_file):
    fields = copy.copy(read_case_fields(fields_file))
    object.__setattr__(fields, "distance_fitted", None)
    with pytest.raises(InputError, match="Figure 3 needs the distances"):
        figure3({"one": fields})


# -- the population ------------------------------------------------------------------------------
def population(n=20, misses=2):
    found = []
    for k in range(n):
        anterior = unknown("E_f.anterior", 7.0 if k < misses else 6.1 + 0.01 * k, 0.5)
        rows = (anterior, *patient().findings.case.unknowns[1:])
        found.append(patient(f"drawn_{k}", "population", unknowns=rows, as_in_the_paper=None))
    return found


def test_the_population_counts_how_often_intervals_hold(tmp_path):
    write_population_tables(tmp_path, population())
    text = (tmp_path / "population.md").read_text()
    line = next(x for x in text.splitlines() if "with nuisances" in x and "anterior" in x)
    assert "18 (90 %)" in line
    assert "68 to 99 %" in line
    assert "20 of 20" in line
    # Both moduli: 18 + 20 of 40, without nuisances 20 + 0 of 40.
    assert (
        "Both moduli, with nuisances: the 95 % interval contains the truth 38 times of 40" in text
    )
    assert "Both moduli, without nuisances: the 95 % interval contains the truth 20 times" in text
    shift = next(x for x in text.splitlines() if "shift.x" in x)
    # Errors of what may be zero are absolute: 0.1 - 0.4 mm.
    assert "-0.30" in shift
    scale = next(x for x in text.splitlines() if "pressure" in x)
    # (1.02 - 1.05) / 1.05 = -2.9 %, width 0.1 / 1.05 = 9.5 %.
    assert "-2.9 %" in scale
    assert "9.5 %" in scale
    table = population_frame(population())
    # Both moduli again as they are guessed.
    assert len(table) == 20 * (4 + 2 + 2 + 2)
    guesses = {"generic guess", "prior alone"}
    assert set(table["estimation"]) == {"with nuisances", "without nuisances", *guesses}
    # 1 for 6 is off by 83 %, and has no interval of its own; within exp(1.96) of 1 lies no 8.
    guess, before = (
        next(x for x in text.splitlines() if what in x and "anterior" in x)
        for what in ("| generic guess", "| prior alone")
    )
    assert guess.split(" | ")[3:] == ["–", "–", "-83.3 %", "83.3 %", "– |"]
    assert before.split(" | ")[3:5] == ["20 (100 %)", "83 to 100 %"]


def test_failures_of_the_population_are_counted_and_not_drawn(tmp_path):
    lost = [lost_patient("drawn_98", "population")]
    write_population_tables(tmp_path, [*population(4, 1), *lost])
    text = (tmp_path / "population.md").read_text()
    assert "4 of 5" in text
    assert "nan" not in text
    only = tmp_path / "only"
    only.mkdir()
    write_population_tables(only, lost)
    text = (only / "population.md").read_text()
    assert "0 of 1" in text
    assert "nan" not in text


def test_the_population_s_figure_draws_every_interval():
    figure = population_figure(population_frame(population(6, 2)))
    assert isinstance(figure, Figure)
    assert len(figure.axes) == 4
    legend = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert legend == ["contains the truth (4)", "does not (2)"]


def test_only_the_tables_parts_of_a_drawn_patient_are_kept(tmp_path, fields_file):
    record = population(1, 0)[0]
    published(tmp_path, "population-drawn-0", record, fields_file)
    kept = json.loads((tmp_path / DRAWN / "population-drawn-0.json").read_text())
    assert record.findings.case.settings
    assert kept["findings"]["case"]["settings"] == kept["findings"]["case"]["measurements"] == {}
    assert [path.suffix for path in (tmp_path / DRAWN).iterdir()] == [".json"]


def test_a_finished_case_says_what_was_estimated():
    text = case_text(patient())
    assert text.startswith("normal_small: converged")
    assert "5.8 (5.3 to 6.3) MPa  (hidden truth 6)" in text
    assert "frame late (not shown to the filter): 1.00 mm generic, 0.40 registered, 0.80" in text
    unknowns = patient().findings.case.unknowns
    own = patient(unknowns=tuple(replace(row, truth=None) for row in unknowns))
    assert "truth" not in case_text(own)
    assert case_text(lost_patient()).startswith("prolapse: the model failed")


def test_unknowns_of_a_case_as_a_table(tmp_path):
    (path,) = write_case_run(tmp_path, patient())
    table = pd.read_csv(path)
    assert list(table["name"]) == list(TRUTH)
    assert table["estimate"].tolist() == [5.8, 2.1, 1.02, 0.1]
