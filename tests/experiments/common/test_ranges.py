"""Every number of every setting has a range, and nothing outside one is computed or written."""

import dataclasses
import re
import types
import typing
from collections.abc import Iterator, Mapping

import pytest
from omegaconf import OmegaConf

from experiments.common.config import Config, plain
from experiments.common.ranges import ANY, RANGES, range_of, require_in_range
from experiments.common.study import load_settings, study_names
from experiments.runner.jobs.request import Request
from mvest.errors import ConfigurationError
from mvest.mechanics.parameters import KINDS
from mvest.problem.registration import REGISTRATION
from tests.experiments.configured import composed
from tests.places import CONF, ROOT

FREE = ("external.settings", "factors", "sweep", "imaging.targets")
"""Mappings with whatever another program, a sweep or a table is given."""

NAMED_BY_PARAMETERS = (
    "filters.problems.*.fixed",
    "fixed",
    "imaging.population.moduli",
    "patient.moduli",
    "personal.unknowns",
    "truth.fixed",
)

HAVING = {
    "personal": "own_valve",
    "patient": "patients",
    "imaging": "imaging",
    "world": "calibration",
    "door": "surfaces",
}

EXAMPLE = {"REGION": "anterior", "FAMILY or tipN": "tip1", "REGION.K": "anterior.3", "": ""}


def numbers(hint: object, key: str) -> Iterator[str]:
    """Dotted names of all numbers in a setting of some type; a mapping's names are stars."""
    arguments = typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        for field in dataclasses.fields(hint):
            yield from numbers(hints[field.name], f"{key}.{field.name}".lstrip("."))
    elif typing.get_origin(hint) in (dict, Mapping):
        yield from numbers(arguments[1], f"{key}.*")
    elif arguments:
        for part in arguments:
            yield from numbers(part, key)
    elif hint in (int, float, typing.Any):
        yield key


def every_number() -> set[str]:
    found = {key for name in study_names() for key in numbers(load_settings(name), "")}
    return found | set(numbers(Config, ""))


def test_the_walk_sees_every_kind_of_setting() -> None:
    found = every_number()
    assert {
        "seed",
        "time_limit_s",  # optional
        "truth.values",  # a list
        "valve.leaflets.anterior.thickness",  # nested
        "filters.methods.*.monte_carlo.sampler.steps",  # in a mapping
        "valve.chordae.elongated",  # pairs
        "filter.P0",  # of any type
    } <= found
    assert len(found) > 350
    assert types.NoneType not in found


@pytest.mark.parametrize("key", sorted(every_number()))
def test_every_number_has_a_range_of_its_own(key: str) -> None:
    if any(key.startswith(f"{free}.") for free in FREE):
        assert range_of(key) is ANY
        return
    for named in NAMED_BY_PARAMETERS:
        if key.startswith(f"{named}."):
            rest = key.removeprefix(f"{named}.").removeprefix("*")
            for name in [*PARAMETERS, *REGISTRATION]:
                assert range_of(f"{named}.{name}{rest}") is not ANY, name
            return
    assert range_of(key) is not ANY


PARAMETERS = [f"{name}.{EXAMPLE[kind.part.value]}".rstrip(".") for name, kind in KINDS.items()] + [
    name for name, kind in KINDS.items() if kind.whole
]


LAUNCHERS = [
    f"hydra.launcher.{name}"
    for path in sorted((CONF / "hydra" / "launcher").glob("*.yaml"))
    for name, value in OmegaConf.to_container(OmegaConf.load(path), resolve=False).items()  # type: ignore[union-attr]
    if isinstance(value, int | float)
]


@pytest.mark.parametrize("key", LAUNCHERS)
def test_so_have_those_of_launchers(key: str) -> None:
    assert range_of(key) is not ANY


def test_every_name_of_the_table_is_some_settings() -> None:
    named = [*PARAMETERS, *REGISTRATION]
    known = every_number() | {f"truth.fixed.{name}" for name in named}
    known |= {f"personal.unknowns.{name}.{part}" for name in named for part in ("mean", "std")}
    known |= {"port", *LAUNCHERS}
    for row in RANGES:
        assert row.low < row.high
        assert row.why
        for name in row.names.split():
            ends = re.compile(
                r"(?:^|\.)" + re.escape(name).replace(r"\*", ".*").replace(r"\?", ".") + "$"
            )
            assert any(ends.search(key) for key in known), name


CHOICES = [[f"experiment={path.stem}"] for path in sorted((CONF / "experiment").glob("*.yaml"))] + [
    [f"experiment={HAVING.get(path.parent.name, 'table1')}", f"{path.parent.name}={path.stem}"]
    for path in sorted(CONF.glob("*/*.yaml"))
    if path.parent.name not in ("experiment", "hydra")
]


@pytest.mark.parametrize("overrides", CHOICES, ids=lambda choice: choice[-1])
def test_all_that_is_configured_is_inside(overrides: list[str]) -> None:
    require_in_range(plain(composed(*overrides)))


def test_so_are_the_launchers_settings() -> None:
    for path in (CONF / "hydra" / "launcher").glob("*.yaml"):
        settings = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
        require_in_range({"hydra": {"launcher": settings}})


def test_all_that_the_documentation_sets_is_inside() -> None:
    pages = [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("mvest/**/README.md")]
    given = [
        found
        for page in pages
        for found in re.findall(
            r"\b([a-z_][\w.]*)=(-?\d[\d.e+-]*)(?![\w.])", page.read_text(encoding="utf-8")
        )
    ]
    assert len(given) > 10
    for key, number in given:
        range_of(key).require(key, float(number))


OUTSIDE = [
    ({"seed": -1}, "seed = -1, expected 0 to 4294967295 (what random generators take)"),
    ({"seed": 10**400}, "seed = 1.000000000e+400, expected 0 to"),
    ({"time_limit_s": 1e12}, "time_limit_s = 1e+12, expected 0.01 to 2592000 s"),
    ({"time_limit_s": 0}, "time_limit_s = 0, expected"),
    ({"repeats": 0}, "repeats = 0, expected 1 to"),
    ({"mesh": {"columns": 100000}}, "mesh.columns = 100000, expected 1 to 400"),
    ({"mechanics": {"protocol": {"pressure_mmHg": 1e6}}}, "protocol.pressure_mmHg = 1000000, exp"),
    ({"mechanics": {"density": float("nan")}}, "mechanics.density = nan, expected 1e-12"),
    ({"filter": {"P0": [[1.0, float("inf")]]}}, "filter.P0 = inf"),
    ({"truth": {"fixed": {"E_f.anterior": 1e9}}}, "truth.fixed.E_f.anterior = 1000000000, expect"),
    (
        {"study": "twin", "parameters": ["E_f.a", "pressure_scale"], "truth": {"values": [2, 1e9]}},
        "truth.values of pressure_scale = 1000000000, expected 0 to 100",
    ),
    ({"personal": {"unknowns": {"shift.x": {"std": 1e4}}}}, "unknowns.shift.x.std = 10000"),
    ({"valve": {"leaflets": {"anterior": {"thickness": 40}}}}, "anterior.thickness = 40, expect"),
    ({"prediction": {"stress_meshes": [[24, 3], [24, 10**9]]}}, "stress_meshes = 1000000000"),
    ({"external": {"settings": {"anything": 1e300}}}, "external.settings.anything = 1e+300"),
    ({"hydra": {"launcher": {"n_jobs": 10**6}}}, "hydra.launcher.n_jobs = 1000000"),
    ({"hydra": {"launcher": {"timeout_min": 0}}}, "hydra.launcher.timeout_min = 0, expected 1"),
    ({"title": "a" * 10_001}, "title has 10001 characters, expected at most 10000"),
    ({"name": "a" * 121}, "name has 121 characters, expected at most 120"),
    ({"title": "a\ud800"}, "title has the character U+D800"),
    ({"paths": {"outputs": "a\0b"}}, "paths.outputs has the character U+0000"),
    ({"row": "\x1b[2J"}, "row has the character U+001B"),
    ({"parameters": ["E_f.a"] * 10_001}, "parameters has 10001 entries, expected at most 10000"),
]


@pytest.mark.parametrize(("values", "line"), OUTSIDE, ids=[line for _, line in OUTSIDE])
def test_what_is_outside_is_refused_in_one_line(tmp_path, values: dict, line: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        Request(values, "hash", tmp_path)
    assert line in str(refused.value)
    assert len(str(refused.value)) < 300
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "values",
    [
        {"mechanics": {"protocol": {"pressure_mmHg": 0}}},
        {"mechanics": {"protocol": {"pressure_mmHg": 300}}},
        {"truth": {"fixed": {"E_f.anterior": 1e-3, "chord_rest_length": 2.0}}},
        {"truth": {"fixed": {"E_f.anterior": 1e3, "chord_rest_length": 0.5}}},
        {"mesh": {"columns": 6, "rows": 2}},
        {"mesh": {"columns": 300, "rows": 40}},
        {"valve": {"leaflets": {"anterior": {"thickness": 0.2}, "posterior": {"thickness": 4}}}},
        {"study": "external", "parameters": ["E_f.a"], "truth": {"values": [5e6]}},
        {"title": "Ünïcode, lines\nand\ttabs"},
    ],
)
def test_extremes_that_are_studied_are_inside(values: dict) -> None:
    require_in_range(values)
