"""The study of a stiff patch, on a few elements that hardly move."""

import re
from dataclasses import replace

import numpy as np
import pytest

from experiments.studies.patch.findings import Compared, Places
from experiments.studies.patch.findings import Findings as PatchFindings
from experiments.studies.patch.findings import Fit as PatchFit
from experiments.studies.patch.study import STUDY as PATCH
from mvest.mechanics.settings import ModulusField, StiffPatch
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


FEW = (
    # Meshes this coarse differ by more than they move: assumed noise is above that.
    "cycle.noise_mm=0.5",
    "parameters=[E_f.anterior,E_f.posterior,field.anterior.0,field.anterior.1,field.anterior.2]",
    "filter.initial=[6.0,2.2,0,0,0]",
    "filter.P0=[0.1,0.01,0.1,0.1,0.1]",
    "mechanics.fields.anterior.modes=3",
)


def test_a_patch_is_compared_with_the_truth_where_it_is(run):
    status, record, folder, said = run("experiment=patch", "patch.compared=true", *FEW)
    assert status == 0, said.err
    found = record["findings"]
    assert set(found["results"]) == {"patch", "no patch"}
    fits = [found["results"][label] for label in ("patch", "no patch")]
    with_patch, without = (fit["compared"] for fit in fits)
    # The truth is the leaflet's modulus, twice as much at the centre, and nowhere else.
    assert max(without["truth"]) == pytest.approx(6.23)
    assert min(with_patch["truth"]) == pytest.approx(6.23)
    assert 6.23 * 1.5 < with_patch["true_at_centre"] <= 2 * 6.23 + 1e-9
    # The other mesh is another object, and the noise the same: only the truth differs.
    assert found["cells_of_truth"] != record["model"]["cells"][:2]
    assert with_patch["at_centre"] != without["at_centre"]
    # What is said of the highest modulus is what the map has.
    assert with_patch["peak"] == pytest.approx(max(with_patch["modulus"]))
    modulus, truth = np.array(with_patch["modulus"]), np.array(with_patch["truth"])
    assert np.all(modulus > 0)
    assert with_patch["rms_log_error"] <= np.abs(np.log(modulus / truth)).max()
    # More lies within wider limits, and what is left is noise of 0.5 mm.
    for fit in fits:
        entry = fit["compared"]
        assert entry["shift_rms"] > 0
        assert entry["within_two_with_shift"] >= entry["within_two_std"]
        assert 0.45 < fit["residual_mm"] < 0.7
    assert logged(folder)["peak"] == with_patch["peak"]
    assert (folder / "patch.png").is_file()
    assert "half the patch's radius" in said.out


def test_tables_say_what_missed_its_target(tmp_path):
    compared = Compared(
        truth=(6.0, 12.0, 6.0), modulus=(6.0, 9.0, 6.0), log_std=(0.1, 0.2, 0.1),
        at_centre=9.0, true_at_centre=12.0, log_std_at_centre=0.2, peak=9.0, peak_log_std=0.2,
        peak_distance_mm=4.0, outside=6.0, rms_log_error=0.1, within_two_std=0.9,
        shift_rms=None, within_two_with_shift=None,
    )  # fmt: skip
    with_patch = PatchFit("converged", "converged", (), (), 4, 0.5, compared, "no cycle")
    without = replace(with_patch, compared=replace(compared, truth=(6.0,) * 3))
    findings = PatchFindings(
        truth=(6.0, 2.0), patch=StiffPatch("anterior", (0.0, 0.0, 0.0), 7.0, 2.0),
        field=ModulusField(correlation_length_mm=5.0, std_log=0.4, modes=3), share=0.5,
        noise_mm=0.5, times=(0.0, 1.0), vertices=9, cells_of_truth=(36, 4), prior_std=(),
        map=Places((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), ((0, 1, 2),)),
        results={"patch": with_patch, "no patch": without}, measures={},
    )  # fmt: skip
    record = made_up(findings)
    text = PATCH.words(record)
    # 9 of 12 MPa is 25 % less; 4 mm is more than 3.5 mm.
    assert "-25 % off, target 20 %: missed" in text
    assert "may shift is not known (no cycle)" in text
    assert re.search(r"Place 4\.0 mm off, target 3\.5 mm .*: missed", text)
    files = PATCH.write(tmp_path, {"made_up": record}, {})
    assert {path.suffix for path in files} == {".csv", ".md", ".png", ".pdf"}
