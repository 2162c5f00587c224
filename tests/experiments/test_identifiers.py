"""No name, number or date of a patient gets out of what is read into what is written."""

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import nibabel
import numpy as np
import pytest

from experiments.common.config import hash_of, without_places
from experiments.common.records.record import stamp, write_record
from experiments.common.schema import build
from experiments.common.study import Job
from experiments.studies.case import STUDY, Settings
from mvest.cases.folder import write_case
from mvest.exchange.volumes import read_volume
from mvest.imaging.volume import Modality
from mvest.provenance import write_json
from tests.exchange import volume_variants
from tests.experiments.common.test_inputs import own_program, typed
from tests.experiments.configured import composed, plain
from tests.made_up_closure import made_up_case, use

NAME, NUMBER, DATE = "DOE^JANE", "MRN0815", "19700131"
SECRETS = (NAME, "DOE_JANE", NUMBER, DATE)


def philips(folder: Path) -> Path:
    data = volume_variants.dataset()
    data.PatientName, data.PatientID = NAME, NUMBER
    data.PatientBirthDate = data.StudyDate = DATE
    return volume_variants.philips(folder / "a.dcm", data=data)


def nrrd(folder: Path) -> Path:
    extra = f"# {NAME}\nPatientID:={NUMBER}\nPatientName:={NAME}\nStudyDate:={DATE}\n"
    volume_variants.by_pynrrd(folder / "a.nrrd", "frames first", "raw", "uint8")
    content = (folder / "a.nrrd").read_bytes()
    fields = f'\ncontent: "{NAME}"\n{extra}\n'.encode()
    (folder / "a.nrrd").write_bytes(content.replace(b"\n\n", fields, 1))
    return folder / "a.nrrd"


def nifti(folder: Path) -> Path:
    image = nibabel.load(volume_variants.nifti(folder / "b.nii", "NIfTI-1", "uint8"))
    image.header["descrip"], image.header["db_name"] = NAME, NUMBER
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", DATE.encode()))
    nibabel.save(image, folder / "a.nii")
    return folder / "a.nii"


@pytest.mark.parametrize("made", [philips, nrrd, nifti])
def test_readers_keep_no_text_of_a_header(tmp_path: Path, made: Callable[[Path], Path]) -> None:
    file = made(tmp_path)
    content = file.read_bytes()
    assert NAME.encode() in content
    assert NUMBER.encode() in content
    modality = None if made is philips else Modality.ULTRASOUND
    unit = "s" if made is nrrd else None
    volume = read_volume(file, modality=modality, time_unit=unit)
    kept = {field.name: getattr(volume, field.name) for field in fields(volume)}
    assert not [secret for secret in SECRETS if secret in repr(kept)]
    assert kept["source"] == file.name
    # What is kept as text at all.
    assert {name for name, value in kept.items() if isinstance(value, str)} == {"source", "sha256"}
    assert np.ptp(volume.frames[0]) > 0


def own_observation(folder: Path) -> list[str]:
    """A program, which the user names as it is to be kept, beside an observation of a patient."""
    (folder.parent.parent / "program").mkdir()
    words = own_program(folder.parent.parent / "program")
    observed = folder / f"{DATE}.csv"
    observed.write_bytes((folder.parent.parent / "program" / "observed.csv").read_bytes())
    return [f"external.observation={observed}" if "observation=" in w else w for w in words]


def leaks(folder: Path) -> list[tuple[str, str]]:
    """Files of a run, and what each of them says that it should not."""
    kept = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    # What was typed and what the terminal showed are kept as they were.
    return [
        (path.name, secret)
        for path, content in kept.items()
        for secret in SECRETS
        if secret.encode() in content and path.name != "log.txt" and path.parent.name != ".hydra"
    ]


def test_no_name_of_a_file_is_in_a_run_or_its_store(tmp_path: Path, monkeypatch) -> None:
    patient = tmp_path / "DOE_JANE" / NUMBER
    patient.mkdir(parents=True)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    words = [*own_observation(patient), "hydra.run.dir=out", "publish=false"]
    assert typed(monkeypatch, *words) == 0
    names = {path.name for path in (tmp_path / "here").rglob("*")}
    assert names >= {"config.json", "result.json", "mlflow.db"}
    assert leaks(tmp_path / "here") == []


def test_no_name_of_a_folder_is_in_the_report_of_a_case(tmp_path: Path, monkeypatch) -> None:
    patient = tmp_path / "DOE_JANE" / NUMBER
    patient.mkdir(parents=True)
    use(monkeypatch)
    case = write_case(patient / "case", made_up_case(0.3, 8.0, np.random.default_rng(1)))
    out = tmp_path / "out"
    out.mkdir()
    values = plain(composed("experiment=own_valve", f"case={case}", f"paths.outputs={out}"))
    result = STUDY.run(Job(values, build(Settings, values), out))
    record = stamp(values, hash_of(values), result, 0.0)
    write_json(out / "config.json", without_places(values))
    write_record(out / "result.json", record, result.arrays)
    names = {path.name for path in STUDY.files(out, record)}
    assert "report.html" in names
    assert leaks(out) == []
    assert "DOE_JANE" in json.dumps(values)
