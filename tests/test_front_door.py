"""The front door: what `import mvest` offers is enough, loads late, and is known to type checkers.

The functions of the first part name nothing of the library but `mvest`.
"""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import mvest
from tests.made_up_closure import made_up_case, use
from tests.places import ROOT

REGIONS = ("anterior", "posterior")
MODULI = tuple(f"E_f.{region}" for region in REGIONS)
TISSUE = {"anterior": mvest.TissueSettings(ratio=2.65), "posterior": mvest.TissueSettings(1.11)}


def small_model() -> mvest.ClosureModel:
    """A coarse valve that a low pressure moves in two steps without closing it."""
    template = mvest.Template(
        mvest.TemplateParameters().changed({"annulus.anteroposterior_diameter": 27.6})
    )
    protocol = mvest.ClosureProtocol(5.0, ramp=0.1, dt=0.05, end=0.1, equilibrium=False)
    return mvest.ClosureModel(
        template.valve(24, 7),
        template.valve(48, 20),
        mvest.structured_mesh(template, "hex18", 24, 3),
        mvest.MechanicsSettings(TISSUE, protocol),
        MODULI,
    )


def test_moduli_of_a_template_from_how_it_closes() -> None:
    model = small_model()
    seen = mvest.simulate_observation(
        model, MODULI, np.array([6.2, 2.1]), variance=1e-6, rng=np.random.default_rng(1)
    )
    assert seen.observation is not None
    prior = mvest.Gaussian.from_variance([5.0, 3.0], 1.0)
    problem = mvest.Problem(MODULI, model, prior, mvest.IteratedFilter(), mvest.Log(), TISSUE)
    found = mvest.estimate(problem, seen.observation).against(seen.truth)
    assert found.converged
    assert found.estimate is not None
    np.testing.assert_allclose(found.estimate, [6.2, 2.1], rtol=1e-4)
    assert found.filtered is not None
    jacobian = found.filtered.prediction.jacobian
    known = mvest.identifiability(jacobian, seen.observation.R, found.estimate)
    assert np.all(known.std > 0)


def test_moduli_of_an_own_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvest.personalisation.record.clinical_measurements", lambda *_: {})
    monkeypatch.setattr("mvest.reporting.figures.DPI", 30)
    use(monkeypatch)  # a formula instead of a closure
    mvest.write_case(tmp_path / "case", made_up_case(0.01, displaced=False))
    case = mvest.read_case(tmp_path / "case")
    assert isinstance(case, mvest.ValveCase)
    assert mvest.default_settings(case).unknowns
    own = mvest.PersonaliseSettings(
        tuple(
            mvest.Prior(name, mean, 2.0) for name, mean in ((MODULI[0], 6.23), (MODULI[1], 2.09))
        ),
        mvest.MechanicsSettings(TISSUE),
    )
    moduli_alone = mvest.personalise(case, own)
    assert moduli_alone.result.estimate is not None
    assert moduli_alone.result.estimate.shape == (2,)
    written = mvest.report(moduli_alone, tmp_path / "report")
    assert {"unknowns.csv", "report.html"} <= {path.name for path in written}
    record = mvest.record_of_case(moduli_alone)
    assert [modulus.estimate for modulus in record.moduli] == moduli_alone.result.estimate.tolist()


def test_a_body_without_a_valve() -> None:
    nodes = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3]], dtype=float)
    tetrahedron = np.array([[0, 1, 2, 3]])
    body = mvest.simulate_body(
        nodes,
        tetrahedron,
        "tet4",
        fixed_nodes=[0, 1, 2],
        pressure_faces=np.array([[1, 2, 3]]),
        material=mvest.TransverselyIsotropic.isotropic(E=2.0, nu=0.45),
        pressure=float(mvest.units.mmhg_to_mpa(10.0)),
        times=[0.05, 0.1],
    )
    assert body.converged
    assert body.frames[-1, 3, 2] != 3.0


# --- the faces ----------------------------------------------------------------------------------

STUBS = sorted(ROOT.joinpath("mvest").rglob("__init__.pyi"))


def package_of(stub: Path) -> str:
    return ".".join(stub.relative_to(ROOT).parent.parts)


@pytest.mark.parametrize("stub", STUBS, ids=package_of)
def test_a_face_offers_what_its_stub_says(stub: Path) -> None:
    package = importlib.import_module(package_of(stub))
    said = {
        alias.asname or alias.name: f"{package.__name__}.{node.module or alias.name}"
        for node in ast.parse(stub.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert dir(package) == package.__all__ == sorted(said)
    for name, home in said.items():
        own = importlib.import_module(home)
        assert getattr(package, name) is getattr(own, name, own), name


def test_the_front_door_loads_nothing_before_it_is_asked() -> None:
    code = (
        "import sys, mvest; assert dir(mvest); heavy = {'numpy', 'scipy', 'numba', 'yaml'}; "
        "assert not heavy & set(sys.modules), heavy & set(sys.modules); "
        "mvest.MvestError; assert 'numpy' not in sys.modules; "
        "mvest.Gaussian; assert 'numpy' in sys.modules and 'numba' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
