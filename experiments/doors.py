"""``mvest import`` and ``mvest export``: other programs' files to a case, and from one.

What there is to import and export is what lies in `mvest.exchange.importing` and
`mvest.exchange.exporting`; nothing is listed here.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import typing
from argparse import RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from experiments.common.schema import build, schema
from experiments.console import Parser
from experiments.interruption import interruptible
from mvest.cases.folder import require_new, write_case
from mvest.errors import ConfigurationError
from mvest.exchange import exporting, importing


@dataclass(frozen=True, slots=True)
class Door:
    """One kind of source or target.

    Attributes
    ----------
    name, sentence : str
    pass_through : callable
        ``import_NAME`` or ``export_NAME``.
    options : type
        Frozen dataclass of its last argument.
    """

    name: str
    sentence: str
    pass_through: Callable[..., Any]
    options: type

    def settings(self, given: Sequence[str]) -> Any:
        """The options from NAME=VALUE words, values as in YAML.

        Raises
        ------
        ConfigurationError
            An unknown name or a value of another type.
        """
        defaults = OmegaConf.structured(schema(self.options))
        try:
            merged = OmegaConf.merge(defaults, OmegaConf.from_dotlist(list(given)))
        except OmegaConfBaseException as error:
            said = str(error).partition("\n")[0]
            known = ", ".join(map(str, defaults))
            raise ConfigurationError(f"{self.name}: {said}; known are {known}") from error
        plain = OmegaConf.to_container(merged)
        return build(self.options, typing.cast("dict[str, Any]", plain))

    @property
    def help(self) -> str:
        """What it does and what its options mean."""
        return "\n\n".join(filter(None, map(inspect.getdoc, (self.pass_through, self.options))))


def doors(package: ModuleType, verb: str) -> dict[str, Door]:
    """The doors of a package, by the functions ``VERB_MODULE`` of its modules."""
    result = {}
    for found in pkgutil.iter_modules(package.__path__):
        module = importlib.import_module(f"{package.__name__}.{found.name}")
        function = getattr(module, f"{verb}_{found.name}", None)
        if function is not None:
            options = typing.get_type_hints(function)["options"]
            sentence = (module.__doc__ or "").partition("\n")[0]
            result[found.name] = Door(found.name, sentence, function, options)
    return result


def import_command(given: Sequence[str]) -> int:
    """``mvest import NAME SOURCE CASE [option=value ...]``: write a case folder; exit status."""

    def write(door: Door, source: Path, target: Path, options: Any) -> None:
        # Reading may take a minute.
        require_new(target)
        case = door.pass_through(source, options)
        write_case(target, case)
        print(case)
        for sentence in case.derived:
            print(f"* {sentence}")
        print(f"wrote {target}; next: mvest own-valve {target} --check")

    return _pass("import", importing, "CASE", write, given)


def export_command(given: Sequence[str]) -> int:
    """``mvest export NAME SOURCE TARGET [option=value ...]``; exit status."""

    def write(door: Door, source: Path, target: Path, options: Any) -> None:
        print(f"wrote {door.pass_through(source, target, options)}")

    return _pass("export", exporting, "TARGET", write, given)


@interruptible
def _pass(
    verb: str,
    package: ModuleType,
    metavar: str,
    write: Callable[[Door, Path, Path, Any], None],
    given: Sequence[str],
) -> int:
    available = doors(package, verb)
    kinds = "\n".join(f"  {door.name:<12} {door.sentence}" for door in available.values())
    name = given[0] if given else "--help"
    door = available.get(name)
    parser = Parser(
        prog=f"mvest {verb} {name if door else 'NAME'}",
        description=door.help if door else kinds,
        formatter_class=RawDescriptionHelpFormatter,
    )
    parser.add_argument("source", type=Path, metavar="SOURCE")
    parser.add_argument("target", type=Path, metavar=metavar)
    parser.add_argument("options", nargs="*", metavar="OPTION=VALUE")
    if door is None and not name.startswith("-"):
        parser.error(f"{name}: nothing to {verb} by this name; known: {', '.join(available)}")
    parsed = parser.parse_intermixed_args(list(given[1:]) if door else ["--help"])
    assert door is not None
    for option in parsed.options:
        if "=" not in option:
            parser.error(f"{option}: expected OPTION=VALUE; one source and one target at a time")
    write(door, parsed.source, parsed.target, door.settings(parsed.options))
    return 0
