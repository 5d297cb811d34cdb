"""A solver that goes wrong in one step of ten, in closed loop with SUMO's traffic."""

from __future__ import annotations

from random import Random

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion import Rollout, run
from sumo_cohesion.planning.problem import Instance, Solution
from sumo_cohesion.planning.solvers import mpc
from sumo_cohesion.state import RESCUED, FloatArray
from sumo_cohesion.traffic.simulator import Simulator

pytestmark = pytest.mark.slow

KINDS = ("raises", "times out", "not a number", "infinite", "out of bounds", "noise")
SCENARIOS = ("stalled_swerve", "speeding", "nothing_to_follow", "ambulance")


class OftenFaulty:
    """A solver that does wrong in a tenth of its calls, and counts how often."""

    how = "faulty"

    def __init__(self, solver: mpc.Solver, rng: Random, count: list[str]) -> None:
        self.name, self._solver, self._rng, self._count = solver.name, solver, rng, count

    def solve(self, instance: Instance, guess: FloatArray) -> Solution:
        if self._rng.random() >= 0.1:
            return self._solver.solve(instance, guess)
        kind = self._rng.choice(KINDS)
        self._count.append(kind)
        if kind == "raises":
            raise ValueError("matrix is singular")
        good = self._solver.solve(instance, guess)
        states, controls = good.states.copy(), good.controls.copy()
        if kind == "not a number":
            controls[:] = np.nan
        elif kind == "infinite":
            states[:] = np.inf
        elif kind == "out of bounds":
            controls[0] = 1.0, -200.0
        elif kind == "noise":
            random = np.random.default_rng(self._rng.randrange(2**32))
            controls = random.uniform((-0.01, -8.0), (0.01, 4.0), controls.shape)
        return Solution(states, controls, kind != "times out", kind, 7, 0.0, {})


@pytest.fixture
def moved(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, ...]]:
    """Everything that is sent to SUMO as a state; Simulator.step refuses what is no number."""
    sent: list[tuple[float, ...]] = []
    step = Simulator.step

    def record(self: Simulator, ego, others) -> None:  # type: ignore[no-untyped-def]
        sent.extend(tuple(state) for state in (ego, *others.values()) if state is not None)
        step(self, ego, others)

    monkeypatch.setattr(Simulator, "step", record)
    return sent


def run_with_faults(
    monkeypatch: pytest.MonkeyPatch,
    scenario: str,
    planner: str,
    *,
    rescue: bool,
    penetration: float = 0.0,
) -> tuple[Rollout, list[str]]:
    """Drive with solvers that fail; without rescue IPOPT fails whenever it is asked."""
    count: list[str] = []
    real, rng = mpc.shared_solver, Random(4)

    def faulty(name: str, *about: object) -> mpc.Solver:
        if name == "ipopt" and rescue:
            return real(name, *about)  # type: ignore[arg-type]
        if name == "ipopt":
            return Broken()
        return OftenFaulty(real(name, *about), rng, count)  # type: ignore[arg-type]

    monkeypatch.setattr(mpc, "shared_solver", faulty)
    overrides = {"reference": False, "success": {}, "fleet.penetration": penetration}
    rollout = run(scenario, planner, 1003, overrides=overrides)
    return rollout, count


class Broken:
    """A solver that never works."""

    name, how = "ipopt", "broken"

    def solve(self, instance: Instance, guess: FloatArray) -> Solution:
        raise RuntimeError("nothing works")


@pytest.mark.parametrize("rescue", [True, False])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_fault_is_counted_and_none_causes_a_collision(
    scenario: str,
    rescue: bool,
    moved: list[tuple[float, ...]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rollout, count = run_with_faults(monkeypatch, scenario, "cohesive", rescue=rescue)
    row, plan = rollout.metrics.iloc[0], rollout.plan
    assert len(plan) > 100
    assert len(count) > 10
    assert np.isfinite(np.array(moved)).all()
    assert np.isfinite(rollout.trajectory.select_dtypes("number")).all().all()
    counted = "plan_rescues" if rescue else "plan_failures"
    assert row[counted] >= len(count)
    noticed = plan["status"].str.startswith(RESCUED) if rescue else plan["fallback"]
    assert int(noticed.sum()) == row[counted]
    assert row["outcome"] in ("finished", "route_end")
    assert not row["collision"]  # nominal hits the stalled car, and nothing else


def test_the_nominal_planner_is_as_sturdy(
    moved: list[tuple[float, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    rollout, count = run_with_faults(monkeypatch, "speeding", "nominal", rescue=False)
    assert rollout.metrics["plan_failures"].iloc[0] >= len(count) > 10
    assert not rollout.metrics["collision"].iloc[0]
    speeds = pd.Series([state[3] for state in moved])
    assert speeds.between(0.0, 40.0).all()


def test_a_fleet_is_as_sturdy(
    moved: list[tuple[float, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    rollout, count = run_with_faults(
        monkeypatch, "nothing_to_follow", "cohesive", rescue=False, penetration=1.0
    )
    row = rollout.metrics.iloc[0]
    assert row["plan_failures"] + row["fleet_failures"] >= len(count) > 50
    assert len(moved) > 2 * len(rollout.plan)
    assert np.isfinite(np.array(moved)).all()
    assert not row["collision"]
    assert row["fleet_collisions"] == 0
