"""Planners by name, and which roads they can drive along.

A built-in name, ``package.module:Class`` for a planner of your own, or
``package.module:Class(gain=2.5)`` with arguments.
"""

from __future__ import annotations

import ast
import importlib
import re
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

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
        return _checked(_made(planner, {}, name) if isinstance(planner, type) else planner, name)
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
    """A user's own planner: its module, its class, and the keyword arguments to make it with."""

    module: str
    name: str
    arguments: dict[str, Any]


def parse_planner(name: str) -> OwnPlanner:
    """Take the name of a user's own planner apart.

    >>> parse_planner("my.module:Follow(gain=2.5, file='weights.txt')").arguments
    {'gain': 2.5, 'file': 'weights.txt'}

    Raises
    ------
    UserError
        If it is not of this form; arguments are Python literals by name.
    """
    found = re.fullmatch(r"([\w.]+):(\w+)(\(.*\))?", name)
    if found is None:
        raise UserError(
            f"unknown planner {name!r}; choose {', '.join(BUILT_IN)} or your own as module:Class, "
            "or module:Class(gain=2.5)"
        )
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
    return OwnPlanner(module, class_name, given)


def _load_planner(name: str) -> Planner:
    module_name, class_name, arguments = parse_planner(name)
    # A user's module usually lies in the folder they work in. It comes last: what else lies there
    # may have any name, that of a module of the standard library, too.
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:
        said = str(error) if isinstance(error, ImportError) else f"{type(error).__name__}: {error}"
        raise UserError(f"planner {name!r}: cannot import {module_name!r} ({said})") from None
    if not hasattr(module, class_name):
        raise UserError(f"planner {name!r}: {module_name!r} has no {class_name!r}")
    return _checked(_made(getattr(module, class_name), arguments, name), name)


def _made(kind: Any, arguments: dict[str, Any], name: str) -> object:
    try:
        return kind(**arguments)
    except (Exception, SystemExit) as error:
        said = f"{type(error).__name__}: {error}"
        raise UserError(
            f"planner {name!r}: the class cannot be called with these arguments ({said})"
        ) from None


def _checked(planner: object, name: str) -> Planner:
    if not isinstance(planner, Planner):
        raise UserError(
            f"planner {name!r} needs the methods reset(road) and plan(observation, history)"
        )
    return planner
