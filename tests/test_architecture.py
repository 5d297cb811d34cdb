"""Who may import whom, and what importing the package costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "sumo_cohesion"

# Rooms in the order of one step; a room may import those its row names, and the shared values.
SHARED = {"errors", "locks", "state", "road"}
ALLOWED = {
    "errors": set(),
    "locks": set(),
    "state": set(),
    "versions": set(),
    "user_input": {"errors"},
    "road": {"state"},
    "traffic": SHARED | {"user_input"},
    "perception": SHARED,
    "social": SHARED | {"perception"},
    "planning": SHARED | {"perception", "social"},
    "tables": {"errors", "state"},
    "simulation": SHARED
    | {"traffic", "perception", "social", "planning", "tables", "user_input", "versions"},
    "batches": SHARED | {"traffic", "planning", "simulation", "tables", "user_input", "versions"},
    "report": SHARED | {"tables", "batches"},
    "cli": {
        "errors",
        "planning",
        "simulation",
        "tables",
        "batches",
        "report",
        "user_input",
        "versions",
    },
    "__main__": {"cli"},
    "__init__": {"errors", "state", "planning", "simulation", "tables", "batches"},
}
OUTSIDE = {
    "libsumo": {"traffic"},
    "sumolib": {"traffic"},
    "traci": {"traffic"},
    "casadi": {"planning"},
}


def imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.name))
def test_imports_go_one_way(path: Path) -> None:
    own = room(path)
    for name in imports(path):
        parts = name.split(".")
        if parts[0] == "sumo_cohesion" and len(parts) > 1 and parts[1] != own:
            assert parts[1] in ALLOWED[own], f"{own} imports {name}"
        if parts[0] in OUTSIDE:
            assert own in OUTSIDE[parts[0]], f"{own} imports {name}"


def test_metrics_and_statistics_see_tables_only() -> None:
    for name in ("metrics", "intervals", "columns"):
        inside = {n for n in imports(PACKAGE / "tables" / f"{name}.py") if "sumo_cohesion" in n}
        assert inside <= {"sumo_cohesion.tables.columns", "sumo_cohesion.state"}


def test_importing_the_package_loads_neither_sumo_nor_casadi() -> None:
    code = (
        "import sys, sumo_cohesion;"
        "heavy = {'libsumo', 'sumolib', 'casadi', 'pandas', 'matplotlib', 'scipy'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_loop_fits_a_screen() -> None:
    tree = ast.parse((PACKAGE / "simulation" / "run.py").read_text(encoding="utf-8"))
    (loop,) = [n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == "simulate"]
    assert loop.end_lineno is not None
    assert loop.end_lineno - loop.lineno + 1 <= 40
