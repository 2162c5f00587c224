"""``mvest import`` and ``mvest export``: a case from files of other programs, and for them.

Importers and exporters are the functions ``import_MODULE`` and ``export_MODULE`` in the modules of
`mvest.exchange.importing` and `mvest.exchange.exporting`. Their last argument is a frozen dataclass
of options. They need no registration.
"""

import importlib
import inspect
import pkgutil
import textwrap
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from experiments.common.progress import WIDTH
from experiments.common.schema import defaults_of, from_words
from experiments.console import Parser
from mvest.cases.folder import require_new, write_case
from mvest.exchange import exporting, importing

EXAMPLES = {
    "import": "mvest import leaflets valve.stl CASE units=mm tips=[x,y,z,x,y,z]",
    "export": "mvest export slicer CASE FOLDER",
}


def import_command(words: Sequence[str]) -> int:
    """``mvest import NAME SOURCE CASE [OPTION=VALUE ...]``: write a case folder; exit status."""
    convert, source, target, options = _parsed("import", importing, "CASE", words)
    require_new(target)  # before a minute of reading
    case = convert(source, options)
    write_case(target, case)
    print(case, *(f"* {sentence}" for sentence in case.derived), sep="\n")
    print(f"wrote {target}; next: mvest own-valve {target} --check")
    return 0


def export_command(words: Sequence[str]) -> int:
    """``mvest export NAME SOURCE TARGET [OPTION=VALUE ...]``; exit status."""
    convert, source, target, options = _parsed("export", exporting, "TARGET", words)
    print(f"wrote {convert(source, target, options)}")
    return 0


def _parsed(
    verb: str, package: ModuleType, metavar: str, words: Sequence[str]
) -> tuple[Callable[..., Any], Path, Path, Any]:
    """The function that converts, its source and target, and its options."""
    found = {}
    for one in pkgutil.iter_modules(package.__path__):
        module = importlib.import_module(f"{package.__name__}.{one.name}")
        if function := getattr(module, f"{verb}_{one.name}", None):
            found[one.name] = function, (module.__doc__ or "").partition("\n")[0]
    name, *rest = words or ["--help"]
    if name not in found:
        form = textwrap.TextWrapper(WIDTH, initial_indent="  ", subsequent_indent=" " * 15)
        names = "\n".join(form.fill(f"{key:<12} {text}") for key, (_, text) in found.items())
        about = f"{names}\n\nmvest {verb} NAME --help lists the options of each."
        usage = f"mvest {verb} NAME SOURCE {metavar} [OPTION=VALUE ...]"
        parser = Parser(f"mvest {verb}", about, EXAMPLES[verb], {}, usage)
        if name.startswith("-"):
            parser.parse_args(["--help"])
        parser.error(f"{name}: nothing to {verb} by this name; known: {', '.join(found)}")
    convert = found[name][0]
    kind: Any = typing.get_type_hints(convert)["options"]
    about = "\n\n".join(filter(None, map(inspect.getdoc, (convert, kind))))
    arguments: dict[str, dict[str, Any]] = {
        "source": {"metavar": "SOURCE"},
        "target": {"metavar": metavar},
        "options": {"metavar": "OPTION=VALUE", "nargs": "*", "type": str},
    }
    parser = Parser(
        f"mvest {verb} {name}", f"{about}\n\n{defaults_of(kind)}", EXAMPLES[verb], arguments
    )
    given = parser.parse_intermixed_args(rest)
    return convert, given.source, given.target, from_words(name, kind, given.options)
