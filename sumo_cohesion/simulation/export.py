"""Write a scenario so that plain SUMO opens it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sumo_cohesion.errors import UserError
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.tables.folders import require_replaceable, whole_folder

CONFIG_FILE = "scenario.sumocfg"


def export_scenario(
    scenario: str | Path,
    folder: str | Path,
    *,
    seed: int = 0,
    overrides: Mapping[str, Any] | None = None,
) -> Path:
    """Write network, this seed's demand and a .sumocfg; SUMO drives the ego there.

    All files that these name are copied, too. What additional files write will be beside them.

    Returns the path of the .sumocfg: ``sumo -c`` or ``sumo-gui -c`` opens it.

    Raises
    ------
    UserError
        If the scenario is wrong or the folder holds something else.
    """
    target = Path(folder)
    if "," in str(target.absolute()):
        raise UserError(f"{target}: SUMO splits names of files at commas; choose another --out")
    require_replaceable(target)
    setup = prepare(RunRequest(scenario, "sumo", seed, overrides or {}))
    with whole_folder(target) as new:
        setup.write_inputs(new, portable=True).write_config(new / CONFIG_FILE)
    return target / CONFIG_FILE
