"""Planners by name, and which roads they can drive along.

A built-in name, ``package.module:Class`` or ``folder/file.py:Class`` for a planner of your own,
``module:Class(gain=2.5)`` with arguments. A name imports a module, which runs that module's code,
and calls a class; nothing but a planner's class is called.
"""

from __future__ import annotations

import ast
import difflib
import importlib
import inspect
import re
import sys
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias, TypeGuard

from sumo_cohesion.errors import UserError
from sumo_cohesion.planning.cohesive import CohesivePlanner
from sumo_cohesion.planning.planners import Planner, SumoDriver
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.social.settings import CohesionSettings, as_printed

BUILT_IN = {
    "nominal": "its own reward only (beta = 0)",
    "cohesive": "its own reward and cohesion",
    "paper": "cohesion by the paper's formula as printed",
    "sumo": "SUMO's own driver model",
}

WITHOUT_COHESION = ("nominal", "sumo")
"""Built-in planners whose runs are the same whatever the cohesion settings say."""


def cohesion_of(name: str, cohesion: CohesionSettings) -> CohesionSettings:
    """Return the cohesion settings that the planner of this name really uses."""
    if name == "nominal":
        return cohesion.model_copy(update={"beta": 0.0})
    return as_printed(cohesion) if name == "paper" else cohesion


AnyPlanner: TypeAlias = "str | type[Planner] | Planner"
"""A planner's name; its class, made anew for every run; or an object, used as it is."""


def planner_name(planner: AnyPlanner) -> str:
    """Return what tables call a planner."""
    if isinstance(planner, str):
        return planner
    kind = planner if isinstance(planner, type) else type(planner)
    return f"{kind.__module__}:{kind.__qualname__}"


def make_planner(
    planner: AnyPlanner, settings: PlannerSettings, cohesion: CohesionSettings
) -> Planner:
    """Make a planner: a built-in one by name, ``module:Class(...)``, or of its class.

    An object is returned as it is: its ``reset`` has to forget the run before.

    Raises
    ------
    UserError
        If there is no such planner.
    """
    if not isinstance(planner, str):
        name = planner_name(planner)
        if not (
            _is_planner(planner) if isinstance(planner, type) else isinstance(planner, Planner)
        ):
            raise UserError(
                f"planner {name!r} needs the methods reset(road) and plan(observation, history)"
            )
        return _made(planner, {}, name) if isinstance(planner, type) else planner
    if planner == "sumo":
        return SumoDriver()
    if planner in BUILT_IN:
        return CohesivePlanner(settings, cohesion_of(planner, cohesion))
    return _load_planner(planner)


@lru_cache(maxsize=32)
def check_planner(name: str) -> None:
    """Raise UserError unless there is such a planner; a user's own is made once to see."""
    if name not in BUILT_IN:
        _load_planner(name)


class OwnPlanner(NamedTuple):
    """A user's own planner: its module, its class, and the keyword arguments to make it with.

    ``file`` is that of the module, if the name says so.
    """

    module: str
    name: str
    arguments: dict[str, Any]
    file: Path | None = None


def parse_planner(name: str) -> OwnPlanner:
    """Take the name of a user's own planner apart.

    >>> parse_planner("my.module:Follow(gain=2.5, file='weights.txt')").arguments
    {'gain': 2.5, 'file': 'weights.txt'}

    Raises
    ------
    UserError
        If it is not of this form; arguments are Python literals by name.
    """
    found = re.fullmatch(r"([^:()\0]+\.py|[\w.]+):(\w+)(\(.*\))?", name)
    if found is None:
        raise UserError(f"unknown planner {name!r}{_meant(name)}")
    module, class_name, arguments = found.groups()
    try:
        call = ast.parse(f"f{arguments or '()'}", mode="eval").body
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)) or call.args:
            raise ValueError
        given = {k.arg: ast.literal_eval(k.value) for k in call.keywords if k.arg}
        if len(given) < len(call.keywords):
            raise ValueError
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError):
        raise UserError(
            f"planner {name!r}: write its arguments by name and as Python literals, e.g. "
            f"{module}:{class_name}(gain=2.5, file='weights.txt')"
        ) from None
    file = Path(module).resolve() if module.endswith(".py") else None
    return OwnPlanner(file.stem if file else module, class_name, given, file)


def _meant(name: str) -> str:
    """Suggest planners for a name that is none."""
    words = re.split(r"[\s;,]+", name)
    if len(words) > 1 and all(word in BUILT_IN or ":" in word for word in words):
        return "; that is several: compare and batch take several, separated by commas"
    if close := difflib.get_close_matches(name, BUILT_IN, 1):
        return f"; did you mean {close[0]!r}?"
    file = Path(name if name.endswith(".py") else f"{name}.py")
    if classes := _planners_in(file):
        return f"; did you mean {name}:{classes[0]}?"
    return (
        f"; choose {', '.join(BUILT_IN)} or your own as module:Class, file.py:Class, or "
        "module:Class(gain=2.5)"
    )


def _planners_in(file: Path) -> list[str]:
    """Names of the classes in a file that have a planner's methods; nothing of it is run."""
    try:
        tree = ast.parse(file.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return []
    return [
        node.name
        for node in tree.body
        if isinstance(node, ast.ClassDef)
        and {"reset", "plan"} <= {d.name for d in node.body if isinstance(d, ast.FunctionDef)}
    ]


def _load_planner(name: str) -> Planner:
    module_name, class_name, arguments, file = parse_planner(name)
    if file is not None and not file.is_file():
        raise UserError(f"planner {name!r}: there is no file {file}")
    # A user's module usually lies in the folder they work in. It comes last: what else lies there
    # may have any name, that of a module of the standard library, too.
    here = str(file.parent if file is not None else Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:
        said = str(error) if isinstance(error, ImportError) else f"{type(error).__name__}: {error}"
        raise UserError(f"planner {name!r}: cannot import {module_name!r} ({said})") from error
    found = getattr(module, "__file__", None)
    if file is not None and (found is None or Path(found).resolve() != file):
        raise UserError(
            f"planner {name!r}: another module is called {module_name!r}; rename {file.name}"
        )
    kind = getattr(module, class_name, None)
    # Looked at before it is called: a name comes from a file, and may name anything.
    if not _is_planner(kind):
        raise UserError(f"planner {name!r}: {_not_a_planner(module, class_name)}")
    return _made(kind, arguments, name)


def _made(kind: type[Planner], arguments: dict[str, Any], name: str) -> Planner:
    try:
        return kind(**arguments)
    except (Exception, SystemExit) as error:
        said = f"{type(error).__name__}: {error}"
        raise UserError(
            f"planner {name!r}: the class cannot be called with these arguments ({said})"
        ) from error


def _is_planner(kind: object) -> TypeGuard[type[Planner]]:
    return inspect.isclass(kind) and all(
        callable(getattr(kind, method, None)) for method in ("reset", "plan")
    )


def _not_a_planner(module: ModuleType, name: str) -> str:
    if hasattr(module, name):
        return (
            f"{name!r} is no class that can drive; it needs the methods reset(road) and "
            "plan(observation, history)"
        )
    own = [n for n, kind in vars(module).items() if _is_planner(kind) and _lives_in(kind, module)]
    close = difflib.get_close_matches(name, own, 1) or own[:1]
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"{module.__name__!r} has no {name!r}{hint}"


def _lives_in(kind: type, module: ModuleType) -> bool:
    return kind.__module__ == module.__name__
