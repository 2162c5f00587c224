"""Keys of code: all that is reached by imports counts, comments and layout do not."""

import ast
import re
from pathlib import Path

import pytest

import experiments
import mvest
from experiments.common.building import closure, patient_store
from experiments.common.building.twin import MADE_BY
from experiments.studies import imaged_patient
from experiments.studies.imaging.detectors import SAMPLED_BY
from mvest.cache import SOURCES, Sources, source_key
from mvest.errors import InputError
from mvest.simulation.population import draw_population
from mvest.simulation.trials import try_sequence

FILES = {
    "mvest/__init__.py": "LOADED = 1\n",
    "mvest/units.py": "SCALE = 2.0\n",
    "mvest/far.py": "import mvest.never\n\ndef other():\n    return 1\n",
    "mvest/never.py": "NEVER = 1\n",
    "mvest/law.py": '''"""About."""
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mvest.units import SCALE

if TYPE_CHECKING:
    from mvest.never import NEVER


def stress(x: float) -> float:
    """Text of mvest.never."""
    # Comment.
    return np.sin(SCALE * x)
''',
    "mvest/rooms/__init__.py": "from mvest.rooms.tools import helper\n\nLIMIT = 3\n",
    "mvest/rooms/tools.py": "def helper():\n    return 1\n",
    "mvest/rooms/second.py": "def helper():\n    return 2\n",
    "mvest/rooms/worker.py": "print(1)\n",
    "experiments/__init__.py": "",
    "experiments/base.py": "class Base:\n    size = 1\n",
    "experiments/build.py": """from experiments.base import Base
from mvest.far import other
from mvest.law import stress

TABLE = {}
TABLE["a"] = 1


class Maker(Base):
    def make(self):
        from mvest.rooms import LIMIT, helper

        return stress(helper()) + LIMIT + _inner() + other()


def _inner():
    return 5
""",
}

ENTRY = "experiments.build"


@pytest.fixture
def code(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def sources(code: Path) -> Sources:
    return Sources(mvest=code / "mvest", experiments=code / "experiments")


def edit(code: Path, name: str, old: str, new: str) -> None:
    assert old in (code / name).read_text()
    (code / name).write_text((code / name).read_text().replace(old, new))


def test_the_imports_are_followed(code):
    assert sources(code).reached(ENTRY) == {
        "experiments.build", "experiments.base", "mvest.law", "mvest.units", "mvest.far",
        "mvest.never", "mvest.rooms", "mvest.rooms.tools",
    }  # fmt: skip
    edit(code, "experiments/build.py", "LIMIT, helper", "LIMIT, helper, second")
    assert "mvest.rooms.second" in sources(code).reached(ENTRY)
    assert sources(code).reached("mvest.law") == {"mvest.law", "mvest.units"}


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("mvest/law.py", "# Comment.", "# Another one.\n\n"),
        ("mvest/law.py", '"""Text of mvest.never."""', '"""Another."""'),
        ("mvest/law.py", '"""About."""', ""),
        ("mvest/law.py", "SCALE * x", "(SCALE\n    * x)"),
        ("mvest/law.py", "from mvest.never import NEVER", "from mvest.far import other"),
        ("mvest/never.py", "NEVER = 1", "NEVER = 2"),
        ("mvest/far.py", "return 1", "return 2"),
    ],
)
def test_what_has_no_part_changes_no_key(code, name, old, new):
    before = sources(code).key("mvest.law")
    edit(code, name, old, new)
    assert sources(code).key("mvest.law") == before


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("mvest/units.py", "2.0", "2"),
        ("mvest/law.py", "SCALE * x", "SCALE / x"),
        ("mvest/law.py", "import numpy as np", "import cupy as np"),
        ("mvest/law.py", "def stress(x: float)", "def stress(x: float = 0.0)"),
        ("mvest/rooms/__init__.py", "LIMIT = 3", "LIMIT = 4"),
        ("mvest/rooms/tools.py", "return 1", "return 2"),
        ("mvest/rooms/__init__.py", "rooms.tools import", "rooms.second import"),
        ("experiments/base.py", "size = 1", "size = 2"),
        ("experiments/build.py", "return 5", "return 6"),
        ("experiments/build.py", 'TABLE["a"] = 1', 'TABLE["a"] = 2'),
        ("mvest/never.py", "NEVER = 1", "NEVER = 2"),
    ],
)
def test_what_has_a_part_changes_the_key(code, name, old, new):
    before = sources(code).key(ENTRY)
    edit(code, name, old, new)
    assert sources(code).key(ENTRY) != before


@pytest.mark.parametrize("text", ['"worker.py"', 'import_module("mvest.rooms.worker")'])
def test_a_text_that_names_a_file_or_a_module_is_an_import(code, text):
    edit(code, "mvest/rooms/tools.py", "return 1", f"return {text}")
    assert sources(code).reached("mvest.rooms.tools") == {"mvest.rooms.tools", "mvest.rooms.worker"}


def test_a_process_has_the_code_with_which_it_began(code):
    its = sources(code)
    before = its.key(ENTRY)
    edit(code, "mvest/units.py", "2.0", "3.0")
    assert its.key(ENTRY) == before


def test_only_what_is_ours_has_a_key():
    assert source_key(closure, closure.build_mesh) == source_key(closure.closure_model)
    assert source_key(closure) != source_key(patient_store)
    with pytest.raises(InputError, match="pathlib is no module of mvest or experiments"):
        source_key(Path)


def reached(*made_by) -> set[str]:
    return SOURCES.reached(*(made.__module__ for made in made_by))


FORWARD = {
    "mvest.closure.model", "mvest.elements", "mvest.mechanics.forces.contact", "mvest.units",
    "mvest.mechanics.law.biot", "mvest.mechanics.solver", "mvest.valve.anatomy.template",
}  # fmt: skip


def test_what_is_kept_knows_what_makes_it():
    truth = reached(*MADE_BY)
    assert truth >= FORWARD | {"mvest.valve.mesh._tetwild_worker"}
    others = ("mvest.imaging", "mvest.estimation.filters", "mvest.personalisation")
    assert not [name for name in truth if name.startswith(others)]
    one = reached(patient_store._simulate, patient_store._write)
    assert one >= FORWARD | {"mvest.simulation.virtual_patient", "mvest.cases.folder"}
    assert reached(draw_population) >= FORWARD | {"mvest.imaging.layout"}
    imaged = reached(imaged_patient._simulate, imaged_patient._write)
    assert imaged >= FORWARD | {"mvest.exchange.segmentations", "mvest.imaging.simulator.beams"}
    tried = reached(try_sequence)
    assert tried >= {"mvest.imaging.detection.tracking", "mvest.imaging.detection.frame"}
    assert reached(*SAMPLED_BY) >= {"mvest.imaging.volume", "mvest.imaging.simulator.beams"}


def test_no_maker_imports_what_the_package_loads_on_first_use():
    # Such imports are not followed.
    for root in (Path(mvest.__file__).parent, Path(experiments.__file__).parent):
        for path in root.rglob("*.py"):
            for names in re.findall(r"^\s*from mvest import (.+)", path.read_text(), re.MULTILINE):
                assert set(names.split(", ")) <= {"errors", "__version__"}, path


def test_importing_a_package_of_ours_has_no_effect():
    # What an __init__ does on the way to one of its modules is in no key. (That of experiments
    # limits threads, and that of mvest says where numba keeps what it has compiled.)
    roots = (Path(mvest.__file__).parent, *Path(experiments.__file__).parent.glob("*/"))
    for path in (path for root in roots for path in root.rglob("__init__.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
            if ast.unparse(node) == "choose_cache()":
                continue
            harmless = ast.Import | ast.ImportFrom | ast.Assign | ast.FunctionDef | ast.ClassDef
            assert is_text or isinstance(node, harmless), f"{path}:{node.lineno}"
