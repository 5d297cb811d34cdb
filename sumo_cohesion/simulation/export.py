"""Write a scenario so that plain SUMO opens it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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

    Returns the path of the .sumocfg: ``sumo -c`` or ``sumo-gui -c`` opens it.

    Raises
    ------
    UserError
        If the scenario is wrong or the folder holds something else.
    """
    target = Path(folder)
    require_replaceable(target)
    setup = prepare(RunRequest(scenario, "sumo", seed, overrides or {}))
    with whole_folder(target) as new:
        setup.write_inputs(new).write_config(new / CONFIG_FILE)
        for path in (setup.network, *setup.additional):
            shutil.copyfile(path, new / path.name)
    return target / CONFIG_FILE
