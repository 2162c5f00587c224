"""Every file that a result depends on is in the hash of its configuration, by what is in it."""

import json
import sys
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

import mvest.files
from experiments.common.config import hash_of
from experiments.common.schema import Reads, build
from experiments.common.study import load_study, study_names
from experiments.run import main
from experiments.studies.imported import DonorSettings, recorded_valve
from mvest.exchange.external.contract import write_points
from mvest.exchange.volumes import write_sequence_nrrd
from mvest.imaging.volume import Modality, VolumeSequence
from mvest.reading.documents import read_mapping
from tests.cases.from_images.test_imaged_case import sequence
from tests.exchange.external.programs import SPRINGS, springs
from tests.exchange.surfaces import recorded
from tests.experiments.configured import composed, plain
from tests.experiments.studies import test_imported


def marked(cls: type, above: str = "") -> Iterator[str]:
    """Names of all settings that name files."""
    hints = typing.get_type_hints(cls, include_extras=True)
    for field in fields(cls):
        for kind in (hints[field.name], *typing.get_args(hints[field.name])):
            if isinstance(kind, Reads):
                yield above + field.name
            elif is_dataclass(kind) and isinstance(kind, type):
                yield from marked(kind, f"{above}{field.name}.")


SETTINGS = [
    (name, setting)
    for name, study in ((name, load_study(name)) for name in study_names())
    for setting in marked(study.settings, f"{study.part}." if study.part else "")
]


@pytest.fixture
def given(tmp_path, monkeypatch):
    """An empty folder to type the command in, and one beside it for what is read."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "given").mkdir()
    return tmp_path / "given"


def configuration(study: str, name: str, value: object) -> dict:
    *parts, last = name.split(".")
    values = {"study": study}
    inner = values
    for part in parts:
        inner = inner.setdefault(part, {})
        if part == "models":  # by any name
            inner = inner.setdefault("one", {})
    inner[last] = value
    return values


def placed(name: str, folder: Path) -> tuple[object, Path]:
    """A value of a setting, and a file of what it names."""
    file = folder / "a.npz"
    file.write_text("1")
    if name == "case":
        frame = "{name: a, time: 0, role: reference, surface: a.npz, papillary_tips: [[0, 0, 0]]"
        text = "version: 1\nname: a\nunits: {length: mm}\nregions: [a]\n"
        text += f"frames: [{frame}, pressure: 0}}]\n"
        (folder / "case.yaml").write_text(text)
        return str(folder), file
    if name == "donor.recording":
        # Without the name of a case it is the folder itself.
        for ending in (".inp", "_0.vtu", "_1.vtu"):
            file = folder / f"{folder.name}{ending}"
            file.write_text("1")
        return str(folder), file
    listed: dict = {"external.inputs": [str(file)], "heart.muscles": [str(file)]}
    listed["external.command"] = [sys.executable, f"--mesh={file}"]
    listed["external.python"] = f"{file}:function"
    return listed.get(name.replace(".models", ""), str(file)), file


@pytest.mark.parametrize(("study", "name"), SETTINGS)
def test_what_lies_there_is_in_the_hash(given, study, name):
    value, file = placed(name, given)
    first = hash_of(configuration(study, name, value))
    assert hash_of(configuration(study, name, value)) == first
    file.write_text("2")
    changed = hash_of(configuration(study, name, value))
    assert changed != first
    file.unlink()
    assert hash_of(configuration(study, name, value)) not in (first, changed)
    # A link that leads elsewhere now.
    for content, expected in (("1", first), ("2", changed)):
        (given / content).write_text(content)
        file.unlink(missing_ok=True)
        file.symlink_to(given / content)
        assert hash_of(configuration(study, name, value)) == expected


def test_the_data_that_a_header_names_beside_it_count(given):
    header, data = given / "a.mhd", given / "a.raw"
    header.write_text(
        "NDims = 3\nDimSize = 2 2 2\nElementSpacing = 1 1 1\nOffset = 0 0 0\n"
        "TransformMatrix = 1 0 0 0 1 0 0 0 1\nElementType = MET_UCHAR\nElementDataFile = a.raw\n"
    )
    data.write_bytes(b"1")
    (given / "other").write_bytes(b"1")
    first = hash_of({"study": "volume", "volume": str(header)})
    (given / "other").write_bytes(b"2")
    assert hash_of({"study": "volume", "volume": str(header)}) == first
    data.write_bytes(b"2")
    assert hash_of({"study": "volume", "volume": str(header)}) != first


OPENED: list[Path] | None = None
"""What this process opened, while anyone asks."""


def _note(event: str, arguments: tuple) -> None:
    if OPENED is not None and event == "open" and isinstance(arguments[0], str):
        OPENED.append(Path(arguments[0]).absolute())


sys.addaudithook(_note)


@contextmanager
def all_digested(given: Path) -> Iterator[None]:
    """Fails where something in ``given`` is opened that was not taken a digest of."""
    digested, true = set(), mvest.files._digest

    def digest(file: Path) -> str:
        digested.add(file.absolute())
        return true(file)

    noted: list[Path] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mvest.files, "_digest", digest)
        patch.setattr(sys.modules[__name__], "OPENED", noted)
        yield
    opened = {path for path in noted if path.is_relative_to(given) and path.is_file()}
    assert opened
    assert opened <= digested


def typed(monkeypatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["experiments.run", *words])
    return main()


def own_volume(folder: Path) -> list[str]:
    frames = np.random.default_rng(1).integers(0, 255, (4, 20, 20, 20), dtype=np.uint8)
    place = (np.full(3, 3.0), np.eye(3), np.full(3, -30.0))
    made = VolumeSequence(frames, *place, sequence().times, Modality.ULTRASOUND)
    file = write_sequence_nrrd(folder / "tee.seq.nrrd", made)
    (folder / "curve.csv").write_text("time,pressure\n0,5\n9,100\n")
    return ["experiment=volume", f"volume={file}", f"imaged.pressure_curve={folder / 'curve.csv'}"]


def own_program(folder: Path) -> list[str]:
    (folder / "solve.py").write_text(SPRINGS)
    write_points(folder / "observed.csv", springs(0.8, 2.5)[0].reshape(-1, 3))
    solver = str(folder / "solve.py")
    command = json.dumps([sys.executable, "-S", solver, "{request}", "{folder}"])
    return ["experiment=external", "parameters=[k1,k2]", "filter.initial=[2.0,1.0]",
            "external.prior_std=[3.0,3.0]", "external.noise_mm=0.01",
            f"external.observation={folder / 'observed.csv'}",
            f"external.command={command}"]  # fmt: skip


@pytest.mark.parametrize("made", [own_volume, own_program])
def test_nothing_is_read_that_is_not_in_the_hash(given, monkeypatch, made):
    words = made(given)
    with all_digested(given):
        typed(monkeypatch, *words, "check=true", "tracking.enabled=false")


def test_of_a_recording_nothing_is_read_that_is_not_in_the_hash(given):
    recorded.write(given, recorded.skirt())
    config = plain(composed(*test_imported.SMALL, f"donor.recording={given}"))
    with all_digested(given):
        first = hash_of(config)
        recorded_valve(config, build(DonorSettings, config["donor"]))
    other = recorded.skirt()
    other["frames"] = other["frames"] + 1e-4
    recorded.write(given, other)
    assert hash_of(config) != first


def test_a_job_whose_input_is_changed_meanwhile_fails_and_is_not_done(given, monkeypatch, capsys):
    words = [*own_program(given), "tracking.enabled=false", "hydra.run.dir=out", "figures=false"]
    # The program's runs do not depend on the observation, the study's result does.
    observed = given / "observed.csv"
    (given / "solve.py").write_text(f"{SPRINGS}\nopen({str(observed)!r}, 'a').write('0,0,0\\n')\n")
    assert typed(monkeypatch, *words) == 1
    assert "no estimate: a file or folder that the settings name was changed" in (
        capsys.readouterr().err
    )
    assert read_mapping(Path("out/result.json"))["status"] == "failed"
    assert not Path("out/done").exists()
    # Nothing is wrong where it is as it was when it is looked at again.
    own_program(given)
    assert typed(monkeypatch, *words) == 0
    assert Path("out/done").exists()
