"""Which code made something: a key of the modules that make it and of all that they import.

Imports are followed through this package and those that join it by :meth:`Sources.include`, as
`experiments` does: those within functions too, those for type checking not. A text that is the
name of a module, or of a file of Python beside the module, counts as an import of it. Each module
counts by its syntax tree: comments, docstrings and layout do not count. Importing a module does
not make the packages above it count.

What modules read (files of data) or are given (settings) is not code: callers describe it.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from mvest.errors import InputError


class Sources:
    """The code of some packages, as it is when it is first asked for: that of this process.

    Parameters
    ----------
    **folders : Path
        Of each package.
    """

    def __init__(self, **folders: Path) -> None:
        self._folders: dict[str, Path] = {}
        self.include(**folders)

    def include(self, **folders: Path) -> None:
        """Follow imports into further packages."""
        self._folders |= folders
        # What was read before might name modules of theirs.
        self._modules: dict[str, tuple[str, set[str]]] = {}

    def key(self, *modules: str) -> str:
        """Hash of modules and of all that they import.

        Raises
        ------
        InputError
            If one of them is of another package.
        """
        reached = sorted((name, self._modules[name][0]) for name in self.reached(*modules))
        return hashlib.sha256(repr(reached).encode()).hexdigest()

    def reached(self, *modules: str) -> set[str]:
        """Names of modules and of all that they import."""
        found, left = set[str](), list(modules)
        while left:
            name = left.pop()
            if name not in found:
                found.add(name)
                left += self._module(name)[1]
        return found

    def _module(self, name: str) -> tuple[str, set[str]]:
        """Hash of a module's code, and the modules that it imports."""
        if name not in self._modules:
            path = self._path(name)
            if path is None:
                raise InputError(f"{name} is no module of {' or '.join(self._folders)}")
            tree, stub = ast.parse(path.read_bytes()), path.with_suffix(".pyi")
            package = name if path.name == "__init__.py" else name.rpartition(".")[0]
            nodes = _counting(tree)
            # What a package imports on first use is in its stub.
            nodes += ast.walk(ast.parse(stub.read_bytes())) if stub.is_file() else ()
            imported = {module for node in nodes for module in self._imported(node, package)}
            code = hashlib.sha256(ast.dump(tree).encode()).hexdigest()
            self._modules[name] = code, imported
        return self._modules[name]

    def _imported(self, node: ast.AST, package: str) -> Iterator[str]:
        """The modules of these packages that a part of a syntax tree names."""
        names: list[str] = []
        match node:
            case ast.Import():
                names = [item.name for item in node.names]
            case ast.ImportFrom():
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*(above if node.level else []), *filter(None, [node.module])])
                inner = [f"{base}.{item.name}" for item in node.names]
                names = [name if self._path(name) else base for name in inner]
            case ast.Constant(value=str(text)) if text.endswith(".py"):
                names = [f"{package}.{text[:-3]}"] if text != "__init__.py" else []
            case ast.Constant(value=str(text)) if "." in text:
                names = [text]
        return (name for name in names if self._path(name))

    def _path(self, name: str) -> Path | None:
        """The file of a module; None if it is none of these packages."""
        top, *rest = name.split(".")
        if top not in self._folders or not all(part.isidentifier() for part in rest):
            return None
        place = self._folders[top].joinpath(*rest)
        files = (place / "__init__.py", place.with_suffix(".py"))
        return next((file for file in files if file.is_file()), None)


def _counting(tree: ast.Module) -> list[ast.AST]:
    """Take docstrings and imports for type checking out of a tree; returns what is left of it."""
    nodes: list[ast.AST] = []
    left: list[ast.AST] = [tree]
    while left:
        node = left.pop()
        nodes.append(node)
        body: Any = getattr(node, "body", None)
        if isinstance(body, list):
            body[:] = [part for part in body if not _is_silent(part)]
        left += ast.iter_child_nodes(node)
    return nodes


def _is_silent(node: ast.stmt) -> bool:
    if isinstance(node, ast.If):
        return "TYPE_CHECKING" in ast.unparse(node.test)
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


SOURCES = Sources(mvest=Path(__file__).parent)


def source_key(*made_by: Any) -> str:
    """Key of the code of modules, and of those in which functions or classes are defined.

    Parameters
    ----------
    *made_by : module, function or class
        What makes the data.

    Raises
    ------
    InputError
        If one of them is of another package.
    """
    return SOURCES.key(
        *(
            made.__name__ if isinstance(made, ModuleType) else str(made.__module__)
            for made in made_by
        )
    )
