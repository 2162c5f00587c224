"""Keys of code: what is reached counts, where it lies does not."""

import ast
from pathlib import Path

import pytest

import experiments
import mvest
from experiments.common.building import closure, patient_store
from experiments.common.building.twin import MADE_BY
from experiments.studies import imaged_patient
from experiments.studies.imaging.detectors import SAMPLED_BY
from mvest.errors import InputError
from mvest.simulation.population import draw_population
from mvest.simulation.trials import try_sequence
from mvest.source import SOURCES, Sources, source_key

FILES = {
    "mvest/__init__.py": "import lazy_loader\n__getattr__, _, __all__ = lazy_loader.attach()\n",
    "mvest/__init__.pyi": "from .law import stress as stress\nfrom .far import other as other\n",
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

__all__ = ["stress"]


def stress(x: float) -> float:
    """Text."""
    # Comment.
    return np.sin(SCALE * x)


def strain(x):
    return x
''',
    "mvest/rooms/__init__.py": "from mvest.rooms.tools import helper\n\nLIMIT = 3\nOTHER = 4\n",
    "mvest/rooms/tools.py": "def helper():\n    return 1\n",
    "mvest/rooms/second.py": "def helper():\n    return 2\n",
    "mvest/rooms/worker.py": "print(1)\n",
    "experiments/__init__.py": "",
    "experiments/base.py": "class Base:\n    size = 1\n",
    "experiments/build.py": """import sys
from pathlib import Path

import mvest.rooms
from experiments.base import Base
from mvest import stress
from mvest.far import other

WORKER = Path(mvest.rooms.__file__).with_name("worker.py")
TABLE = {}
TABLE["a"] = 1


class Maker(Base):
    def make(self):
        from mvest.rooms import LIMIT, helper

        return stress(helper()) + LIMIT + _inner()


def _inner():
    return 5


def report():
    return other(sys)
""",
}

ENTRY = ("experiments.build", "Maker")


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
    assert set(sources(code).parts(ENTRY)) == {
        "experiments.build", "experiments.base", "mvest.law", "mvest.units", "mvest.rooms",
        "mvest.rooms.tools",
    }  # fmt: skip
    edit(code, "experiments/build.py", "LIMIT, helper", "LIMIT, helper, second")
    assert "mvest.rooms.second" in sources(code).parts(ENTRY)
    # What another definition needs counts with that one; a whole module with all it imports.
    assert "mvest.far" in sources(code).parts(("experiments.build", "report"))
    assert {"mvest.far", "mvest.law"} <= set(sources(code).parts(("experiments.build", None)))


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("mvest/law.py", "# Comment.", "# Another one.\n\n"),
        ("mvest/law.py", '"""Text."""', '"""Another."""'),
        ("mvest/law.py", '"""About."""', ""),
        ("mvest/law.py", "SCALE * x", "(SCALE\n    * x)"),
        ("mvest/law.py", '["stress"]', '["strain", "stress"]'),
        ("mvest/law.py", "from mvest.never import NEVER", "from mvest.far import other"),
        ("mvest/law.py", "import numpy as np\n\nfrom mvest.units import SCALE",
         "from mvest.units import SCALE\nimport numpy as np"),
        ("mvest/law.py", "from mvest.units", "from .units"),
        ("experiments/build.py", "from mvest import stress", "from mvest.law import stress"),
        ("experiments/build.py", "from mvest.rooms import LIMIT, helper",
         "from mvest.rooms.tools import helper\n        from mvest.rooms import LIMIT"),
        ("experiments/build.py", "import sys", "import sys, json"),
        ("experiments/build.py", "other(sys)", "other(sys) + 1"),
        ("experiments/build.py", "import sys", "import sys\n\ndef unused():\n    return stress"),
        ("mvest/rooms/__init__.py", "OTHER = 4", "OTHER = 5"),
        ("mvest/__init__.pyi", "from .far import other as other\n", ""),
        ("mvest/never.py", "NEVER = 1", "NEVER = 2"),
        ("mvest/far.py", "return 1", "return 2"),
    ],
)  # fmt: skip
def test_what_has_no_part_changes_no_key(code, name, old, new):
    before = sources(code).key(ENTRY)
    edit(code, name, old, new)
    assert sources(code).key(ENTRY) == before


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("mvest/units.py", "2.0", "2"),
        ("mvest/law.py", "SCALE * x", "SCALE / x"),
        ("mvest/law.py", "return x", "return -x"),
        ("mvest/law.py", "import numpy as np", "import cupy as np"),
        ("mvest/law.py", "def stress(x: float)", "def stress(x: float = 0.0)"),
        ("mvest/rooms/__init__.py", "LIMIT = 3", "LIMIT = 4"),
        ("mvest/rooms/tools.py", "return 1", "return 2"),
        # Another function of the same name, and the same one by another name.
        ("mvest/rooms/__init__.py", "rooms.tools import", "rooms.second import"),
        ("experiments/build.py", "stress(helper())", "helper(stress())"),
        ("mvest/__init__.pyi", "from .law import stress", "from .law import strain"),
        ("experiments/base.py", "size = 1", "size = 2"),
        ("experiments/build.py", "return 5", "return 6"),
        ("experiments/build.py", 'TABLE["a"] = 1', 'TABLE["a"] = 2'),
        ("experiments/build.py", "LIMIT, helper", "OTHER as LIMIT, helper"),
    ],
)
def test_what_has_a_part_changes_the_key(code, name, old, new):
    before = sources(code).key(ENTRY)
    edit(code, name, old, new)
    assert sources(code).key(ENTRY) != before


def test_a_text_that_names_a_file_or_a_module_is_an_import(code):
    edit(code, "mvest/rooms/tools.py", "return 1", 'return __file__ + "worker.py"')
    edit(code, "mvest/rooms/tools.py", "def helper", 'import_module("mvest.never")\n\ndef helper')
    assert {"mvest.rooms.worker", "mvest.never"} <= set(sources(code).parts(ENTRY))
    before = sources(code).key(ENTRY)
    (code / "mvest" / "never.py").rename(code / "mvest" / "hardly.py")
    edit(code, "mvest/rooms/tools.py", "mvest.never", "mvest.hardly")
    assert sources(code).key(ENTRY) == before
    edit(code, "mvest/rooms/worker.py", "print(1)", "print(2)")
    assert sources(code).key(ENTRY) != before


@pytest.mark.parametrize("inside", [False, True])
def test_a_package_by_its_own_name_is_what_is_asked_of_it(code, inside):
    name, line = "experiments/build.py", "from mvest import stress\n"
    edit(code, name, line, "" if inside else "import mvest\n")
    if inside:
        edit(code, name, "def make(self):", "def make(self):\n        import mvest")
    edit(code, name, "return stress(", "return mvest.stress(")
    reached = sources(code).parts(ENTRY)
    assert "mvest.law" in reached
    assert "mvest.far" not in reached


def test_a_package_by_a_name_with_dots_is_all_that_it_offers(code):
    edit(code, "experiments/build.py", "LIMIT, helper", "LIMIT")
    assert "mvest.rooms.tools" not in sources(code).parts(ENTRY)
    edit(code, "experiments/build.py", "stress(helper())", "stress(mvest.rooms.helper())")
    assert "mvest.rooms.tools" in sources(code).parts(ENTRY)


def test_two_names_that_change_places_are_another_code(code):
    edit(code, "mvest/units.py", "SCALE = 2.0", "from mvest.far import other\nSCALE = other()")
    edit(code, "experiments/build.py", "return 5", "return other()")
    edit(code, "mvest/rooms/second.py", "helper", "other")
    old, new = "from mvest.far import other", "from mvest.rooms.second import other"
    edit(code, "experiments/build.py", "LIMIT, helper", "LIMIT, helper; import mvest.rooms.second")
    before = sources(code)
    assert {"mvest.far", "mvest.rooms.second"} <= set(before.parts(ENTRY))
    edit(code, "experiments/build.py", old, new)
    after = sources(code)
    assert set(after.parts(ENTRY)) == set(before.parts(ENTRY))
    assert after.key(ENTRY) != before.key(ENTRY)


def test_modules_may_be_moved_and_renamed(code):
    before = sources(code).key(ENTRY)
    moved = {"mvest.law": "mvest.physics.laws", "mvest.rooms.tools": "mvest.kit"}
    (code / "mvest" / "physics").mkdir()
    (code / "mvest" / "physics" / "__init__.py").touch()
    for old, new in moved.items():
        paths = [code.joinpath(*name.split(".")).with_suffix(".py") for name in (old, new)]
        paths[0].rename(paths[1])
    edit(code, "mvest/__init__.pyi", ".law", ".physics.laws")
    edit(code, "mvest/rooms/__init__.py", "mvest.rooms.tools", "mvest.kit")
    assert sources(code).key(ENTRY) == before
    (code / "experiments" / "build.py").rename(code / "experiments" / "valves.py")
    assert sources(code).key(("experiments.valves", "Maker")) == before
    edit(code, "mvest/kit.py", "return 1", "return 2")
    assert sources(code).key(("experiments.valves", "Maker")) != before


def test_a_process_has_the_code_with_which_it_began(code):
    its = sources(code)
    before = its.key(ENTRY)
    edit(code, "mvest/units.py", "2.0", "3.0")
    assert its.key(ENTRY) == before


def test_only_what_is_ours_has_a_key():
    assert source_key(closure, closure.build_mesh) == source_key(closure, closure.build_mesh)
    assert source_key(closure.build_mesh) != source_key(closure.closure_model)
    with pytest.raises(InputError, match="pathlib is no module of mvest or experiments"):
        source_key(Path)


def reached(*made_by) -> set[str]:
    return set(SOURCES.parts(*((made.__module__, made.__qualname__) for made in made_by)))


FORWARD = {
    "mvest.closure.model", "mvest.elements", "mvest.mechanics.forces.contact", "mvest.units",
    "mvest.mechanics.law.biot", "mvest.mechanics.solver", "mvest.valve.anatomy.template",
}  # fmt: skip


def test_what_is_kept_knows_what_makes_it():
    truth = reached(*MADE_BY)
    assert truth >= FORWARD | {"mvest.valve.mesh._tetwild_worker"}
    assert not [name for name in truth if name.startswith(("mvest.imaging", "mvest.reporting"))]
    assert not [name for name in truth if name.startswith("mvest.estimation.filters")]
    one = reached(patient_store._simulate, patient_store._write)
    assert one >= FORWARD | {"mvest.simulation.virtual_patient", "mvest.cases.writer"}
    assert not [name for name in one if name.startswith(("mvest.personalisation", "mvest.imaging"))]
    assert reached(draw_population) >= FORWARD | {"mvest.imaging.layout"}


def test_volumes_and_what_writes_them_count_where_they_are_used():
    imaged = reached(imaged_patient._simulate, imaged_patient._write)
    volumes = {
        "mvest.imaging.volume",
        "mvest.imaging.valve_sequence",
        "mvest.imaging.simulator.beams",
    }
    assert imaged >= FORWARD | volumes | {
        "mvest.exchange.segmentations", "mvest.cases.writer",
    }  # fmt: skip
    assert reached(*SAMPLED_BY) >= volumes
    tried = reached(try_sequence)
    assert tried >= volumes | {"mvest.imaging.detection.tracking", "mvest.imaging.detection.frame"}
    for found in (imaged, tried):
        assert not [name for name in found if name.startswith("experiments.common.cases")]


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
