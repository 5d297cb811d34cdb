"""Runs and batches as demonstrations: their tables, the road they drove along, their settings."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from sumo_cohesion.batches.experiment import stored_points
from sumo_cohesion.batches.results import run_folders
from sumo_cohesion.batches.store import (
    DONE,
    as_cell,
    is_batch,
    joined,
    manifest,
    read_parquet,
    table_file,
    wanted,
)
from sumo_cohesion.demonstrations.plans import plans
from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.example import Example
from sumo_cohesion.learning.recording import COLUMNS, Recording
from sumo_cohesion.learning.source import Kind, Source
from sumo_cohesion.learning.tracks import Cutting, cut
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.setup import prepare, road_of
from sumo_cohesion.state import EGO, STEP
from sumo_cohesion.tables.damaged import tables_of
from sumo_cohesion.tables.rollout import RUN_FILE
from sumo_cohesion.user_input import validated

_SAME_PLACE = 0.01
"""Metres within which a place must be where the run recorded it, if the network is the same."""
_STATE = ("time", "s", "d", "road_heading", "speed")
_FINITE = {
    "trajectory": (*_STATE, "x", "y", "heading", "length", "width"),
    "plan": ("time",),
    "horizon": _STATE,
}
"""Columns of a table that are numbers in every row."""
_ALSO = {
    "trajectory": ("vehicle", "visible", "planned"),
    "plan": ("curvature", "acceleration", "fallback", "intervened"),
    "horizon": (),
}
"""Other columns that are read."""


@dataclass(frozen=True)
class Run:
    """One run's tables; they are read when they are asked for.

    ``special`` vehicles do not drive as humans do: those that the scenario hides or calls special.
    ``sensing_range`` (m) is how far its planner saw; ``place`` is where its tables are, which no
    other run's are.
    """

    name: str
    place: Path
    road: Road
    settings: PlannerSettings
    planner: str
    special: frozenset[str]
    sensing_range: float
    table: Callable[[str], pd.DataFrame]

    def source(self, kind: Kind) -> Source:
        """Return the driving that is asked for."""
        return DrivingOf(self, kind)

    def read(self, name: str) -> pd.DataFrame:
        """Return one of the run's tables, if it is sound."""
        table = self.table(name)
        missing = [c for c in (*_FINITE[name], *_ALSO[name]) if c not in table]
        if missing:
            raise UserError(f"{self.name}: its table {name} has no {missing[0]!r}; run it again")
        for column in _FINITE[name]:
            numbers = pd.to_numeric(table[column], errors="coerce").to_numpy(float)
            if not np.isfinite(numbers).all():
                row = int(np.isfinite(numbers).argmin()) + 1
                raise UserError(
                    f"{self.name}: its table {name} is damaged ({column} in row {row} is no "
                    "number); run it again"
                )
        return table

    def trajectory(self) -> pd.DataFrame:
        """Return the run's trajectories, if they are those of this road."""
        table = self.read("trajectory")
        some = table.iloc[:: max(len(table) // 50, 1)]
        frenet, _ = self.road.to_frenet(some[["x", "y", "heading", "speed"]].to_numpy(float))
        off = np.abs(frenet[:, :2] - some[["s", "d"]].to_numpy(float)).max(initial=0.0)
        if not off < _SAME_PLACE:
            raise UserError(
                f"{self.name}: its network has changed since it was run: places differ by "
                f"{off:.2g} m; run it again"
            )
        return table


@dataclass(frozen=True)
class DrivingOf:
    """A run that demonstrates: by its plans, by what its ego drove, or by the humans around it."""

    run: Run
    kind: Kind

    @property
    def name(self) -> str:
        """Of the run."""
        return self.run.name

    def examples(self, how: Cutting) -> Sequence[Example]:
        """Take every plan that is half its own length after the one before, or cut the tracks."""
        with tables_of(self.run.place):
            return self._plans(how) if self.kind == "plans" else self._tracks(how)

    def _plans(self, how: Cutting) -> Sequence[Example]:
        run, steps = self.run, self.run.settings.horizon
        plan, horizon = run.read("plan"), run.read("horizon")
        if not len(horizon):
            raise UserError(
                f"{run.name}: planner {run.planner} left no plans, only controls; learn from what "
                "it drove: --from driven"
            )
        if steps != how.steps:
            raise UserError(
                f"{run.name}: its plans are {steps} steps long; plans cannot be cut to "
                f"--steps {how.steps}, learn from what was driven: --from driven"
            )
        trajectory = run.trajectory()
        if not plan["time"].isin(trajectory.loc[trajectory["vehicle"] == EGO, "time"]).all():
            raise UserError(f"{run.name}: its tables are of different runs; run it again")
        return plans(run.name, run.road, trajectory, plan, horizon, steps)

    def _tracks(self, how: Cutting) -> Sequence[Example]:
        trajectory = self.run.trajectory()
        if self.kind == "driven":
            vehicles, trajectory = {EGO}, trajectory[trajectory["visible"]]
        else:
            planned = set(trajectory.loc[trajectory["planned"], "vehicle"])
            vehicles = set(trajectory["vehicle"]) - planned - self.run.special
            if self.run.planner != "sumo":
                vehicles -= {EGO}
        ordered = trajectory.sort_values(["vehicle", "time"], kind="stable")
        table = ordered[list(COLUMNS)].reset_index(drop=True)
        roads = dict.fromkeys(sorted(vehicles), self.run.road)
        recording = Recording(self.run.name, table, roads, STEP)
        return cut(recording, replace(how, sensing_range=self.run.sensing_range))


def runs_in(folder: Path) -> list[Run]:
    """All runs in the folder of a run, a comparison or a batch, or below it.

    Raises
    ------
    UserError
        If there are none, or one of them is not whole.
    """
    with tables_of(folder):
        if is_batch(folder):
            return _of_batch(folder)
        return [_of_folder(path, folder) for path in run_folders(folder)]


def _of_folder(path: Path, root: Path) -> Run:
    try:
        info = json.loads((path / RUN_FILE).read_text(encoding="utf-8"))
        network, route = Path(info["network"]), info["route"]
        planner, settings = info["planner"], info["settings"]
        special = frozenset([*info["hidden"], *info["special"]])
        seen = float(info["scenario"]["sensing"]["range"])
        settings = validated(PlannerSettings, settings, f"{path / RUN_FILE}: settings")
        name = f"{root.name}/{path.relative_to(root).as_posix()}" if path != root else root.name
        road = road_of(network, route)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path}: not a run that can be learned from ({type(error).__name__}: {error}); run "
            f"it again"
        ) from None
    return Run(
        name,
        path,
        road,
        settings,
        planner,
        special,
        seen,
        lambda t: _parquet(path / f"{t}.parquet"),
    )


def _parquet(path: Path) -> pd.DataFrame:
    if not path.is_file():
        raise UserError(f"{path}: is missing; run it again")
    return read_parquet(path)


def _of_batch(folder: Path) -> list[Run]:
    about, plan = manifest(folder), wanted(folder)
    if not {"folder", "files"} <= set(about):
        raise UserError(f"{folder}: does not say where its scenarios are; run the batch again")
    points, seeds = stored_points(about)
    results = joined(folder)
    done = set(results.loc[results["status"] == DONE, "run"])
    found: dict[str, Run] = {}
    # The plan lists every point's seeds, point by point; points that come to the same share runs.
    for i, point in enumerate(points):
        setup = prepare(point.request(seeds[0]))
        rows = plan.iloc[i * len(seeds) : (i + 1) * len(seeds)]
        for run, seed in zip(rows["run"], rows["seed"], strict=True):
            if run in found or run not in done:
                continue
            cells = [f"{key}={as_cell(value)}" for key, value in point.grid.items()]
            parts = [folder.name, setup.scenario.name, point.planner, *cells, str(seed)]
            found[run] = Run(
                "/".join(parts),
                folder / run,
                setup.road,
                setup.settings,
                point.planner,
                frozenset(setup.not_human),
                setup.scenario.sensing.range,
                _kept(folder, run),
            )
    if not found:
        raise UserError(f"{folder}: no run of the batch was done; run it first")
    return list(found.values())


def _kept(folder: Path, run: str) -> Callable[[str], pd.DataFrame]:
    def table(name: str) -> pd.DataFrame:
        path = table_file(folder, name, run)
        if not path.is_file():
            raise UserError(
                f"{folder}: kept no table {name!r} of run {run}; an experiment keeps what is "
                'learned from with keep = ["trajectory", "plan", "horizon"]'
            )
        return read_parquet(path)

    return table
