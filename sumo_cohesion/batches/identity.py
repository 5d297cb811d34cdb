"""Which run is which: a digest of everything that decides its result."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import sys
from functools import lru_cache
from pathlib import Path
from types import CodeType

import sumo_cohesion
from sumo_cohesion.planning.registry import BUILT_IN, WITHOUT_COHESION, parse_planner
from sumo_cohesion.planning.solvers import SOLVERS
from sumo_cohesion.simulation.setup import Inputs
from sumo_cohesion.traffic.xml_files import files_behind
from sumo_cohesion.versions import versions

_WALK = (
    "simulation.run",
    *[f"planning.solvers.{how.partition(':')[0]}" for how in SOLVERS.values()],
)
"""Modules that a run begins with; what they import, directly or not, decides its result."""
_KEEPING = ("tables.rollout", "tables.folders")
"""Of these, those that only say how a result is kept."""


def point_digest(inputs: Inputs) -> str:
    """Digest of all that decides a run but its seed.

    The scenario and the settings as they are used, the content of its network and demand, the
    planner's code, this package's code, and the versions of SUMO and the other libraries. What
    merely says what to keep is left out.
    """
    planner = inputs.planner_name
    cohesion = inputs.cohesion.model_dump(mode="json")
    demand = (*inputs.routes, *inputs.additional)
    behind = [inner for path in demand for inner in files_behind(path)]
    about = {
        "scenario": inputs.scenario.model_dump(mode="json", exclude={"summary"}),
        "files": [file_digest(path) for path in (inputs.network, *demand, *behind)],
        "planner": [planner, planner_digest(planner)],
        "settings": inputs.settings.model_dump(mode="json"),
        "cohesion": None if planner in WITHOUT_COHESION else cohesion,
        "code": code_digest(),
    }
    return _digest(json.dumps(about, sort_keys=True).encode())


def run_key(point: str, seed: int) -> str:
    """Key of one run: 16 hexadecimal digits."""
    return _digest(f"{point} {seed}".encode())[:16]


@lru_cache(maxsize=1)
def code_digest() -> str:
    """Digest of the code that decides results, and of the versions it stands on.

    Comments, docstrings and layout do not count.
    """
    digest = hashlib.sha256()
    for name, path in sorted(code_of_a_run().items()):
        parts = [
            (c.co_code, c.co_exceptiontable, _values(c), c.co_names, c.co_varnames)
            for c in _compiled(path)
        ]
        digest.update(f"{name} {parts}".encode())
    digest.update(json.dumps(versions(), sort_keys=True).encode())
    return digest.hexdigest()


def code_of_a_run() -> dict[str, Path]:
    """Return the modules of this package that can change a row, and their files."""
    package = Path(sumo_cohesion.__file__).parent
    found: dict[str, Path] = {}
    left = list(_WALK)
    while left:
        name = left.pop()
        path = package.joinpath(*name.split("."))
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if name in found or name in _KEEPING or not path.is_file():
            continue
        found[name] = path
        for names in (code.co_names for code in _compiled(path)):
            for module in names:
                if module.startswith("sumo_cohesion."):
                    own = module.removeprefix("sumo_cohesion.")
                    left += [own, *(f"{own}.{imported}" for imported in names)]
    return found


def _compiled(path: Path) -> list[CodeType]:
    """Compile a module and whatever is defined in it; without docstrings and assertions."""
    stat = path.stat()
    return _compiled_once(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=256)
def _compiled_once(path: Path, _changed: int, _size: int) -> list[CodeType]:
    found = [compile(path.read_bytes(), path.name, "exec", dont_inherit=True, optimize=2)]
    for code in found:
        found += [value for value in code.co_consts if isinstance(value, CodeType)]
    return found


def _values(code: CodeType) -> list[object]:
    """Return the constants of a piece of code; sets in an order of their own."""
    return [
        sorted(map(repr, value)) if isinstance(value, frozenset) else value
        for value in code.co_consts
        if not isinstance(value, CodeType)
    ]


def file_digest(path: Path) -> str:
    """Digest of a file's content; read again only if the file has changed."""
    stat = path.stat()
    return _file_digest(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=256)
def _file_digest(path: Path, _changed: int, _size: int) -> str:
    return _digest(path.read_bytes())


def planner_digest(name: str) -> str:
    """Digest of the code of a user's own planner; empty for the built-in ones.

    Of a planner in a package, the whole package; else its module, and what that imports from its
    own folder. And of the files that its arguments name.
    """
    if name in BUILT_IN:
        return ""
    planner = parse_planner(name)
    top = planner.module.partition(".")[0]
    loaded = sys.modules.get(top)
    spec = loaded.__spec__ if loaded is not None else importlib.util.find_spec(top)
    if spec is None:
        return ""
    if spec.submodule_search_locations:
        files = [
            p for folder in spec.submodule_search_locations for p in Path(folder).rglob("*.py")
        ]
    else:
        files = list(_imported(Path(spec.origin))) if spec.origin else []
    files += _files_in(planner.arguments)
    return _digest(json.dumps(sorted([path.name, file_digest(path)] for path in files)).encode())


def _files_in(value: object) -> list[Path]:
    """Return the files that a literal, or what it holds, names."""
    if isinstance(value, dict):
        return [path for inner in value.values() for path in _files_in(inner)]
    if isinstance(value, list | tuple | set):
        return [path for inner in value for path in _files_in(inner)]
    try:
        return [Path(value)] if isinstance(value, str) and Path(value).is_file() else []
    except (OSError, ValueError):  # no file can have such a name
        return []


def _imported(module: Path) -> set[Path]:
    """Return a module's file, and those beside it that it imports, directly or not."""
    found: set[Path] = set()
    left = [module] if module.is_file() else []
    while left:
        path = left.pop()
        found.add(path)
        try:
            tree = ast.parse(path.read_bytes())
        except (SyntaxError, ValueError):  # no Python source: its content counts, no more
            continue
        for node in ast.walk(tree):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.append(node.module)
            for name in names:
                here = module.parent / name.partition(".")[0]
                beside = [here.with_suffix(".py"), *here.rglob("*.py")]
                left += [p for p in beside if p.is_file() and p not in found and p not in left]
    return found


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
