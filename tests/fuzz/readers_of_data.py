"""Readers of cases, arrays, records and the files of a program that is the model."""

from pathlib import Path

import numpy as np

from experiments.common.records.record import read_record, write_record
from experiments.runner.planning.plan import Plan
from mvest.cases.case import ErrorSamples
from mvest.cases.folder import read_case, write_error_samples
from mvest.estimation.prediction import Prediction
from mvest.exchange.abaqus.recording import read_recording
from mvest.exchange.exporting.febio import read_run
from mvest.exchange.external.contract import (
    RunRequest,
    read_answer,
    read_request,
    write_answer,
    write_request,
)
from mvest.exchange.febio.document import read_positions
from mvest.imaging.layout import ValveLayout
from mvest.imaging.valve_sequence import MovingValve
from mvest.problem.fields import read_case_fields
from mvest.provenance import write_json
from mvest.reading.npz import read_npz
from mvest.simulation.population import Population, load_population, save_population
from tests.cases import folders
from tests.exchange.surfaces import recorded
from tests.experiments.studies.made_up import made_up, made_up_estimate
from tests.fuzz.trial import Reader

__all__ = ["READERS"]

REQUEST = RunRequest(("E", "nu, local"), ("MPa", ""), (1.5, 0.3), 2)


def case(folder: Path) -> Path:
    """A whole case: every reader of tables and arrays is behind it."""
    document = folders.plain_folder(folder)
    count = len(np.unique(folders.Template().valve(24, 8).surface.triangles))
    samples = np.random.default_rng(0).normal(0, 0.1, (4, 2, count, 3))
    write_error_samples(
        folder / "errors.npz", ErrorSamples(samples, samples[:, :, :2]), ["open", "closed"]
    )
    (folder / "pressure.csv").write_text("time,pressure\n0.0,0.0\n0.2,60\n0.35,120\n0.4,121.5\n")
    document["pressure_curve"] = "pressure.csv"
    del document["frames"][1]["pressure"]
    document["observation"] = {
        "std_mm": 0.7, "correlation_length_mm": 10, "error_samples": "errors.npz"
    }  # fmt: skip
    document["description"] = "a valve, made up"
    return folders.save(folder, document) / "case.yaml"


def beside(name: str):
    """Another file of the case."""

    def maker(folder: Path) -> Path:
        case(folder)
        return folder / name

    maker.__name__ = name
    return maker


def population(folder: Path) -> Path:
    layout = ValveLayout(8, 3)
    x = np.random.default_rng(0).normal(0, 10, (2, layout.size, 3))
    valve = MovingValve(
        "first", layout, np.array([0.0, 0.1]), x, x[:, :2], np.ones(layout.size),
        np.array([1.0]), np.ones(1), np.array([1]),
    )  # fmt: skip
    save_population(folder / "valves.npz", Population((valve,), {"leaks": 3}, "abc"))
    return folder / "valves.npz"


def deck(folder: Path) -> Path:
    return recorded.write(folder, recorded.skirt())


def frame(folder: Path) -> Path:
    return deck(folder).with_name(f"{recorded.CASE}_2.vtu")


def arrays(folder: Path) -> Path:
    np.savez(
        folder / "a.npz", y=np.arange(7.0), names=np.array(["ab", "é"]), none=np.zeros((0, 3)),
        seen=np.array([True]), one=np.asfortranarray(np.ones((2, 3), dtype=">f4")),
    )  # fmt: skip
    return folder / "a.npz"


def packed(folder: Path) -> Path:
    np.savez_compressed(folder / "a.npz", y=np.arange(7000.0), sha256="0" * 64)
    return folder / "a.npz"


def fields(folder: Path) -> Path:
    valve = folders.Template().valve(24, 8)
    surface = valve.surface
    closed = folders.closing(surface.vertices)[None]
    np.savez_compressed(
        folder / "fields.npz", triangles=surface.triangles, region=surface.region,
        rest=surface.vertices, annulus=valve.annulus, free_edge=valve.free_edge,
        frames=np.array(["closed"]), seen=np.array([True]), tips=np.array([folders.TIPS] * 2),
        chord_tip=valve.chordae.tip, chord_insertion=np.zeros(len(valve.chordae), int),
        observed=closed, fitted=closed, distance_fitted=np.zeros((1, len(surface.vertices))),
    )  # fmt: skip
    return folder / "fields.npz"


def record(folder: Path) -> Path:
    write_record(folder / "result.json", made_up(estimates=(made_up_estimate(),)))
    return folder / "result.json"


def plan(folder: Path) -> Path:
    job = {
        "hash": "0" * 16, "folder": "job", "name": "k=1", "overrides": ["k=1"], "factors": {"k": 1},
        "row": "r", "repeats": 1, "config_hash": "0" * 64, "publish_as": None, "values": {},
        "without": [],
    }  # fmt: skip
    write_json(
        folder / "plan.json",
        {
            **{"sweep": "a", "size": None, "sweep_id": "b", "created": "2020-01-01T00:00:00Z"},
            **{"name": "a", "settings": {}, "publish": None, "directory": folder},
            **{"values": {"seed": 1, "force": False}, "jobs": [job]},
        },
    )
    return folder / "plan.json"


def answer(name: str):
    """One file of an answer."""

    def maker(folder: Path) -> Path:
        y = np.arange(6) / 7
        write_answer(folder, Prediction(y, np.outer(y, [1.0, -1e-9])), REQUEST.names)
        return folder / name

    maker.__name__ = name
    return maker


def request(folder: Path) -> Path:
    write_request(folder, REQUEST)
    return folder / "request.json"


def positions(folder: Path) -> Path:
    """As FEBio logs the positions of three nodes."""
    steps = [
        f"*Step  = {k}\n*Time  = {0.1 * k:.9g}\n*Data  = positions\n"
        + "".join(f"{n},{n - 1.5 * k},{0.25 * n},-3.5e-05\n" for n in (1, 2, 3))
        for k in range(3)
    ]
    (folder / "a.csv").write_text("".join(steps))
    return folder / "a.csv"


def estimated(name: str):
    """One of the files of a run that estimated a case."""

    def maker(folder: Path) -> Path:
        unknown = {"name": "E_f.anterior", "prior_mean": 6.23, "estimate": 7.5}
        tissue = {"anterior": {"ratio": 2.65, "nu": 0.488, "reading": "A"}}
        found = {"unknowns": [unknown], "settings": {"mechanics": {"tissue": tissue}}}
        write_json(folder / "result.json", {"findings": {"case": found}})
        write_json(folder / "config.json", {"case": "valve"})
        return folder / name

    maker.__name__ = name
    return maker


READERS = (
    Reader("case", lambda path: read_case(path.parent),
           (case, beside("chordae.csv"), beside("pressure.csv"), beside("errors.npz"))),
    Reader("population", load_population, (population,)),
    Reader("recording", lambda path: read_recording(path.parent, **recorded.NAMES), (deck, frame)),
    Reader("arrays", read_npz, (arrays, packed)),
    Reader("fields", read_case_fields, (fields,)),
    Reader("record", read_record, (record,)),
    Reader("plan", lambda path: Plan.read(path.parent), (plan,)),
    Reader("answer", lambda path: read_answer(path.parent, REQUEST),
           (answer("response.json"), answer("observation.csv"), answer("jacobian.csv"))),
    Reader("request", read_request, (request,)),
    Reader("febio", lambda path: read_positions(path, 3), (positions,)),
    Reader("estimates", lambda path: read_run(path.parent),
           (estimated("result.json"), estimated("config.json"))),
)  # fmt: skip
