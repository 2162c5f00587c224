"""A new user's own valve through the one command.

The valve is the template, its closed frame a closure of it on a coarse mesh; both are placed
anywhere, as in a scanner's coordinates.
"""

import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from mvest.closure.model import ClosureModel
from mvest.exchange.surfaces import Surface, write_surface
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.structured import structured_mesh

REGIONS = ("anterior", "posterior")
TRUE = (8.5, 2.6)
"""MPa, of the closure that is seen; the priors' means are 6.23 and 2.09."""
PRESSURE = 100.0
COLUMNS, ROWS = 80, 21
COARSE = (
    "personal.mesh.source=structured",
    "personal.mesh.columns=36",
    "personal.mesh.rows=4",
    "personal.mesh.guide_columns=24",
    "personal.mesh.guide_rows=3",
    "personal.mesh.contact_columns=108",
    "personal.mesh.contact_rows=24",
)


@pytest.fixture(scope="module")
def seen():
    """The open valve, and the vertices of it as it closes."""
    # Its thickness falls towards the free edge, as is assumed where a user gives none.
    template = Template()
    valve = template.valve(COLUMNS, ROWS)
    tissue = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
    model = ClosureModel(
        valve,
        template.valve(108, 24),
        structured_mesh(template, "hex18", 36, 4),
        MechanicsSettings(tissue, ClosureProtocol(pressure_mmHg=PRESSURE)),
        ("E_f.anterior", "E_f.posterior"),
    )
    found = model(np.array(TRUE))
    assert found.converged
    return valve, found.y.reshape(2, -1, 3)[1]


class Scanner:
    """Coordinates in which a valve was seen: turned, displaced and in another unit."""

    def __init__(self, seed, scale=1.0):
        rng = np.random.default_rng(seed)
        self.turn = Rotation.random(rng=rng).as_matrix()
        self.origin, self.scale = rng.uniform(-150, 150, 3), scale

    def __call__(self, x):
        return self.scale * (np.asarray(x) @ self.turn.T + self.origin)


def write(folder, seen, place):
    """A case folder with nothing in it but what every case needs."""
    valve, closed = seen
    folder.mkdir()
    frames = []
    for k, (name, x) in enumerate((("open", valve.surface.vertices), ("closed", closed))):
        surface, region = f"{name}.vtp", {"region": valve.surface.region}
        seen_surface = Surface(place(x), valve.surface.triangles, cell_data=region)
        write_surface(folder / surface, seen_surface)
        tips = place(valve.motion.papillary_tips[-k]).tolist()
        about = {"name": name, "time": 0.4 * k, "role": ("reference", "closed")[k]}
        about |= {"surface": surface, "papillary_tips": tips, "pressure": PRESSURE * k}
        frames.append(about)
    unit = {1.0: "mm", 1e-3: "m"}[place.scale]
    document = {"version": 1, "name": "mine", "units": {"length": unit}, "regions": [*REGIONS]}
    document |= {"simulated": True, "frames": frames}
    (folder / "case.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    return folder


@pytest.fixture
def run(run):
    """Run the one command on a case: exit status, standard output and error."""
    own = ("experiment=own_valve", *COARSE)
    return lambda folder, *arguments: run(*own, f"case={folder}", *arguments)


@pytest.mark.slow
def test_the_moduli_are_found_wherever_the_valve_lies(run, tmp_path, seen):
    found = []
    for k, place in enumerate((Scanner(5), Scanner(6, 1e-3))):
        folder = write(tmp_path / f"mine {k}", seen, place)
        status, _, err = run(f"'{folder}'", "figures=false")
        assert status == 0, err
        records = (tmp_path / "outputs" / "own_valve").glob("*/result.json")
        record = json.loads(max(records, key=lambda path: path.stat().st_mtime).read_text())
        assert record["status"] == "converged"
        found.append({row["name"]: row for row in record["estimates"][0]["unknowns"]})
    for unknowns in found:
        for region, true in zip(REGIONS, TRUE, strict=True):
            row = unknowns[f"E_f.{region}"]
            assert row["low"] < true < row["high"]
    # Axes of shift and turn are the scanner's; nothing else may depend on them, but for where the
    # estimation stops: it is linearised anew until it moves by less than a quarter of a standard
    # deviation (conf/personal/renewed.yaml), so two of them differ by half of it at most.
    for name in ("E_f.anterior", "E_f.posterior", "pressure_scale", "chord_rest_length"):
        one, other = (unknowns[name] for unknowns in found)
        std = np.log(one["high"] / one["low"]) / (2 * 1.96)
        assert abs(np.log(one["estimate"] / other["estimate"])) < 0.5 * std
