"""The planner beside what a user would build instead, on the same instances, in one run.

    pip install -e '.[benchmark]'
    python -m benchmarks.planner [--horizons 10,40] [--instances 100]

The instances are recorded from SUMO scenarios (seeds >= 1000) driven by the cohesive planner. Every
method solves each of them, one after the other and in turns, cold (from holding speed and lane) and
warm (from its own last solution, shifted), three times, of which the median counts. Times are CPU
time of the process, medians and 99th percentiles, with everything a method needs per call: its
parameters set, its result read. ``first_ms`` is the median of the first of the three calls, when
the other methods have had the caches. The gap counts instances whose reward is more than 1 % (of
what there was to gain) below the best known. The floor is one evaluation of the objective and one
pass of its derivatives, the least that any method needs, timed after each of our solves.
"""

from __future__ import annotations

import os

# CPU time is measured: L-BFGS would be charged for threads that wait for each other.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import contextlib
import io
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd

from sumo_cohesion.planning.problem import Instance, Problem, Solution
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers.mpc import Mpc, shared_solver, shifted
from sumo_cohesion.planning.solvers.nlp import roll_out
from sumo_cohesion.planning.solvers.transcription import Transcription
from sumo_cohesion.planning.stage import (
    CONTROL_SCALE,
    N_STATES,
    StageParameters,
    limited_stage,
    make_stage,
    rate_excess,
)
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.run import simulate
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.versions import versions

OURS = "ours, compiled"
REPEATS = 3
HERE = Path(__file__).resolve().parent
RECORDED = (("stalled_swerve", 1000), ("stalled_dense", 1001), ("ambulance", 1002))


def record(horizon: int, n: int) -> list[Problem]:
    """Problems met in closed loop: stretches of consecutive steps of several scenarios."""
    problems: list[Problem] = []
    original = Mpc.solve
    for scenario, seed in RECORDED:
        met: list[Problem] = []

        def solve(self: Mpc, problem: Problem, met: list[Problem] = met) -> Solution:
            met.append(problem)
            return original(self, problem)

        Mpc.solve = solve  # type: ignore[method-assign]
        try:
            setup = prepare(RunRequest(scenario, "cohesive", seed, {"planner.horizon": horizon}))
            simulate(setup)
        finally:
            Mpc.solve = original  # type: ignore[method-assign]
        first = len(met) // 2
        problems += met[first : first + n // len(RECORDED)]
    return problems


class Peer:
    """A peer's model of the same problem: discrete dynamics, our stage cost, bounded controls.

    The state holds the control before, as ours does, because its rate is bounded, too.
    """

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        self.settings = settings
        stage = make_stage(settings, StageParameters(settings, n_lanes))
        self.step = ca.Function("step", stage.inputs(), [stage.next_state])
        self.cost = ca.Function("cost", stage.inputs(), stage.landed(stage.cost))
        most = ca.SX.sym("most", 2)
        excess = rate_excess(stage.state, stage.control, most, settings)
        self.rates = ca.Function("rates", [stage.state, stage.control, most], [excess])
        self.n_parameters = stage.parameters.shape[0]


class DoMpc(Peer):
    """do-mpc, as its documentation has it: a discrete model with time-varying parameters."""

    how = "IPOPT"

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        super().__init__(settings, n_lanes)
        import do_mpc

        model = do_mpc.model.Model("discrete", "SX")
        x, u = model.set_variable("_x", "x", (N_STATES, 1)), model.set_variable("_u", "u", (2, 1))
        p = model.set_variable("_tvp", "p", (self.n_parameters, 1))
        most = model.set_variable("_tvp", "most", (2, 1))
        model.set_rhs("x", self.step(x, u, p))
        model.set_expression("cost", self.cost(x, u, p))
        model.setup()
        controller = do_mpc.controller.MPC(model)
        controller.settings.n_horizon = settings.horizon
        controller.settings.t_step = 0.1
        controller.settings.store_full_solution = False
        controller.settings.nlpsol_opts = {
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "print_time": 0,
            "ipopt.max_iter": settings.max_iterations,
        }
        controller.set_objective(mterm=ca.DM(0), lterm=model.aux["cost"])
        controller.bounds["lower", "_x", "x"] = np.where(np.arange(N_STATES) == 3, 0.0, -np.inf)
        controller.set_nl_cons("rates", self.rates(x, u, most), ub=0.0)
        self._template = controller.get_tvp_template()
        controller.set_tvp_fun(lambda _now: self._template)
        self._controller = controller
        self._ready = False

    def _places(self) -> None:
        """Find where each number stands in do-mpc's flat vectors; its names are slow to use."""
        controller, t = self._controller, self.settings.horizon

        def numbered(structure: Any) -> Any:
            structure.master = ca.DM(np.arange(structure.shape[0]))
            return structure

        def at(value: Any) -> np.ndarray:
            return np.asarray(value).ravel().astype(int)

        template = numbered(controller.get_tvp_template())
        self._p = np.array([at(template["_tvp", k, "p"]) for k in range(t + 1)])
        self._most = np.array([at(template["_tvp", k, "most"]) for k in range(t + 1)])
        whole = numbered(controller._opt_x(0))
        self._u = np.array([at(whole["_u", k, 0]) for k in range(t)])
        self._x = np.array([at(whole["_x", k, 0, -1]) for k in range(t + 1)])
        self._template.master = 0.0

    def solve(
        self, instance: Instance, guess: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        controller, last = (
            self._controller,
            np.minimum(np.arange(self.settings.horizon + 1), self.settings.horizon - 1),
        )
        if not self._ready:
            controller.setup()
            self._places()
            self._ready = True
        varying = np.zeros(self._template.shape[0])
        varying[self._p], varying[self._most] = instance.stages[last], instance.change[last]
        self._template.master = ca.DM(varying)
        for bounds, values in (
            (controller._lb_opt_x, instance.low),
            (controller._ub_opt_x, instance.high),
        ):
            flat = np.asarray(bounds.master).ravel().copy()
            flat[self._u] = values
            bounds.master = ca.DM(flat)
        start = np.asarray(controller.opt_x_num.master).ravel().copy()
        start[self._u] = guess / CONTROL_SCALE
        start[self._x] = states
        controller.opt_x_num.master = ca.DM(start)
        controller.x0 = instance.start
        controller.u0 = guess[0] / CONTROL_SCALE
        controller.make_step(instance.start[:, None])
        controls = np.asarray(controller.opt_x_num.master).ravel()[self._u]
        return controls, bool(controller.solver_stats["success"])


class Rockit(Peer):
    """rockit: multiple shooting of a discrete-time system with parameters per stage."""

    def __init__(self, settings: PlannerSettings, n_lanes: int, solver: str) -> None:
        super().__init__(settings, n_lanes)
        from rockit import MultipleShooting, Ocp

        self.how = solver
        ocp = Ocp(T=settings.horizon)
        x, u = ocp.state(N_STATES), ocp.control(2)
        p = ocp.parameter(self.n_parameters, grid="control")
        most = ocp.parameter(2, grid="control")
        low, high = (ocp.parameter(2, grid="control") for _ in range(2))
        start = ocp.parameter(N_STATES)
        ocp.set_next(x, self.step(x, u, p))
        ocp.add_objective(ocp.sum(self.cost(x, u, p)))
        ocp.subject_to(low <= (u <= high), include_last=False)
        ocp.subject_to(ocp.at_t0(x) == start)
        ocp.subject_to(x[3] >= 0, include_first=False)
        ocp.subject_to(self.rates(x, u, most) <= 0, include_last=False)
        options: dict[str, Any] = {"print_time": False, "error_on_fail": True, "expand": True}
        if solver == "fatrop":
            options |= {"structure_detection": "auto", "fatrop.print_level": 0, "debug": False}
            options["fatrop.max_iter"] = settings.max_iterations
        else:
            options |= {"ipopt.print_level": 0, "ipopt.sb": "yes"}
            options["ipopt.max_iter"] = settings.max_iterations
        t = settings.horizon
        for symbol, columns in ((p, t), (most, t), (low, t), (high, t), (start, 1)):
            ocp.set_value(symbol, np.zeros((symbol.shape[0], columns)))
        ocp.solver(solver, options)
        ocp.method(MultipleShooting(N=settings.horizon, intg="rk"))
        controls = ocp.sample(u, grid="control-")[1]
        states = ocp.sample(x, grid="control")[1]
        given = [ocp.sample(v, grid="control-")[1] for v in (p, most, low, high)]
        given.append(ocp.value(start))
        self._function = ocp.to_function("solve", [*given, states, controls], [controls])

    def solve(
        self, instance: Instance, guess: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        given = (instance.stages, instance.change, instance.low, instance.high)
        start = (states.T, (guess / CONTROL_SCALE).T)
        try:
            found = self._function(*[rows.T for rows in given], instance.start, *start)
        except RuntimeError:
            return np.full((self.settings.horizon, 2), np.nan), False
        return np.asarray(found).T, True


class Ours:
    """One of the planner's own solvers."""

    def __init__(self, settings: PlannerSettings, n_lanes: int, name: str) -> None:
        chosen = settings.model_copy(update={"solver": name})
        self._solver = shared_solver(name, chosen, n_lanes)
        self.how = self._solver.how

    def solve(
        self, instance: Instance, guess: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        del states  # our solvers roll them out themselves
        solution = self._solver.solve(instance, guess)
        if not solution.solved:
            return np.full(instance.low.shape, np.nan), False
        return solution.controls / CONTROL_SCALE, True


@contextlib.contextmanager
def without_compiler() -> Iterator[None]:
    """Keep CasADi's virtual machine."""
    before = os.environ.get("SUMO_COHESION_COMPILE")
    os.environ["SUMO_COHESION_COMPILE"] = "0"
    try:
        yield
    finally:
        del os.environ["SUMO_COHESION_COMPILE"]
        if before is not None:
            os.environ["SUMO_COHESION_COMPILE"] = before


def methods(settings: PlannerSettings, n_lanes: int) -> dict[str, Any]:
    """Everything that is compared, built."""
    made: dict[str, Callable[[], Any]] = {
        OURS: lambda: Ours(settings, n_lanes, "ilqr"),
        "L-BFGS, compiled": lambda: Ours(settings, n_lanes, "lbfgs"),
        "CasADi + fatrop": lambda: Ours(settings, n_lanes, "fatrop"),
        "CasADi + IPOPT": lambda: Ours(settings, n_lanes, "ipopt"),
        "do-mpc": lambda: DoMpc(settings, n_lanes),
        "rockit + fatrop": lambda: Rockit(settings, n_lanes, "fatrop"),
        "rockit + IPOPT": lambda: Rockit(settings, n_lanes, "ipopt"),
    }
    built: dict[str, Any] = {}
    for name, make in made.items():
        with contextlib.redirect_stdout(io.StringIO()):
            built[name] = make()
    if built[OURS].how != "compiled":
        raise SystemExit(f"this benchmark needs a C compiler: {built['ours, compiled'].how}")
    with without_compiler():
        built["ours, no compiler"] = Ours(settings, n_lanes, "ilqr")
        built["L-BFGS (the paper's)"] = Ours(settings, n_lanes, "lbfgs")
    return built


class Judge:
    """Says what a plan is worth if it is driven within the limits: the same for every method."""

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        stage = make_stage(settings, StageParameters(settings, n_lanes))
        self._one = limited_stage(stage, settings)

    def reward(self, instance: Instance, controls: np.ndarray) -> float:
        state, total = instance.start, 0.0
        rows = zip(
            controls, instance.stages, instance.low, instance.high, instance.change, strict=True
        )
        for row in rows:
            state, _, gained = self._one(state, *row)
            total += float(ca.sum1(gained))
        return total


def compare(horizon: int, n: int) -> tuple[pd.DataFrame, dict[str, float]]:
    """Every solve, and the floor."""
    settings = PlannerSettings(horizon=horizon)
    problems = record(horizon, n)
    n_lanes = max(map(lanes_of, problems))
    problems = [problem for problem in problems if lanes_of(problem) == n_lanes]
    host, transcription = Mpc(settings, n_lanes), Transcription(settings, n_lanes)
    bends = StageParameters(settings, n_lanes).columns("road_curvature")
    judge, rows, floors = Judge(settings, n_lanes), [], []
    built = methods(settings, n_lanes)
    warm: dict[str, np.ndarray] = {}
    for i, problem in enumerate(problems):
        instance = transcription.write(problem)
        assert instance is not None, "a recorded problem is finite"
        hold = host.hold(problem)
        nothing = judge.reward(instance, hold / CONTROL_SCALE)
        order = list(built)[i % len(built) :] + list(built)[: i % len(built)]
        for name in order:
            for start in ("cold", "warm"):
                guess = hold if start == "cold" else warm.get(name, hold)
                states = roll_out(instance, guess, bends, settings.friction)
                solve = partial(built[name].solve, instance, guess, states)
                took, (controls, solved) = timed(solve)
                if name == OURS:
                    floors.append(floor(built[OURS]._solver))
                value = judge.reward(instance, controls) if solved else np.nan
                ms = float(np.median(took))
                rows.append((name, start, i, ms, took[0], value, nothing, solved))
            if solved:
                warm[name] = shifted(controls * CONTROL_SCALE)
    columns = ["method", "start", "instance", "ms", "first_ms", "reward", "nothing", "solved"]
    table = pd.DataFrame(rows, columns=columns)
    table["best"] = table.groupby("instance")["reward"].transform("max")
    # A solve that failed is no plan: as far from the best as can be.
    table["gap"] = table["reward"].isna() | (
        (table["best"] - table["reward"]) > 0.01 * (table["best"] - table["nothing"])
    )
    objective, derivatives = np.median(floors, axis=0)
    return table.assign(horizon=horizon), {"objective": objective, "derivatives": derivatives}


def lanes_of(problem: Problem) -> int:
    """Lanes of a problem's road: two columns each, and two more."""
    return problem.road.rows.shape[1] // 2 - 1


def floor(solver: Any) -> list[float]:
    """Microseconds of one evaluation of the objective and of one derivative pass, compiled.

    Of the instance that our solver has solved last, timed as its solves are, less the clock's own
    time.
    """
    passes = solver._forward[solver._present], solver._exact[solver._present]
    clock, *took = (float(np.median(timed(run)[0])) for run in (lambda: None, *passes))
    return [1e3 * (ms - clock) for ms in took]


def timed(run: Callable[[], Any]) -> tuple[list[float], Any]:
    """Milliseconds of CPU time of every repeat, and what the last one returned."""
    took = []
    for _ in range(REPEATS):
        begin = time.process_time()
        returned = run()
        took.append(1e3 * (time.process_time() - begin))
    return took, returned


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--horizons", default="10,40")
    parser.add_argument("--instances", type=int, default=99)
    given = parser.parse_args()
    tables, floors = [], {}
    for horizon in map(int, given.horizons.split(",")):
        everything, floors[horizon] = compare(horizon, given.instances)
        table = summary(everything)
        of_floor = table.loc[("warm", OURS), "median_ms"] / (1e-3 * sum(floors[horizon].values()))
        floors[horizon]["ours_warm_over_floor"] = of_floor
        print(f"\nhorizon {horizon}, floor (µs): {floors[horizon]}")
        print(table.round(3).to_string())
        tables.append(table.reset_index().assign(horizon=horizon))
    pd.concat(tables).set_index("horizon").round(4).to_csv(HERE / "planner.csv")
    about = {
        "command": f"python -m benchmarks.planner --horizons {given.horizons} "
        f"--instances {given.instances}",
        "floor_us": floors,
        "versions": versions() | {name: version(name) for name in ("do-mpc", "rockit-meco")},
    }
    (HERE / "planner.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """One row per start and method."""
    rows = table.groupby(["start", "method"]).agg(
        median_ms=("ms", "median"),
        p99_ms=("ms", lambda ms: ms.quantile(0.99)),
        first_ms=("first_ms", "median"),
        gap=("gap", "sum"),
        failed=("solved", lambda solved: int((~solved).sum())),
        n=("ms", "size"),
    )
    ours = rows["median_ms"].xs(OURS, level="method")
    rows["times_ours"] = rows["median_ms"] / rows.index.get_level_values("start").map(ours)
    return rows


if __name__ == "__main__":
    main()
