"""The study of chordae by family, on a few elements that hardly move."""

import numpy as np
import pytest

from experiments.common.building.whole_cycle import Bound
from experiments.common.records.record import Record
from experiments.studies.chord.findings import Findings as ChordFindings
from experiments.studies.chord.findings import Fit as ChordFit
from experiments.studies.chord.study import STUDY as CHORD
from tests.experiments.runner.logged import logged
from tests.experiments.studies.made_up import made_up

TINY = (
    "mesh.columns=8",
    "mesh.rows=1",
    "observation.columns=16",
    "observation.rows=5",
    "mechanics.contact_points.columns=16",
    "mechanics.contact_points.rows=5",
    "cycle.protocol.rise=0.1",
    "cycle.protocol.hold=0.05",
    "cycle.protocol.fall=0.1",
    "cycle.protocol.dt=0.05",
    # The paper's damping: steps this long fail with less, and cost seconds until they are halved.
    "mechanics.damping.beta=0.1",
    "cycle.protocol.pressure_mmHg=10",
    "cycle.protocol.times=[0.0,0.05,0.1,0.15]",
    "cycle.finer_columns=10",
    "cycle.finer_rows=1",
    "cycle.check_columns=12",
    "cycle.check_rows=1",
    "cycle.check_contact=[24,5]",
    "cycle.seeds=2",
    "tracking.enabled=false",
)


@pytest.fixture
def run(run_here):
    return lambda *arguments: run_here(*TINY, *arguments)


def test_every_chordal_family_is_estimated_from_both_sets_of_frames(run):
    status, record, folder, said = run(
        "experiment=chord", "truth.values=[6,2,0.9,1.1,0.97,0.97]", "cycle.noise_mm=0.05"
    )
    assert status == 0, said.err
    found = record["findings"]
    first = [entry for entry in found["results"] if entry["seed"] == 0]
    assert [entry["frames"] for entry in first] == ["open and closed", "whole cycle"]
    prior, (two, whole) = np.array(found["prior_std"]), (np.array(e["std"]) for e in first)
    # Data never widen the posterior by more than its change of place, and more data tell more.
    assert np.all(two < 1.2 * prior)
    assert np.sum(np.log(whole)) < np.sum(np.log(two))
    assert len([e for e in found["results"] if e["frames"] == "whole cycle"]) == 2
    assert logged(folder)["std.chord_stiffness.basal"] == whole[3]
    assert (folder / "chord.png").is_file()


def chord_record() -> Record[ChordFindings]:
    def fit(frames: str, *std: float) -> ChordFit:
        correlation = ((1.0, -0.7), (-0.7, 1.0))
        return ChordFit(
            frames, 0, "converged", "converged", (6.1, 1.01), (0.01, 0.01), std, correlation, 2.1, 4
        )

    def bound(frames: str, *std: float | None) -> Bound:
        return Bound(frames, 2, std, (), 1.0, ())

    findings = ChordFindings(
        truth=(6.0, 1.0), start=(5.0, 1.1), prior_std=(0.5, 0.3), noise_mm=0.5, times=(0.0, 1.0),
        vertices=9,
        results=(fit("open and closed", 0.3, 0.29), fit("whole cycle", 0.1, 0.14)),
        bounds=(bound("open and closed", 0.4, None), bound("whole cycle", 0.1, 0.16)),
        measures={},
    )  # fmt: skip
    return made_up(findings, parameters=("E_f.anterior", "chord_stiffness.basal"))


def test_identified_is_what_the_data_make_twice_as_sure(tmp_path):
    record = chord_record()
    text = CHORD.words(record)
    # 10 % of 50 % is, 30 % of 50 % is not; 14 % of 30 % is, 29 % of 30 % is not.
    modulus, chord = (line for line in text.splitlines() if line.startswith(("| ant", "| bas")))
    assert modulus.endswith("| whole cycle |")
    assert chord.endswith("| whole cycle |")
    assert "(unbounded)" in chord
    assert "-0.70" in text
    assert len(CHORD.write(tmp_path, {"made_up": record}, {})) == 4
