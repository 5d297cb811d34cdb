"""Settings by dotted name, as users give them: whose each is, and whether it makes sense."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from sumo_cohesion.errors import UserError
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.simulation.scenario import Scenario
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.user_input import merge, read_toml, validated

_FILE = "@"
"""Before the name of a file that has the value."""


class _Groups(BaseModel):
    """Settings that a file may have values of, as they stand in it."""

    model_config = ConfigDict(extra="forbid")

    planner: PlannerSettings = PlannerSettings()
    cohesion: CohesionSettings = CohesionSettings()


def read_files(overrides: Mapping[str, Any], folder: Path = Path()) -> dict[str, Any]:
    """Put what files say into dotted overrides, of the planner's and cohesion's settings.

    ``@FILE`` stands for what that TOML file has under the setting's own dotted name. Relative
    names are those of files in ``folder``. Other settings' texts may begin with @.

    Raises
    ------
    UserError
        If a file cannot be read, has no such name, or its value makes no sense.
    """
    return {
        name: _read(name, value, folder) if _group(name) in _Groups.model_fields else value
        for name, value in overrides.items()
    }


def _group(name: str) -> str:
    return name.partition(".")[0]


def _read(name: str, value: Any, folder: Path) -> Any:
    if isinstance(value, Mapping):
        return {key: _read(f"{name}.{key}", inner, folder) for key, inner in value.items()}
    if not isinstance(value, str) or not value.startswith(_FILE):
        return value
    if value == _FILE:
        raise UserError(f"{name}={value}: name a TOML file, e.g. {name}={_FILE}theta.toml")
    path = folder / value.removeprefix(_FILE)
    found: Any = (data := read_toml(path))
    for key in name.split("."):
        if not isinstance(found, Mapping) or key not in found:
            raise UserError(f"{path}: has no {name}; it has {', '.join(_names(data)) or 'nothing'}")
        found = found[key]
    validated(_Groups, merge({}, {name: found}), str(path))
    return found


def _names(data: Mapping[str, Any], group: str = "") -> Iterator[str]:
    """Dotted names of what a file has: its tables, or values that stand beside tables."""
    for key, value in data.items():
        inner = value.values() if isinstance(value, Mapping) else ()
        if any(isinstance(one, Mapping) for one in inner):
            yield from _names(value, f"{group}{key}.")
        else:
            yield group + key


def settings_from(
    overrides: Mapping[str, Any],
) -> tuple[PlannerSettings, CohesionSettings, dict[str, Any]]:
    """Split dotted overrides into planner settings, cohesion settings and scenario overrides.

    Files are read (`read_files`). Whatever their order, planner.reward.speed says more than
    planner.reward.
    """
    parts: dict[str, dict[str, Any]] = {"planner": {}, "cohesion": {}, "": {}}
    for name, value in sorted(read_files(overrides).items(), key=lambda item: item[0].count(".")):
        head, _, tail = name.partition(".")
        if tail and head and head in parts:
            parts[head][tail] = value
        elif head in Scenario.model_fields:
            parts[""][name] = value
        else:
            raise UserError(f"unknown setting {name!r}{_meant(name)}")
    planner = validated(PlannerSettings, merge({}, parts["planner"]), "planner settings")
    cohesion = validated(CohesionSettings, merge({}, parts["cohesion"]), "cohesion settings")
    return planner, cohesion, parts[""]


def _meant(name: str) -> str:
    """Suggest settings that are spelt like an unknown one, or all there is to set."""
    groups = {"planner": PlannerSettings.model_fields, "cohesion": CohesionSettings.model_fields}
    head, dot, tail = name.partition(".")
    if head in groups:
        return (
            f"; it is a group: set one of {', '.join(f'{head}.{key}' for key in groups[head])}; "
            "which planner drives is said by --planner, --planners or an experiment's planners"
        )
    same = [f"{group}.{name}" for group, fields in groups.items() if name in fields]
    close = difflib.get_close_matches(head, [*groups, *Scenario.model_fields], 1)
    meant = same or [close[0] + dot + tail] if same or close else []
    if meant:
        return f"; did you mean {meant[0]!r}?"
    known = ", ".join(Scenario.model_fields)
    return f"; settings are planner.*, cohesion.*, and of the scenario {known}"
