"""What importing muxjax brings in, and which room may use which."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import muxjax

# Heavy or optional: only the rooms that need them may import them, and only when used.
OPTIONAL = [
    *("torch", "gymnasium", "stable_baselines3", "can", "cantools"),
    *("matplotlib", "mcap", "viser", "selenium"),
]

# ARCHITECTURE.md: nothing points back. A room imports rooms of earlier rows, and of its own row
# only itself (planning and hardware have rooms inside).
ORDER = [
    {"config"},
    {"precision"},
    {"robot"},
    {"kinematics", "bom"},
    {"tendons", "urdf"},
    {"batched"},
    {"statics", "collision"},
    {"workspace", "planning"},
    {"ik", "scheduler"},
    {"metrics", "hardware", "program_file", "plan_file", "trajectory_file"},
    {"recording"},
    {"pipeline", "viz", "schemas"},
    {"cli"},
    {"__init__", "__main__"},
]
PACKAGE = Path(muxjax.__file__).parent


def imported_with(statement: str, modules: list[str]) -> list[str]:
    """Those of ``modules`` that a fresh process has loaded after ``statement``."""
    code = f"{statement}\nimport sys\nprint([m for m in {modules!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ast.literal_eval(done.stdout)


def test_import_brings_in_nothing_optional():
    assert imported_with("import muxjax", OPTIONAL) == []


def test_the_import_test_can_fail():
    assert "cantools" in imported_with("import muxjax, cantools", OPTIONAL)


@pytest.mark.parametrize("core", ["envs.config", "envs.tdma", "envs.lanes"])
def test_the_core_of_the_environment_brings_in_nothing_optional(core):
    assert imported_with(f"import {core}", OPTIONAL) == []


def test_gymnasium_users_need_no_torch():
    assert imported_with("import envs.gymnasium_adapter", OPTIONAL) == ["gymnasium"]


def test_no_room_beside_the_package_is_pointed_back_at():
    """Rooms beside the package: envs uses muxjax, training uses both, nothing points back."""
    root = PACKAGE.parent
    used = {
        room: "".join(path.read_text() for path in (root / room).rglob("*.py"))
        for room in ("muxjax", "envs", "training")
    }
    for below, above in (("muxjax", "envs"), ("muxjax", "training"), ("envs", "training")):
        assert not re.search(rf"^\s*(from|import) {above}\b", used[below], re.MULTILINE)
    assert "from envs" in used["training"]


def test_config_needs_no_jax():
    """The face imports JAX, so config.py is loaded here by itself."""
    path = str(PACKAGE / "config.py")
    load = f"import runpy; runpy.run_path({path!r})"
    assert imported_with(load, ["jax", "yaml"]) == ["yaml"]


def level(room: str) -> int:
    """Row of a room in ORDER."""
    for row, rooms in enumerate(ORDER):
        if room in rooms:
            return row
    raise LookupError(f"muxjax/{room} stands nowhere in the order of tests/test_imports.py")


def rooms_used(source: str, package: str = "muxjax") -> set[str]:
    """Rooms that a file's imports name, at any depth of the file."""
    used: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                stem = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*stem, base]).rstrip(".")
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == "muxjax":
                used.add(parts[1] if len(parts) > 1 else "__init__")
    return used


def trespasses(room: str, source: str, package: str = "muxjax") -> set[str]:
    """Rooms that a file of ``room`` uses although they are not below it."""
    return {
        other
        for other in rooms_used(source, package)
        if other != room and level(other) >= level(room)
    }


FILES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_room_imports_a_room_above_it(path):
    inside = path.relative_to(PACKAGE).with_suffix("")
    package = ".".join(["muxjax", *inside.parts[:-1]])
    assert trespasses(inside.parts[0], path.read_text(), package) == set()


@pytest.mark.parametrize(
    ("room", "package", "source", "found"),
    [
        ("robot", "muxjax", "from muxjax.ik import solve_ik", {"ik"}),
        ("kinematics", "muxjax", "from muxjax import tendons", {"tendons"}),
        ("tendons", "muxjax", "def f():\n    import muxjax.metrics", {"metrics"}),
        ("robot", "muxjax", "from . import pipeline", {"pipeline"}),
        ("planning", "muxjax.planning", "from ..scheduler import Program", {"scheduler"}),
        ("planning", "muxjax.planning", "from .problem import step", set()),
        ("ik", "muxjax", "from muxjax.kinematics import jacobian\nimport numpy", set()),
        ("hardware", "muxjax.hardware", "import muxjax", {"__init__"}),
    ],
)
def test_the_order_test_can_fail(room, package, source, found):
    assert trespasses(room, source, package) == found


def test_an_unknown_room_is_noticed():
    with pytest.raises(LookupError, match=r"muxjax/attic stands nowhere"):
        trespasses("cli", "import muxjax.attic")
    with pytest.raises(LookupError, match=r"muxjax/cellar stands nowhere"):
        trespasses("cellar", "import muxjax.config")
