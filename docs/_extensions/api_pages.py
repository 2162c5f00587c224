"""API pages: one for the public names of ``mvest``, and one for each package."""

from __future__ import annotations

import ast
from pathlib import Path

from sphinx.application import Sphinx

import mvest

PRIVATE = "_"


def modules_of(package: Path) -> dict[str, list[str]]:
    """Public modules of a package, each with the functions and classes that it defines."""
    found = {}
    for path in sorted(package.rglob("*.py"), key=lambda p: (p.parent.parts, p.name)):
        parts = path.relative_to(package.parent).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        if any(part.startswith(PRIVATE) for part in parts):
            continue
        body = ast.parse(path.read_text(encoding="utf-8")).body
        found["mvest." + ".".join(parts)] = [
            node.name
            for node in body
            if isinstance(node, ast.ClassDef | ast.FunctionDef)
            and not node.name.startswith(PRIVATE)
        ]
    return found


def titled(text: str, underline: str) -> str:
    """A heading of reStructuredText."""
    return f"{text}\n{underline * len(text)}\n"


def front_door() -> str:
    """The names of ``import mvest``, each linked to its page."""
    names = sorted(set(mvest.__all__) - {"__version__", "units"}, key=str.lower)
    listing = "\n".join(f"   {name}" for name in names)
    return f"""{titled("API", "=")}
``import mvest`` offers what is needed first:

.. currentmodule:: mvest

.. autosummary::
   :toctree: names
   :nosignatures:

{listing}

The packages hold these and all the rest:

.. toctree::
   :maxdepth: 1
   :glob:

   packages/*
"""


def package_page(package: Path) -> str:
    """A package with all its public modules."""
    name = f"mvest.{package.name}"
    modules = modules_of(package)
    parts = [titled(name, "="), f".. automodule:: {name}\n   :no-members:\n"]
    for module, members in modules.items():
        if module != name:
            shown = f":members: {', '.join(members)}" if members else ":no-members:"
            parts += [
                titled(module.removeprefix("mvest."), "-"),
                f".. automodule:: {module}\n   {shown}\n",
            ]
    return "\n".join(parts)


def write(path: Path, text: str) -> None:
    """Write a file unless its content is unchanged."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before Sphinx reads its sources."""
    folder, library = Path(app.srcdir) / "api", Path(mvest.__file__).parent
    write(folder / "index.rst", front_door())
    packages = {path.name: path for path in library.iterdir() if (path / "__init__.py").is_file()}
    for stale in folder.glob("packages/*.rst"):
        if stale.stem not in packages:
            stale.unlink()
    for name, path in packages.items():
        write(folder / "packages" / f"{name}.rst", package_page(path))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
