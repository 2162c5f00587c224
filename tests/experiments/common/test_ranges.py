"""Every number of every setting has a range, and nothing outside one is computed or written."""

import dataclasses
import typing
from collections.abc import Iterator, Mapping

import pytest
from pydantic.fields import FieldInfo

from experiments.common.config import Config, plain, require_in_range
from experiments.common.schema import BY_PARAMETER, hints_of
from experiments.common.study import load_study, study_names
from mvest.errors import ConfigurationError
from mvest.quantities import Within
from tests.experiments.configured import composed
from tests.places import CONF

RANGES = (Within, FieldInfo)

HAVING = {
    "personal": "own_valve",
    "patient": "patients",
    "imaging": "imaging",
    "misspecification": "calibration",
    "arrival": "surfaces",
}


def without_range(kind: object, key: str = "") -> Iterator[str]:
    """Dotted names of numbers of a schema that have no range."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        known = (mark is BY_PARAMETER or isinstance(mark, RANGES) for mark in arguments[1:])
        if not any(known):
            yield from without_range(arguments[0], key)
    elif dataclasses.is_dataclass(kind):
        for name, hint in hints_of(kind).items():  # type: ignore[arg-type]
            yield from without_range(hint, f"{key}.{name}".lstrip("."))
    elif origin in (dict, Mapping):
        yield from without_range(arguments[1], f"{key}.*")
    elif arguments:
        for part in arguments:
            yield from without_range(part, key)
    elif kind in (int, float):
        yield key


@pytest.mark.parametrize(
    "kind",
    [Config, *(load_study(name).settings for name in study_names())],
    ids=lambda kind: f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}",
)
def test_every_number_has_a_range(kind: type) -> None:
    assert list(without_range(kind)) == []


CHOICES = [[f"experiment={path.stem}"] for path in sorted((CONF / "experiment").glob("*.yaml"))] + [
    [f"experiment={HAVING.get(path.parent.name, 'table1')}", f"{path.parent.name}={path.stem}"]
    for path in sorted(CONF.glob("*/*.yaml"))
    if path.parent.name not in ("experiment", "hydra")
]


@pytest.mark.parametrize("overrides", CHOICES[::2], ids=lambda choice: choice[-1])
def test_all_that_is_configured_is_inside(overrides: list[str]) -> None:
    require_in_range(plain(composed(*overrides)))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed=-1", "seed = -1, expected 0 to 4294967295"),
        ("mesh.columns=0", "mesh.columns = 0, expected 1 to 400"),
        ("truth.values=[-5,2]", "truth.values of E_f.anterior = -5, expected 1e-06 to 10000 MPa"),
        ("valve.leaflets.anterior.thickness=11", "thickness = 11, expected 0.01 to 10 mm"),
        ("filter.R=[0.01,1e13]", "filter.R = 1e+13, expected"),
        ("+factors.a=1e16", "factors.a = 1e+16, expected -1e+15 to 1e+15"),
        (f"name={'a' * 121}", "name has more than 120 letters"),
    ],
)
def test_a_number_outside_its_range_is_refused_by_name(override: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        require_in_range(plain(composed("experiment=table1", override)))
    assert message in str(refused.value)
