"""How: the cohesive model predictive controller (paper, eqs. 1 and 2), built once, solved often.

Multiple shooting: the states and controls of the horizon are the unknowns, the dynamics are
equality constraints. Everything that changes from step to step is a parameter.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from typing import Any

import casadi as ca
import numpy as np

from sumo_cohesion.planning import dynamics, reward
from sumo_cohesion.planning.dynamics import DT
from sumo_cohesion.planning.settings import PlannerSettings, RewardWeights
from sumo_cohesion.social.features import FEATURES, social_features
from sumo_cohesion.state import FloatArray, RoadState

FAR_AWAY = 1e4
"""Metres at which lanes and cars that do not exist are put: their Gaussians are zero there."""
_CONTROL_SCALE = np.array([0.01, 5.0])

# NumPy's functions on CasADi symbols return CasADi symbols.
ca.GlobalOptions.setNumpyMode(1)


@dataclass(frozen=True)
class Problem:
    """One instance: what changes from step to step. T stages, L lanes, N cars, k features.

    Attributes
    ----------
    ego : (4,) road state.
    ego_width : (1,) m.
    road_curvature : (T,) of the reference line (1/m) at the start of each stage.
    lanes, lane_widths : (L, T) m, at the end of each stage.
    right, left : (T,) m, edges of the drivable strip.
    speed_limit : (T,) m/s.
    cars : (6, N, T), see reward.StageInputs.
    theta : (6,) weights of the reward terms.
    cohesion_weight, cohesion_target : (k, T), beta included; zero weights: not cohesive.
    place_weight, place_target : (T,) per m², beta included, and m: where across the road.
    """

    ego: FloatArray
    ego_width: FloatArray
    road_curvature: FloatArray
    lanes: FloatArray
    lane_widths: FloatArray
    right: FloatArray
    left: FloatArray
    speed_limit: FloatArray
    cars: FloatArray
    theta: FloatArray
    cohesion_weight: FloatArray
    cohesion_target: FloatArray
    place_weight: FloatArray
    place_target: FloatArray

    def vector(self) -> FloatArray:
        """All parameters as one vector, each field in column-major order as CasADi has it."""
        return np.concatenate([getattr(self, f.name).ravel(order="F") for f in fields(self)])


@dataclass(frozen=True)
class Solution:
    """What the solver gave: states (T + 1, 4), controls (T, 2), and how it went."""

    states: FloatArray
    controls: FloatArray
    solved: bool
    status: str
    iterations: int
    wall_time: float
    reward: dict[str, float]


class Mpc:
    """The controller for roads of up to ``n_lanes`` lanes.

    The first solve starts from a rollout that holds speed and lane; later ones from the last
    solution shifted by one step, unless ``reset`` is called.
    """

    def __init__(self, settings: PlannerSettings, n_lanes: int) -> None:
        self.settings = settings
        self.n_lanes = n_lanes
        self._warm: FloatArray | None = None
        self._build()

    def _build(self) -> None:
        horizon, n_cars, k = self.settings.horizon, self.settings.cars, len(FEATURES)
        shapes = {
            "ego": (4, 1),
            "ego_width": (1, 1),
            "road_curvature": (1, horizon),
            "lanes": (self.n_lanes, horizon),
            "lane_widths": (self.n_lanes, horizon),
            "right": (1, horizon),
            "left": (1, horizon),
            "speed_limit": (1, horizon),
            "cars": (6, n_cars * horizon),
            "theta": (len(RewardWeights.model_fields), 1),
            "cohesion_weight": (k, horizon),
            "cohesion_target": (k, horizon),
            "place_weight": (1, horizon),
            "place_target": (1, horizon),
        }
        p = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
        states = [ca.SX.sym(f"x{t}", 4) for t in range(horizon + 1)]
        controls = [ca.SX.sym(f"u{t}", 2) for t in range(horizon)]

        unknowns, constraints = [], []
        total: dict[str, Any] = dict.fromkeys(RewardWeights.model_fields, ca.SX(0))
        cohesion = ca.SX(0)
        for t in range(horizon):
            control = [controls[t][i] * _CONTROL_SCALE[i] for i in range(2)]
            before, after = ca.vertsplit(states[t]), ca.vertsplit(states[t + 1])
            curvature = p["road_curvature"][t]
            stepped = dynamics.step(before, control, DT, self.settings.friction, curvature)
            unknowns += [states[t], controls[t]]
            constraints.append(states[t + 1] - ca.vertcat(*stepped))
            if t == 0:
                constraints.append(states[0] - p["ego"])
            # Original reward, eq. 1, at the state each control leads to.
            inputs = reward.StageInputs(
                lanes=p["lanes"][:, t],
                lane_widths=p["lane_widths"][:, t],
                right=p["right"][t],
                left=p["left"][t],
                speed_limit=p["speed_limit"][t],
                cars=p["cars"][:, t * n_cars : (t + 1) * n_cars],
            )
            for i, (name, term) in enumerate(
                reward.terms(after, control, inputs, p["ego_width"]).items()
            ):
                total[name] += p["theta"][i] * term
            # Cohesion, eq. 2: distance of the ego's social features from the groups' means.
            psi = ca.vertcat(*social_features(before, after, DT, curvature))
            missed = p["cohesion_target"][:, t] - psi
            cohesion -= ca.dot(p["cohesion_weight"][:, t], missed**2)
            cohesion -= p["place_weight"][t] * (p["place_target"][t] - after[1]) ** 2
        unknowns.append(states[horizon])

        z, g, parameters = (
            ca.vertcat(*unknowns),
            ca.vertcat(*constraints),
            ca.vertcat(*map(ca.vec, p.values())),
        )
        objective = -(ca.vertcat(*total.values(), cohesion))
        nlp = {"x": z, "p": parameters, "f": ca.sum1(objective), "g": g}
        self._nlp = nlp
        self._n_constraints = g.shape[0]
        self._solver = self._make_solver(self.settings.solver)
        self._second: Any = None
        self._terms = ca.Function("terms", [z, parameters], [-objective])
        self._term_names = (*total, "cohesion")

    def _make_solver(self, name: str) -> Any:
        options: dict[str, Any] = {"print_time": False, "error_on_fail": False}
        iterations = self.settings.max_iterations
        if name == "fatrop":
            options |= {
                "structure_detection": "auto",
                "equality": [True] * self._n_constraints,
                "fatrop.print_level": 0,
                "fatrop.max_iter": iterations,
            }
        else:
            options |= {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": iterations}
        return ca.nlpsol(name, name, self._nlp, options)

    def _rescue(self) -> Any:
        """IPOPT, slower and sturdier, for what the chosen solver cannot solve; built if needed."""
        if self._second is None:
            self._second = self._make_solver("ipopt")
        return self._second

    def reset(self) -> None:
        """Forget the last solution."""
        self._warm = None

    def solve(self, problem: Problem) -> Solution:
        """Solve one instance; never raises for a solver's failure, see ``solved``."""
        parameters = problem.vector()
        if not np.isfinite(parameters.sum()):
            # Some solvers never return from a problem that is not a number.
            return self._failed("input is not finite", 0, 0.0)
        ego = RoadState(*problem.ego)
        lower, upper = self._bounds(ego.speed)
        hold = self._hold(problem)
        attempts = [(self._solver, hold if self._warm is None else self._warm)]
        iterations, status, solved, z = 0, "", False, np.empty(0)
        start = time.perf_counter()
        while attempts and not solved:
            solver, guess = attempts.pop()
            result = solver(x0=guess, p=parameters, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
            stats = solver.stats()
            z = np.asarray(result["x"]).ravel()
            iterations += int(stats["iter_count"])
            solved = bool(stats["success"]) and bool(np.isfinite(z.sum()))
            status = f"{solver.name()} returned {stats['return_status']}"
            if not solved and solver is self._solver:
                attempts.append((self._rescue(), hold))
        wall_time = time.perf_counter() - start
        if not solved:
            self._warm = None
            return self._failed(status, iterations, wall_time)
        states, controls = self._unpack(z)
        self._warm = self._shifted(states, controls)
        values = np.asarray(self._terms(z, parameters)).ravel()
        return Solution(
            states=states,
            controls=controls,
            solved=True,
            status="solved",
            iterations=iterations,
            wall_time=wall_time,
            reward=dict(zip(self._term_names, values.tolist(), strict=True)),
        )

    def _failed(self, status: str, iterations: int, wall_time: float) -> Solution:
        empty = np.zeros((0, 0))
        return Solution(empty, empty, False, status, iterations, wall_time, {})

    def _bounds(self, speed: float) -> tuple[FloatArray, FloatArray]:
        """Bounds on the unknowns: curvature, net acceleration, no reversing."""
        settings = self.settings
        drag = settings.friction * speed
        free = np.full(4, np.inf)
        x_low, x_high = np.array([-np.inf, -np.inf, -np.inf, 0.0]), free
        limit = np.array([settings.max_curvature, drag + settings.max_acceleration])
        u_high = limit / _CONTROL_SCALE
        u_low = np.array([-settings.max_curvature, drag - settings.max_braking]) / _CONTROL_SCALE
        t = settings.horizon
        lower = np.concatenate((np.tile(np.concatenate((x_low, u_low)), t), x_low))
        # The present state is given: a bound that it lies on would leave no interior.
        lower[:4] = -np.inf
        upper = np.concatenate((np.tile(np.concatenate((x_high, u_high)), t), x_high))
        return lower, upper

    def _hold(self, problem: Problem) -> FloatArray:
        """Guess that keeps speed and heading along the road."""
        state = tuple(float(v) for v in problem.ego)
        states, controls = [state], []
        for t in range(self.settings.horizon):
            curvature = float(problem.road_curvature[t])
            control = (curvature, self.settings.friction * state[3])
            state = dynamics.step(state, control, DT, self.settings.friction, curvature)
            states.append(state)
            controls.append(control)
        return self._pack(np.array(states), np.array(controls))

    def _shifted(self, states: FloatArray, controls: FloatArray) -> FloatArray:
        """Shift a solution by one step in time: the last control is held."""
        last = dynamics.step(states[-1], controls[-1], DT, self.settings.friction)
        return self._pack(
            np.vstack((states[1:], np.array(last))), np.vstack((controls[1:], controls[-1:]))
        )

    def _pack(self, states: FloatArray, controls: FloatArray) -> FloatArray:
        rows = np.hstack((states[:-1], controls / _CONTROL_SCALE))
        return np.concatenate((rows.ravel(), states[-1]))

    def _unpack(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = z[:-4].reshape(self.settings.horizon, 6)
        states = np.vstack((rows[:, :4], z[-4:]))
        return states, rows[:, 4:] * _CONTROL_SCALE
