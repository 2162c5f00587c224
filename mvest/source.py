"""Which code made something: a key of what it does, wherever it lies and whatever it is called.

The imports of the code are followed through this package and those that join it by
:meth:`Sources.include`, as `experiments` does, those within functions included. What is reached
counts by the content of its syntax tree: comments, docstrings, layout, ``__all__`` and the places
of modules do not count. So a key outlives that a module is moved or renamed, with the import lines
that name it, and ends with every change of code that is reached.

* Of a module of `mvest` all counts. Of one of another package, where building, estimating and
  reporting meet, and of the ``__init__`` of a package, the definitions that are reached count and
  the statements that define nothing.
* ``from package import name`` leads to the module that defines the name: past an ``__init__`` that
  merely imports it, in its stub too, as one that imports on first use has it. Importing a module
  does not make the packages above it count.
* An imported name counts with the content of the module that it comes from, so that another
  function of the same name is another one. What other libraries are asked for counts by name.
* A text that is the name of a module, or of a file of Python beside the module, is an import of it.

What modules read (files of data) or are given (settings) is not code: callers describe it.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from mvest.errors import InputError

WHOLE = "mvest"
"""Package of whose modules all counts that they hold."""


class _Import(NamedTuple):
    """A name in a module: that of a module, or one that a module binds; of a library, no module."""

    alias: str
    module: str | None
    name: str | None


class _Statement(NamedTuple):
    """A statement of a module as text, and the names in it; one of other effects binds none."""

    binds: frozenset[str]
    text: str
    uses: set[str]
    imports: list[_Import]


class _Module:
    """What the text of a module says."""

    def __init__(self, name: str, path: Path, sources: Sources) -> None:
        self.name, self.path, self._sources = name, path, sources
        self.is_package = path.name == "__init__.py"
        self.is_sliced = self.is_package or name.partition(".")[0] != WHOLE
        self.statements: list[_Statement] = []
        self.imports: list[_Import] = []
        stub, for_types = path.with_suffix(".pyi"), list[_Import]()
        for node in ast.parse(stub.read_bytes()).body if stub.is_file() else ():
            for_types += self._imports(node)
        for node in ast.parse(path.read_bytes()).body:
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                for_types += [found for part in node.body for found in self._imports(part)]
            elif isinstance(node, ast.Import | ast.ImportFrom):
                self.imports += self._imports(node)
            elif not _is_text(node) and _binds(node) != {"__all__"}:
                uses, imports = set[str](), list[_Import]()
                text = self._text(node, uses, imports)
                self.statements.append(_Statement(_binds(node), text, uses, imports))
        self.offers = {found.alias: found for found in [*for_types, *self.imports]}

    def counting(self, names: set[str | None]) -> list[_Statement]:
        """Statements that count where names are wanted, or all of the module (None)."""
        if None in names or not self.is_sliced:
            return self.statements
        kept, wanted, size = list[_Statement](), set[str | None](names), -1
        while size < len(kept):
            size = len(kept)
            kept = [s for s in self.statements if not s.binds or s.binds & wanted]
            wanted = wanted.union(*(s.uses for s in kept))
        return kept

    def _text(self, node: Any, uses: set[str], imports: list[_Import]) -> str:
        """A syntax tree in one line; what it uses and imports is added to ``uses, imports``."""
        if isinstance(node, list):
            items = []
            for item in node:
                if isinstance(item, ast.Import | ast.ImportFrom):
                    imports += self._imports(item)
                elif not _is_text(item):
                    items.append(self._text(item, uses, imports))
            return f"[{','.join(items)}]"
        match node:
            case ast.Name():
                uses.add(node.id)
                return f"Name({node.id})"
            case ast.Attribute(value=ast.Name(id=name)):
                uses.add(f"{name}.{node.attr}")
            case ast.Constant(value=value):
                if isinstance(value, str) and (named := self._named(value)):
                    imports.append(_Import("", named, None))
                    return "module"
                return repr(value)
            case ast.AST():
                pass
            case _:
                return repr(node)
        # Whether something is read or written follows from where it stands.
        fields = [name for name in node._fields if name not in ("ctx", "type_comment")]
        parts = [self._text(getattr(node, name, None), uses, imports) for name in fields]
        return f"{type(node).__name__}({','.join(parts)})"

    def _named(self, text: str) -> str | None:
        """The module that a text names."""
        if text.endswith(".py") and self.path.with_name(text.rpartition("/")[2]).is_file():
            package = self.name if self.is_package else self.name.rpartition(".")[0]
            return f"{package}.{text.rpartition('/')[2][:-3]}"
        return text if "." in text and self._sources.path(text) else None

    def _imports(self, node: ast.stmt) -> Iterator[_Import]:
        if isinstance(node, ast.Import):
            for item in node.names:
                is_ours = self._sources.path(item.name) is not None
                alias = item.asname or item.name
                yield _Import(alias, *((item.name, None) if is_ours else (None, item.name)))
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = self.name.split(".")
                parents = parents[: len(parents) - node.level + self.is_package]
                base = ".".join([*parents, *([base] if base else [])])
            for item in node.names:
                is_ours = self._sources.path(base) is not None
                name = item.name if is_ours else f"{base} {item.name}"
                yield _Import(item.asname or item.name, base if is_ours else None, name)


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
        self._paths: dict[str, Path | None] = {}
        self._modules: dict[str, _Module] = {}
        self._keys: dict[tuple[tuple[str, str | None], ...], str] = {}

    def key(self, *made_by: tuple[str, str | None]) -> str:
        """Hash of the code that is reached from modules, or from names that they define.

        Raises
        ------
        InputError
            If one of them is of another package.
        """
        if made_by not in self._keys:
            self._keys[made_by] = _hash(sorted(self.parts(*made_by).values()))
        return self._keys[made_by]

    def parts(self, *made_by: tuple[str, str | None]) -> dict[str, str]:
        """Modules that are reached -> hash of what counts of each."""
        reached: dict[str, set[str | None]] = {}
        left = list(made_by)
        while left:
            name, wanted = left.pop()
            names = reached.setdefault(name, set())
            if wanted not in names:
                names.add(wanted)
                left += [home for _, home in self._followed(self._module(name), names) if home[0]]
        return {name: self._part(self._module(name), names) for name, names in reached.items()}

    def _part(self, module: _Module, names: set[str | None]) -> str:
        """Hash of what counts of a module, and of what it imports, that one's imports apart."""
        bound = set()
        for alias, (name, original) in self._followed(module, names):
            content = [s.text for s in self._module(name).counting({original})] if name else ()
            bound.add((alias, original or "", _hash(content)))
        return _hash([s.text for s in module.counting(names)], sorted(bound))

    def _followed(
        self, module: _Module, names: set[str | None]
    ) -> Iterator[tuple[str, tuple[str, str | None]]]:
        """Names that are imported for some names of a module, and their homes."""
        statements = module.counting(names)
        uses = set[str]().union(*(s.uses for s in statements))
        every = statements is module.statements
        above = [i for i in module.imports if every or i.alias.partition(".")[0] in uses]
        for found in above + [i for s in statements for i in s.imports]:
            if found.module is None:
                yield found.alias, ("", found.name)
                continue
            package = self._module(found.module)
            if found.name is not None or not package.is_package:
                yield found.alias, self._home(found.module, found.name)
                continue
            # A package by its name: what is asked of it, or all that it offers.
            asked = {u.partition(".")[2] for u in uses if u.startswith(f"{found.alias}.")}
            for name in package.offers if "." in found.alias else asked:
                yield f"{found.alias}.{name}", self._home(found.module, name)

    def _home(self, module: str, name: str | None) -> tuple[str, str | None]:
        """The module that defines a name which another one offers, and the name there."""
        package = self._module(module)
        if name is None or not package.is_package:
            return module, name
        further = package.offers.get(name)
        if further is not None and further.module is not None:
            return self._home(further.module, further.name)
        inner = f"{module}.{name}"
        return (inner, None) if self.path(inner) else (module, name)

    def _module(self, name: str) -> _Module:
        if name not in self._modules:
            path = self.path(name)
            if path is None:
                raise InputError(f"{name} is no module of {' or '.join(self._folders)}")
            self._modules[name] = _Module(name, path, self)
        return self._modules[name]

    def path(self, name: str) -> Path | None:
        """The file of a module; None if it is none of these packages."""
        if name not in self._paths:
            top, *rest = name.split(".")
            found = []
            if top in self._folders and all(part.isidentifier() for part in rest):
                place = self._folders[top].joinpath(*rest)
                found = [
                    p for p in (place / "__init__.py", place.with_suffix(".py")) if p.is_file()
                ]
            self._paths[name] = found[0] if found else None
        return self._paths[name]


def _hash(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _binds(node: ast.stmt) -> frozenset[str]:
    """Names that a statement defines, if that is all it does."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return frozenset([node.name])
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
    names = [part for target in targets for part in getattr(target, "elts", [target])]
    is_plain = isinstance(node, ast.Assign | ast.AnnAssign)
    plain = [part.id for part in names if is_plain and isinstance(part, ast.Name)]
    return frozenset(plain if len(plain) == len(names) else ())


SOURCES = Sources(mvest=Path(__file__).parent)


def source_key(*made_by: Any) -> str:
    """Key of the code of modules, functions or classes, and of all that it reaches.

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
            (entry.__name__, None)
            if isinstance(entry, ModuleType)
            else (entry.__module__, entry.__qualname__.partition(".")[0])
            for entry in made_by
        )
    )
