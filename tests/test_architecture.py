"""Who may load whom, directly or not, and what importing the package costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "sumo_cohesion"

# What a module of a room may load, directly or through others; besides its own room.
SHARED = {"errors", "locks", "state", "road", "road_shape", "user_input", "versions"}
ONE_CAR = SHARED | {"perception", "social", "planning"}
RUN = ONE_CAR | {"traffic", "tables", "simulation"}
LEARN = {"learning", "demonstrations"}
ALLOWED = {
    "errors": set(),
    "locks": set(),
    "versions": set(),
    "state": set(),
    "user_input": {"errors"},
    "road": {"state"},
    "road_shape": {"road", "state"},
    "traffic": SHARED,
    "perception": SHARED,
    "social": SHARED | {"perception"},
    "planning": SHARED | {"perception", "social"},
    "tables": {"errors", "state"},
    "simulation": RUN,
    "batches": RUN,
    "learning": SHARED | {"planning", "perception", "social", "tables"},
    "demonstrations": RUN | {"learning", "batches"},
    "report": {"errors", "state", "tables"},
    "cli": RUN | {"batches", "report", "__init__"} | LEARN,
    "__main__": RUN | {"batches", "report", "cli"} | LEARN,
    "__init__": RUN | {"batches"} | LEARN,
}
OUTSIDE = {
    "libsumo": {"traffic"},
    "sumolib": {"traffic"},
    "traci": {"traffic"},
    "casadi": {"planning", "learning"},
}
NOBODY_NEEDS = {"cli", "report", "__main__"}
"""Rooms that only the command line opens."""


def files() -> dict[str, Path]:
    """All modules by name within the package."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        if "data" not in path.relative_to(PACKAGE).parts:
            parts = path.relative_to(PACKAGE).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" and parts[1:] else parts)] = path
    return found


FILES = files()


def for_types_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)


def imports(path: Path) -> set[str]:
    """Names that a module imports when it runs, within functions too."""
    names: set[str] = set()
    left: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while left:
        node = left.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            named = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = {name for name in named if name.removeprefix("sumo_cohesion.") in FILES}
            names |= modules or {node.module}
        if not for_types_only(node):
            left += ast.iter_child_nodes(node)
    return names


@cache
def own_imports(module: str) -> frozenset[str]:
    """Modules of the package that one imports."""
    names = {n.removeprefix("sumo_cohesion.") for n in imports(FILES[module])}
    return frozenset(names & set(FILES))


def loaded(module: str) -> set[str]:
    """Modules of the package that importing and calling one can load."""
    found: set[str] = set()
    left = [module]
    while left:
        for name in own_imports(left.pop()) - found:
            found.add(name)
            left.append(name)
    return found


def room(module: str) -> str:
    return module.partition(".")[0]


@pytest.mark.parametrize("module", sorted(FILES))
def test_a_room_loads_only_what_it_may(module: str) -> None:
    own = room(module)
    rooms = {room(name) for name in loaded(module)} - {own}
    assert rooms <= ALLOWED[own], f"{module} loads {sorted(rooms - ALLOWED[own])}"
    for name in imports(FILES[module]):
        outside = name.partition(".")[0]
        assert own in OUTSIDE.get(outside, {own}), f"{module} imports {outside}"
    if own not in ("cli", "__main__"):
        assert not rooms & NOBODY_NEEDS


def test_no_two_modules_need_each_other() -> None:
    circles = [name for name in FILES if name in loaded(name)]
    assert circles == []


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_importing_the_package_loads_neither_sumo_nor_casadi() -> None:
    code = (
        "import sys, sumo_cohesion;"
        "heavy = {'libsumo', 'sumolib', 'casadi', 'pandas', 'matplotlib', 'scipy'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    assert run_python(code) == "[]"


def test_reading_a_saved_run_loads_a_handful_of_modules() -> None:
    code = (
        "import sys; from sumo_cohesion import Rollout;"
        "print(len([m for m in sys.modules if m.startswith('sumo_cohesion')]),"
        "sorted({'libsumo', 'sumolib', 'casadi', 'pydantic', 'scipy'} & set(sys.modules)))"
    )
    count, _, heavy = run_python(code).partition(" ")
    assert int(count) <= 10
    assert heavy == "[]"


@pytest.mark.parametrize(
    ("module", "function", "lines"),
    [("simulation.run", "drive", 40), ("simulation.episode", "step", 50)],
)
def test_the_loop_fits_a_screen(module: str, function: str, lines: int) -> None:
    tree = ast.parse(FILES[module].read_text(encoding="utf-8"))
    (loop,) = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == function]
    assert loop.end_lineno is not None
    assert loop.end_lineno - loop.lineno + 1 <= lines
