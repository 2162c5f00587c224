"""Import directions between packages, declared dependencies, and what tracked files may contain.

Imports are read from the source, so that one inside a function or for type checking counts as well.
"""

import ast
import ipaddress
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import mvest
from experiments.common.study import study_names
from tests.places import ROOT

LEAVES = (
    "mvest._compiling",
    "mvest.errors",
    "mvest.files",
    "mvest.cache",
    "mvest.reading",
    "mvest.processes",
    "mvest.units",
    "mvest.typing",
    "mvest.quantities",
    "mvest.elements",
)
VALUE_OBJECTS = (
    "mvest.valve.anatomy.valve",
    "mvest.valve.mesh.cells",
    "mvest.valve.mesh.solid_mesh",
)

FILES = (
    "mvest.exchange.surfaces",
    "mvest.exchange.volumes",
    "mvest.exchange.markups",
)
"""Of the exchange of files, what cases are read by."""
IMPORT_AND_EXPORT = (
    *LEAVES,
    "mvest.valve",
    "mvest.mechanics",
    "mvest.imaging",
    "mvest.closure",
    "mvest.problem",
    "mvest.cases",
    "mvest.exchange",
)

CLOSURES = (*LEAVES, "mvest.valve", "mvest.mechanics", "mvest.estimation", "mvest.closure")

# What each room of mvest may import from mvest, itself aside: the longest name that fits counts.
# What is not listed has no place.
MAY_IMPORT: dict[str, tuple[str, ...]] = {
    "mvest": ("mvest._compiling",),
    "mvest.__main__": (),
    **dict.fromkeys(LEAVES, LEAVES),
    "mvest._compiling": (),
    "mvest.provenance": LEAVES,
    "mvest.valve": LEAVES,
    "mvest.mechanics": (*LEAVES, *VALUE_OBJECTS),
    "mvest.imaging": (*LEAVES, *VALUE_OBJECTS),
    "mvest.estimation": LEAVES,
    "mvest.closure": (*LEAVES, "mvest.valve", "mvest.mechanics", "mvest.estimation"),
    "mvest.observation": (*LEAVES, "mvest.valve", "mvest.estimation"),
    "mvest.problem": (*CLOSURES, "mvest.provenance", "mvest.observation"),
    "mvest.cases": (*LEAVES, *FILES, "mvest.provenance", "mvest.valve"),
    "mvest.cases.from_images": (*LEAVES, *FILES, "mvest.valve", "mvest.imaging", "mvest.cases"),
    "mvest.exchange": (*CLOSURES, "mvest.provenance", "mvest.imaging"),
    "mvest.exchange.importing": IMPORT_AND_EXPORT,
    "mvest.exchange.exporting": IMPORT_AND_EXPORT,
    "mvest.personalisation": (
        *CLOSURES,
        "mvest.provenance",
        "mvest.observation",
        "mvest.problem",
        "mvest.cases",
    ),
    "mvest.scenarios": CLOSURES,
    "mvest.simulation": (
        *LEAVES,
        "mvest.provenance",
        "mvest.valve",
        "mvest.mechanics",
        "mvest.imaging",
        "mvest.exchange",
        "mvest.closure",
        "mvest.observation",
        "mvest.problem",
        "mvest.cases",
    ),
    "mvest.reporting": (
        *LEAVES,
        "mvest.provenance",
        "mvest.valve",
        "mvest.imaging",
        "mvest.estimation",
        "mvest.problem",
        "mvest.cases",
        "mvest.personalisation.record",
        "mvest.personalisation.result",
    ),
}
NEVER_IN_MVEST = ("hydra", "hydra_plugins", "omegaconf", "mlflow", "experiments", "conf", "tests")
LEADS_OUT = ("mvest.__main__:", "experiments.cli.main")
"""The command leads to what is installed beside the library: see decisions.md."""
NEVER_IN_EXPERIMENTS = ("tests",)
STUDIES, IN_COMMON = "experiments.studies", "experiments.common"
"""A study's room imports of the experiments itself and what all have in common, no other study."""
RUNNER = "experiments.runner"
ORDINARY_WORDS = {"case", "volume", "gate", "closure", "external", "filters", "patient"}
"""Names of studies that are also parts of a configuration, or words."""
RUNNER_ROOMS = (
    "jobs", "plan", "compose", "metrics", "tracking", "cluster", "engine", "job",
)  # fmt: skip
"""In the runner a module imports none that comes after it; one that is not listed comes last."""

IMPORT_NAME = {
    "hydra-core": ("hydra", "omegaconf"),
    "markdown-it-py": ("markdown_it",),
    "matplotlib": ("matplotlib", "mpl_toolkits"),
    "pillow": ("PIL",),
    "pynrrd": ("nrrd",),
    "pyyaml": ("yaml",),
    "scikit-image": ("skimage",),
    "scikit-fem": ("skfem",),
    "simpleitk": ("SimpleITK",),
    "vtk": ("vtkmodules",),
}
OPTIONAL = ("files", "viz", "cluster", "postgres", "second-model")
"""Extras that mvest and experiments may use, within functions."""

LOCKED = ("files", "dev", "docs", "viz", "cluster")
"""Extras that `make lock` pins."""


class Import(NamedTuple):
    line: int
    name: str
    at_import_time: bool


def within(name: str, module: str) -> bool:
    return name == module or name.startswith(module + ".")


@cache
def imports(source: str, module: str, is_package: bool = False) -> list[Import]:
    """Every absolute dotted name that a module's source imports, wherever it does so."""
    tree, found = ast.parse(source), []
    deferred: set[ast.AST] = set()
    for node in ast.walk(tree):
        is_guard = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        if is_guard or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            deferred.update(ast.walk(node))
    for node in ast.walk(tree):
        names: list[str] = []
        match node:
            case ast.Import():
                names = [alias.name for alias in node.names]
            case ast.ImportFrom():
                parents = module.split(".")
                keep = len(parents) - node.level + is_package
                base = ".".join([*parents[:keep], *([node.module] if node.module else [])])
                base = base if node.level else str(node.module)
                names = [f"{base}.{alias.name}" for alias in node.names]
            case ast.Call(
                func=ast.Name(id="__import__" | "import_module")
                | ast.Attribute(attr="import_module"),
                args=[ast.Constant(value=str(name)), *_],
            ):
                names = [name]
        found += [Import(node.lineno, name, node not in deferred) for name in names]
    return found


def runner_level(module: str) -> int:
    room = module.removeprefix(RUNNER + ".").split(".")[0]
    return RUNNER_ROOMS.index(room) if room in RUNNER_ROOMS else len(RUNNER_ROOMS)


def import_violations(source: str, module: str, is_package: bool = False) -> list[str]:
    """Import-direction rules that a module's source breaks, one message each."""
    if not within(module, "mvest"):
        forbidden, allowed, station = NEVER_IN_EXPERIMENTS, ("mvest",), module.split(".")[0]
        if within(module, STUDIES):
            station = ".".join(module.split(".")[:3])
    else:
        forbidden = NEVER_IN_MVEST
        rooms = [room for room in MAY_IMPORT if within(module, room) and room != "mvest"]
        if not rooms and module != "mvest":
            return [f"{module} has no place in the house: add its room to MAY_IMPORT"]
        station = max(rooms, key=len, default="mvest")
        allowed = MAY_IMPORT[station]
    broken = []
    for line, name, _ in imports(source, module, is_package):
        if any(within(name, other) for other in forbidden):
            broken.append(f"{module}:{line} imports {name}")
        elif within(module, STUDIES) and within(name, "experiments"):
            if not within(name, station) and not within(name, IN_COMMON):
                broken.append(f"{module}:{line} imports {name}")
        elif within(module, RUNNER) and within(name, RUNNER):
            if runner_level(name) > runner_level(module):
                broken.append(f"{module}:{line} imports {name}")
        elif within(name, "mvest"):
            inside = station != "mvest" and within(name, station)
            if not inside and not any(within(name, other) for other in allowed):
                broken.append(f"{module}:{line} imports {name}")
    return broken


def modules(*packages: str) -> list[tuple[str, Path]]:
    found = []
    for path in sorted(path for package in packages for path in (ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found.append((".".join(parts[:-1] if parts[-1] == "__init__" else parts), path))
    return found


def test_imports_go_one_way() -> None:
    found = modules("mvest", "experiments")
    assert "mvest.errors" in dict(found)
    broken = [
        message
        for module, path in found
        for message in import_violations(
            path.read_text(encoding="utf-8"), module, path.name == "__init__.py"
        )
        if not (message.startswith(LEADS_OUT[0]) and message.endswith(LEADS_OUT[1]))
    ]
    assert broken == []


@pytest.mark.parametrize(
    ("module", "source", "count"),
    [
        # Siblings do not cross, however the import is written.
        ("mvest.valve.anatomy.template", "from mvest import imaging", 1),
        ("mvest.valve.anatomy.template", "from ...estimation import gaussian", 1),
        ("mvest.reporting.figures", "if TYPE_CHECKING:\n    import mvest.mechanics", 1),
        ("mvest.valve.anatomy.template", "from . import mesh\nfrom mvest.valve import a", 0),
        # Mechanics and imaging know the value objects of the valve only, and leaves only leaves.
        ("mvest.mechanics.law.biot", "from mvest.valve.anatomy.template import make_template", 1),
        ("mvest.mechanics.law.biot", "from mvest.valve.mesh.solid_mesh import SolidMesh", 0),
        ("mvest.errors", "from mvest.provenance import git_state", 1),
        # The library does not know how it is run. A name that begins alike is another package.
        ("mvest.problem.estimate", "import hydra", 1),
        ("mvest.problem.estimate", "import hydrate, mlflower, testslide", 0),
        ("experiments.run", "from tests.valve import shapes", 1),
        # A study knows no other, nor what runs or publishes it.
        ("experiments.studies.a", "from experiments.studies.ab import STUDY", 1),
        ("experiments.studies.a", "def f():\n    import experiments.runner.job", 1),
        # A job does not depend on how jobs are run or logged.
        ("experiments.runner.jobs", "from experiments.runner.tracking import store", 1),
        ("experiments.runner.job", "from experiments.runner.tracking import store", 0),
        # Nothing imports the package's face, and a new package needs a place.
        ("mvest.problem.estimate", "from mvest import Gaussian", 1),
        ("mvest.helpers", "import math", 1),
    ],
)
def test_wrong_imports_are_seen(module: str, source: str, count: int) -> None:
    assert len(import_violations(source, module, is_package=module == "mvest")) == count


def test_nothing_in_the_house_goes_through_a_lazy_face() -> None:
    # What a module depends on is read from its imports, and a face would hide it.
    faces = {
        ".".join(stub.relative_to(ROOT).parent.parts): {
            alias.name
            for node in ast.walk(ast.parse(stub.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom) and node.module
            for alias in node.names
        }
        for stub in (ROOT / "mvest").rglob("__init__.pyi")
    }
    assert "Gaussian" in faces["mvest.estimation"]
    hidden = [
        f"{module}:{line} imports {name}"
        for module, path in modules("mvest", "experiments")
        for line, name, _ in imports(path.read_text(encoding="utf-8"), module)
        if name.rpartition(".")[2] in faces.get(name.rpartition(".")[0], ())
    ]
    assert hidden == []


def test_common_and_runner_name_no_study() -> None:
    # A study is found by being there: what studies share and what runs them knows none by name.
    names = study_names()
    assert "twin" in names
    found = [
        f"{module}: {node.value!r}"
        for module, path in modules("experiments")
        if within(module, IN_COMMON) or within(module, RUNNER)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value in set(names) - ORDINARY_WORDS
    ]
    assert found == []


def test_what_table_1_needs_is_small() -> None:
    """Lines of all modules that the study of Table 1 loads, with what draws its figures."""
    code = (
        "import sys\nfrom experiments.common.study import load_study\nload_study('twin')\n"
        "import mvest.reporting.case.figures\n"
        "print(*(m.__file__ for n, m in sorted(sys.modules.items())"
        " if n.partition('.')[0] in ('mvest', 'experiments') and m.__file__), sep='\\n')"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    paths = [Path(line) for line in said.splitlines()]
    assert ROOT / "experiments" / "studies" / "twin.py" in paths
    assert sum(path.read_text(encoding="utf-8").count("\n") for path in paths) <= 25_000


# --- names --------------------------------------------------------------------------------------


def test_a_public_class_of_the_library_has_a_name_of_its_own() -> None:
    places: dict[str, list[str]] = {}
    for module, path in modules("mvest"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(module)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


# --- dependencies -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def import_names(requirements: list[str]) -> set[str]:
    names: set[str] = set()
    for text in requirements:
        distribution = canonicalize_name(Requirement(text).name)
        names.update(IMPORT_NAME.get(distribution, (distribution.replace("-", "_"),)))
    return names


def undeclared(source: str, module: str, required: set[str], optional: set[str]) -> list[str]:
    """Third-party imports that an installation without extras would not satisfy."""
    own = {"mvest", "experiments", "conf"}
    messages = []
    for line, name, at_import_time in imports(source, module):
        top = name.split(".")[0]
        if top in own | required or top in sys.stdlib_module_names:
            continue
        if top not in optional:
            messages.append(f"{module}:{line} imports {top}, which pyproject.toml does not name")
        elif at_import_time:
            messages.append(f"{module}:{line} imports {top} of an extra outside a function")
    return messages


def test_what_is_imported_is_declared(project: dict) -> None:
    required = import_names(project["dependencies"])
    extras = project["optional-dependencies"]
    optional = import_names([text for name in OPTIONAL for text in extras[name]])
    messages = [
        message
        for module, path in modules("mvest", "experiments")
        if path.name != "__init__.py"
        for message in undeclared(path.read_text(encoding="utf-8"), module, required, optional)
    ]
    assert messages == []


def test_the_lock_file_fits_the_declared_dependencies(project: dict) -> None:
    extras = project["optional-dependencies"]
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    locked = {
        canonicalize_name(found[1]): found[2]
        for line in lines
        if (found := re.match(r"([A-Za-z0-9._-]+)==([^\s;]+)", line))
    }
    for text in [*project["dependencies"], *(one for name in LOCKED for one in extras[name])]:
        requirement = Requirement(text)
        version = locked.get(canonicalize_name(requirement.name))
        assert version is not None, f"run `make lock`: {text} is missing"
        assert requirement.specifier.contains(version), f"run `make lock`: {text} has {version}"


# --- what tracked files say ---------------------------------------------------------------------

MACHINE_PATH = re.compile(
    r"(?<![\w.{}<>$~/)-])/(?:home|root|Users|work|opt|tmp|mnt|scratch|private)/[\w.]"
)
URL = re.compile(
    r"\b(?:https?|ftp|ssh|git|postgresql)://(?:[^@/\s\"'`<>]+@)?([^/:\s\"'`<>)\]}\\,]+)"
)
PRIVATE_ENDINGS = ("local", "internal", "intranet", "lan", "corp", "home", "localdomain")
LOOPBACK = ("localhost", "127.0.0.1", "0.0.0.0")


def is_public(host: str) -> bool:
    """Whether anyone on the internet could mean the same host by this name."""
    try:
        return ipaddress.ip_address(host).is_global
    except ValueError:
        return "." in host and host.rsplit(".", 1)[1].lower() not in PRIVATE_ENDINGS


def private_mentions(text: str) -> list[str]:
    """Machine paths, file addresses and hosts that only one network knows."""
    found = [match[0] for match in MACHINE_PATH.finditer(text)]
    found += re.findall(r"file:" + r"//\S+", text)
    hosts = (match[1] for match in URL.finditer(text))
    return found + [host for host in hosts if host not in LOOPBACK and not is_public(host)]


def tracked_files() -> list[Path]:
    try:
        listing = subprocess.run(
            ["git", "-C", str(ROOT), "ls-files", "-z"], check=True, capture_output=True, text=True
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout, so nothing is tracked")
    return [ROOT / name for name in listing.split("\0") if name and (ROOT / name).is_file()]


def test_tracked_files_name_no_machine_path_and_no_private_host() -> None:
    mentions = {}
    for path in tracked_files():
        content = path.read_bytes()
        if b"\0" in content[:8192]:
            continue
        if found := private_mentions(content.decode("utf-8", errors="replace")):
            mentions[str(path.relative_to(ROOT))] = found
    assert mentions == {}


# The examples are put together here, so that this file passes its own check.
@pytest.mark.parametrize(
    "text",
    [
        '"/' + 'Users/someone"',
        "--find-links file:" + "///srv/wheels",
        "http:" + "//someone:secret@10.0.0.7/simple",
        "git clone ssh:" + "//git@server.lan/repository",
    ],
)
def test_a_private_mention_is_seen(text: str) -> None:
    assert len(private_mentions(text)) == 1


def test_versions_agree(project: dict) -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    cited = re.search(r"^version: (\S+)$", citation, flags=re.MULTILINE)
    assert cited is not None
    assert cited[1] == project["version"] == mvest.__version__
