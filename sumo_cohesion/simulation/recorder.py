"""Collects the steps of a run and turns them into its tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sumo_cohesion.errors import SimulationError
from sumo_cohesion.planning.explanation import Explanation
from sumo_cohesion.planning.planners import planned_states
from sumo_cohesion.simulation.episode import Ending, Moment, Seconds
from sumo_cohesion.social.features import FEATURES, LATERAL
from sumo_cohesion.state import (
    EGO,
    LANE_WIDTH,
    AgreementRow,
    BoolArray,
    Control,
    FloatArray,
    Plan,
    RoadState,
    Scene,
)
from sumo_cohesion.tables.columns import as_table
from sumo_cohesion.tables.metrics import run_metrics
from sumo_cohesion.tables.rollout import Rollout
from sumo_cohesion.versions import versions

if TYPE_CHECKING:
    from sumo_cohesion.simulation.setup import Setup

_NO_CONTROL = Control(float("nan"), float("nan"))


class Recorder:
    """Listens to a run and makes its tables.

    ``reference`` are the rows that a twin notes meanwhile (simulation.twin).
    """

    def __init__(self, setup: Setup, reference: Sequence[dict[str, object]] = ()) -> None:
        self._setup = setup
        self._road = setup.road
        self._reference = reference
        self._begin()

    def _begin(self) -> None:
        self._scenes: list[Scene] = []
        self._visible: list[frozenset[str]] = []
        self._planned: list[frozenset[str]] = []
        self._plans: list[tuple[float, RoadState, Plan]] = []
        self._horizons: list[FloatArray] = []
        self._seconds: list[Seconds] = []
        self._ending: Ending | None = None

    @property
    def heard(self) -> bool:
        """Tell whether there is anything to make tables of."""
        return bool(self._plans) and self._ending is not None

    def on_step(self, moment: Moment) -> None:
        """Record one step; the first after an end begins another record."""
        if self._ending is not None:
            self._begin()
        plan, others = moment.plan, moment.planned
        self._scenes.append(self._recorded(moment.scene))
        self._visible.append(frozenset(moment.observation.ids))
        self._planned.append(others | {EGO} if plan.controls else others)
        self._plans.append((moment.scene.time, moment.observation.ego, plan))
        self._horizons.append(planned_states(plan))
        self._seconds.append(moment.seconds)

    def on_end(self, ending: Ending) -> None:
        """Record how it ended."""
        self._ending = ending
        if self._plans:
            self._scenes.append(self._recorded(ending.scene))
            self._visible.append(self._visible[-1])
            self._planned.append(self._planned[-1])

    def rollout(self) -> Rollout:
        """Make the tables of a run that has ended."""
        setup, ending = self._setup, self._ending
        if not self.heard or ending is None:
            raise SimulationError("nothing was recorded: the run has not ended, or had no step")
        trajectory = self._trajectory(ending.scene.ego_size)
        reference = as_table("reference", list(self._reference))
        plan, agreement, timing = self._plan_table(), self._agreement_table(), self._timing_table()
        info = {
            "scenario": setup.scenario.model_dump(mode="json"),
            "planner": setup.planner_name,
            "settings": setup.settings.model_dump(mode="json"),
            "cohesion": setup.cohesion.model_dump(mode="json"),
            "seed": setup.seed,
            "outcome": ending.outcome,
            "touched": list(ending.touched),
            "touched_by_sumo": list(ending.touched_by_sumo),
            "events": {str(number): time for number, time in ending.triggered.items()},
            "fleet": ending.fleet,
            "hidden": list(setup.scenario.sensing.hidden),
            "special": list(setup.scenario.sensing.special),
            "features": {**dict(zip(FEATURES, LATERAL, strict=True)), "place": True},
            "solver": str(self._plans[0][2].solver),
            "network": str(setup.network),
            "route": list(setup.route),
            "n_route_lanes": setup.road.n_route_lanes,
            "traffic_lights": list(setup.traffic_lights),
            "notes": list(setup.notes),
            "versions": versions(),
        }
        row = run_metrics(info, trajectory, plan, agreement, timing, reference)
        horizon = self._horizon_table()
        metrics = as_table("metrics", [row])
        return Rollout(info, trajectory, plan, horizon, agreement, timing, reference, metrics)

    def _recorded(self, scene: Scene) -> Scene:
        """Keep what is recorded: as far around the ego with a fleet as without."""
        if not self._setup.penetration:
            return scene
        offset = scene.states[:, :2] - scene.ego[:2]
        near = np.hypot(offset[:, 0], offset[:, 1]) <= self._setup.recorded_radius
        ids = tuple([name for name, is_near in zip(scene.ids, near, strict=True) if is_near])
        return replace(scene, ids=ids, states=scene.states[near], sizes=scene.sizes[near])

    def _trajectory(self, ego_size: tuple[float, float]) -> pd.DataFrame:
        counts = np.array([len(scene.ids) for scene in self._scenes])
        others = np.concatenate([scene.states for scene in self._scenes])
        sizes = np.concatenate([scene.sizes for scene in self._scenes])
        egos = np.array([scene.ego for scene in self._scenes])
        states = np.concatenate((egos, others))
        frenet, _ = self._road.to_frenet(states)
        times = np.array([scene.time for scene in self._scenes])
        step = np.arange(len(self._scenes))
        names = [name for scene in self._scenes for name in scene.ids]
        visible, planned = (self._is_among(sets) for sets in (self._visible, self._planned))
        columns = {
            "time": np.concatenate((times, np.repeat(times, counts))),
            "vehicle": [EGO] * len(egos) + names,
            "visible": [True] * len(egos) + visible,
            "planned": [EGO in names for names in self._planned] + planned,
            "x": states[:, 0],
            "y": states[:, 1],
            "heading": states[:, 2],
            "speed": states[:, 3],
            "s": frenet[:, 0],
            "d": frenet[:, 1],
            "road_heading": frenet[:, 2],
            "lane": self._road.lane_index(frenet[:, 0], frenet[:, 1]),
            "length": np.concatenate((np.full(len(egos), ego_size[0]), sizes[:, 0])),
            "width": np.concatenate((np.full(len(egos), ego_size[1]), sizes[:, 1])),
        }
        order = np.argsort(np.concatenate((step, np.repeat(step, counts))), kind="stable")
        return as_table("trajectory", dict(columns)).iloc[order].reset_index(drop=True)

    def _is_among(self, sets: list[frozenset[str]]) -> list[bool]:
        """Of every other vehicle of every scene, whether it is in that scene's set."""
        return [
            n in among for scene, among in zip(self._scenes, sets, strict=True) for n in scene.ids
        ]

    def _plan_table(self) -> pd.DataFrame:
        ego = np.array([state for _, state, _ in self._plans])
        right, left = self._road.drivable_at(ego[:, 0], ego[:, 1])
        limit = self._road.speed_limit_at(ego[:, 0])
        on_exit = self._on_exit(ego)
        parts = self._setup.settings.reward.parts
        rows, no_reward = [], {f"reward_{name}": float("nan") for name in parts}
        for i, (time, _, plan) in enumerate(self._plans):
            control = plan.controls[0] if plan.controls else _NO_CONTROL
            row: dict[str, object] = {
                **no_reward,
                "time": time,
                "status": str(plan.status),
                "fallback": bool(plan.fallback),
                "intervened": bool(plan.intervened),
                "iterations": int(np.nan_to_num(as_number(plan.iterations))),
                "curvature": control.curvature,
                "acceleration": control.acceleration,
                "road_right": right[i],
                "road_left": left[i],
                "on_exit": on_exit[i],
                "speed_limit": limit[i],
            }
            row |= {f"reward_{name}": as_number(value) for name, value in plan.reward.items()}
            rows.append(row)
        return as_table("plan", rows)

    def _horizon_table(self) -> pd.DataFrame:
        """Where every plan led."""
        told = [
            (time, states) for (time, _, _), states in zip(self._plans, self._horizons, strict=True)
        ]
        counts = [len(states) for _, states in told]
        states = np.concatenate([np.empty((0, 4)), *[states for _, states in told]])
        columns: dict[str, object] = {
            "time": np.repeat([time for time, _ in told], counts),
            "stage": np.concatenate([np.empty(0), *[1 + np.arange(n) for n in counts]]),
            **dict(zip(("s", "d", "road_heading", "speed"), states.T, strict=True)),
        }
        return as_table("horizon", columns)

    def _on_exit(self, ego: FloatArray) -> BoolArray:
        """Tell when the ego, (n, 4) road states, is on an exit that has parted from its route.

        By geometry: SUMO's lane id stays that of the route for a while after the gore.
        """
        nearest = self._road.lane_index(ego[:, 0], ego[:, 1])
        lanes = self._road.lanes_at(ego[:, 0])[:, : self._road.n_route_lanes]
        away = np.nanmin(np.abs(lanes - ego[:, 1:2]), axis=1)
        return np.asarray((nearest >= self._road.n_route_lanes) & (away > LANE_WIDTH))

    def _agreement_table(self) -> pd.DataFrame:
        cohesion = self._setup.cohesion
        floor, least = cohesion.variance_floor, cohesion.min_cars
        columns: dict[str, list[Any]] = {name: [] for name in ("time", *AgreementRow._fields)}
        for time, _, plan in self._plans:
            rows = plan.agreement
            if not rows:
                continue
            found = rows.columns() if isinstance(rows, Explanation) else zip(*rows, strict=True)
            for column, values in zip(columns.values(), ([time] * len(rows), *found), strict=True):
                column.extend(values)
        table = as_table("agreement", dict(columns))
        precision = 1.0 / (table["variance"] + floor)
        return table.assign(precision=precision.where(table["n"] >= least))

    def _timing_table(self) -> pd.DataFrame:
        milliseconds = 1e3 * np.array(self._seconds).reshape(-1, len(Seconds._fields))
        return as_table(
            "timing",
            {
                "time": [time for time, _, _ in self._plans],
                "perception_ms": milliseconds[:, 0],
                "social_ms": [1e3 * as_number(plan.social_time) for _, _, plan in self._plans],
                "solver_ms": [1e3 * as_number(plan.wall_time) for _, _, plan in self._plans],
                "plan_ms": milliseconds[:, 1],
                "fleet_ms": milliseconds[:, 2],
                "sumo_ms": milliseconds[:, 3],
            },
        )


def as_number(value: object) -> float:
    """Return what a user's planner says of itself as a number; NaN if it is none."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return float("nan")
