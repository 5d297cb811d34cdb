"""Settings by dotted name, as users give them: whose each is, and whether it makes sense."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from sumo_cohesion.errors import UserError
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.simulation.scenario import Scenario
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.user_input import merge, validated


def settings_from(
    overrides: Mapping[str, Any],
) -> tuple[PlannerSettings, CohesionSettings, dict[str, Any]]:
    """Split dotted overrides into planner settings, cohesion settings and scenario overrides."""
    parts: dict[str, dict[str, Any]] = {"planner": {}, "cohesion": {}, "": {}}
    for name, value in overrides.items():
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
