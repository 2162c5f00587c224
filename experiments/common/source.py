"""Which code made something: a key of what it does, wherever it lies and whatever it is called.

The imports of the code are followed through `mvest` and `experiments`, those within functions
included. What is reached counts by the content of its syntax tree: comments, docstrings, layout,
``__all__`` and the places of modules do not count. So a key outlives that a module is moved or
renamed, with the import lines that name it, and ends with every change of code that is reached.

* Of a module of `mvest` all counts. Of one of `experiments`, where building, estimating and
  reporting meet, and of the ``__init__`` of a package, the definitions that are reached count and
  the statements that define nothing.
* ``from package import name`` leads to the module that defines the name: past an ``__init__`` that
  merely imports it, in a block for type checkers too, as one that imports on first use has it.
  Importing a module does not make the packages above it count.
* An imported name counts with the content of the module that it comes from, so that another
  function of the same name is another one. What other libraries are asked for counts by name.
* A text that is the name of a module, or of a file of Python beside the module, is an import of it.

What modules read (files of data) or are given (settings) is not code: callers describe it.
"""

from __future__ import annotations

import ast
import gc
import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any, TypeGuard

import experiments
import mvest
from mvest.errors import InputError

__all__ = ["Sources", "source_key"]

SLICED = "experiments"
"""Package of whose modules only the definitions count that are reached."""


@dataclass(frozen=True, slots=True)
class _Import:
    """A name in a module: that of a module, or one that a module binds."""

    alias: str
    module: str
    name: str | None


@dataclass(frozen=True, slots=True)
class _Statement:
    """A statement of a module.

    Attributes
    ----------
    binds : frozenset of str
        Names; of one that may do more than that, none.
    text : str
        Its syntax tree.
    uses : frozenset of str
        Names, with those of attributes of a name after a dot.
    imports : tuple of _Import
        Within it.
    """

    binds: frozenset[str]
    text: str
    uses: frozenset[str]
    imports: tuple[_Import, ...]


class _Module:
    """What the text of a module says."""

    def __init__(self, name: str, path: Path, sources: Sources) -> None:
        self.name, self.is_package = name, path.name == "__init__.py"
        self._path, self._sources = path, sources
        self.statements: list[_Statement] = []
        self.imports: dict[str, _Import] = {}
        self.for_types: dict[str, _Import] = {}
        self.foreign: dict[str, set[str]] = {}
        stub = path.with_suffix(".pyi")
        for node in ast.parse(stub.read_bytes()).body if stub.is_file() else []:
            self.for_types |= {found.alias: found for found in self._imports(node)}
        nodes = ast.parse(path.read_bytes()).body
        for node in nodes:
            if _is_for_types(node):
                within = (found for part in node.body for found in self._imports(part))
                self.for_types |= {found.alias: found for found in within}
        # What only a type checker reads is no part of what the code does.
        self.foreign.clear()
        for node in nodes:
            if _is_for_types(node):
                continue
            if isinstance(node, ast.Import | ast.ImportFrom):
                self.imports |= {found.alias: found for found in self._imports(node)}
            elif not _is_text(node) and _binds(node) != {"__all__"}:
                self.statements.append(self._statement(node))

    @cached_property
    def is_sliced(self) -> bool:
        """Whether only those definitions count that are reached."""
        return self.is_package or self.name.partition(".")[0] == SLICED

    def hash_of(self, statements: list[_Statement], *more: Any) -> str:
        """Hash of statements and of what they ask of other libraries."""
        uses = {name for s in statements for name in s.uses}
        foreign = sorted((name, sorted(self.foreign[name])) for name in uses & set(self.foreign))
        return _hash([s.text for s in statements], foreign, *more)

    def reached(self, names: Iterable[str]) -> list[_Statement]:
        """Statements that define names or what these use in turn, and those that define nothing."""
        wanted, left, kept = set(names), True, set[int]()
        while left:
            new = {
                k
                for k, s in enumerate(self.statements)
                if k not in kept and (not s.binds or s.binds & wanted)
            }
            kept |= new
            wanted |= {name for k in new for name in self.statements[k].uses}
            left = bool(new)
        return [self.statements[k] for k in sorted(kept)]

    def _statement(self, node: ast.stmt) -> _Statement:
        uses, imports = set[str](), list[_Import]()
        text = self._text(node, uses, imports)
        return _Statement(_binds(node), text, frozenset(uses), tuple(imports))

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
        if text.endswith(".py") and self._path.with_name(text.rpartition("/")[2]).is_file():
            package = self.name if self.is_package else self.name.rpartition(".")[0]
            return f"{package}.{text.rpartition('/')[2][:-3]}"
        return text if "." in text and self._sources.has(text) else None

    def _imports(self, node: ast.stmt) -> Iterator[_Import]:
        if isinstance(node, ast.Import):
            for item in node.names:
                if self._sources.has(item.name):
                    yield _Import(item.asname or item.name, item.name, None)
                else:
                    self._add_foreign(item, "")
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = self.name.split(".")
                parents = parents[: len(parents) - node.level + self.is_package]
                base = ".".join([*parents, *([base] if base else [])])
            for item in node.names:
                if self._sources.has(base):
                    yield _Import(item.asname or item.name, base, item.name)
                elif base != "__future__":
                    self._add_foreign(item, base)

    def _add_foreign(self, item: ast.alias, base: str) -> None:
        alias = (item.asname or item.name).partition(".")[0]
        self.foreign.setdefault(alias, set()).add(f"{base} {item.name}")


class Sources:
    """The code of some packages, as it is when it is first asked for: that of this process.

    Parameters
    ----------
    **folders : Path
        Of each package.
    """

    def __init__(self, **folders: Path) -> None:
        self._folders = folders
        self._modules: dict[str, _Module] = {}
        self._paths: dict[str, Path | None] = {}
        self._contents: dict[tuple[str, str | None], str] = {}
        self._keys: dict[tuple[tuple[str, str | None], ...], str] = {}

    def has(self, name: str) -> bool:
        """Whether a dotted name is that of a module here."""
        return self._path(name) is not None

    def key(self, *made_by: tuple[str, str | None]) -> str:
        """Hash of the code that is reached from modules, or from names that they define."""
        if made_by not in self._keys:
            self._keys[made_by] = _hash(sorted(self.parts(*made_by).values()))
        return self._keys[made_by]

    def parts(self, *made_by: tuple[str, str | None]) -> dict[str, str]:
        """Modules that are reached -> hash of what counts of each."""
        reached: dict[str, set[str | None]] = {}
        left = list(made_by)
        while left:
            name, wanted = left.pop()
            before = reached.setdefault(name, set())
            if wanted not in before:
                before.add(wanted)
                left += [self._home(found) for _, found in self._followed(name, before)]
        return {name: self._part(name, wanted) for name, wanted in reached.items()}

    def _part(self, name: str, wanted: set[str | None]) -> str:
        module = self._module(name)
        bound = set()
        for alias, found in self._followed(name, wanted):
            home, original = self._home(found)
            bound.add((alias, original or "", self._content(home, original)))
        return module.hash_of(self._statements(name, wanted), sorted(bound))

    def _content(self, name: str, wanted: str | None) -> str:
        """Hash of a module, or of what counts of it where a name is wanted, its imports apart."""
        if (name, wanted) not in self._contents:
            found = self._module(name).hash_of(self._statements(name, {wanted}))
            self._contents[name, wanted] = found
        return self._contents[name, wanted]

    def _statements(self, name: str, wanted: set[str | None]) -> list[_Statement]:
        module = self._module(name)
        if None in wanted or not module.is_sliced:
            return module.statements
        return module.reached(filter(None, wanted))

    def _followed(self, module_name: str, wanted: set[str | None]) -> Iterator[tuple[str, _Import]]:
        """Names of a module that are imported there, and from where."""
        module = self._module(module_name)
        statements = self._statements(module_name, wanted)
        uses = {name for s in statements for name in s.uses}
        every = statements is module.statements
        imports = [
            *(i for i in module.imports.values() if every or i.alias.partition(".")[0] in uses),
            *(i for s in statements for i in s.imports),
        ]
        for found in imports:
            package = self._module(found.module)
            if found.name is not None or not package.is_package:
                yield found.alias, found
                continue
            # A package by its name: what is asked of it, or all that it offers.
            asked = {u.partition(".")[2] for u in uses if u.startswith(f"{found.alias}.")}
            if "." in found.alias:
                asked = {*package.imports, *package.for_types}
            for name in asked:
                yield f"{found.alias}.{name}", _Import(name, found.module, name)

    def _home(self, found: _Import) -> tuple[str, str | None]:
        """The module that defines what is imported, and its name there."""
        if found.name is None:
            return found.module, None
        module = self._module(found.module)
        further = module.imports.get(found.name) or module.for_types.get(found.name)
        if module.is_package and further is not None:
            return self._home(further)
        inner = f"{found.module}.{found.name}"
        if module.is_package and self.has(inner):
            return inner, None
        return found.module, found.name

    def _module(self, name: str) -> _Module:
        if name not in self._modules:
            path = self._path(name)
            if path is None:
                raise InputError(f"{name} is no module of {' or '.join(self._folders)}")
            # Trees are many small objects, of which none is garbage before the last is there.
            was_enabled = gc.isenabled()
            gc.disable()
            try:
                self._modules[name] = _Module(name, path, self)
            finally:
                if was_enabled:
                    gc.enable()
        return self._modules[name]

    def _path(self, name: str) -> Path | None:
        if name not in self._paths:
            top, *rest = name.split(".")
            found = None
            if top in self._folders and all(part.isidentifier() for part in rest):
                place = self._folders[top].joinpath(*rest)
                for path in (place / "__init__.py", place.with_name(f"{place.name}.py")):
                    if path.is_file() and (rest or path.name == "__init__.py"):
                        found = path
                        break
            self._paths[name] = found
        return self._paths[name]


def _hash(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _is_for_types(node: ast.stmt) -> TypeGuard[ast.If]:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _binds(node: ast.stmt) -> frozenset[str]:
    """Names that a statement defines, if that is all it does."""
    match node:
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
            return frozenset([node.name])
        case ast.Assign():
            targets = node.targets
        case ast.AnnAssign():
            targets = [node.target]
        case _:
            return frozenset()
    names = [part for target in targets for part in getattr(target, "elts", [target])]
    if not all(isinstance(part, ast.Name) for part in names):
        return frozenset()
    return frozenset(part.id for part in names if isinstance(part, ast.Name))


SOURCES = Sources(mvest=Path(mvest.__file__).parent, experiments=Path(experiments.__file__).parent)


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
