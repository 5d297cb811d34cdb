"""One run that can be stepped from outside.

    with Episode(setup) as episode:
        observation = episode.reset()
        while not episode.outcome:
            observation = episode.step(decide(observation))

What decides is the caller's: a planner (simulation.run), a policy that learns, a person. The other
cars are SUMO's and, if the scenario asks for them, a fleet's.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from time import perf_counter
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from sumo_cohesion.errors import SimulationError, StoppedError
from sumo_cohesion.perception.observation import Overview
from sumo_cohesion.simulation.car import Spent, at_end, drive
from sumo_cohesion.simulation.fleet import Fleet
from sumo_cohesion.state import EGO, STEP, STOPPED, Control, Observation, Plan, Scene
from sumo_cohesion.traffic.contact import contacts
from sumo_cohesion.traffic.drivers import Drivers
from sumo_cohesion.traffic.simulator import Simulator

if TYPE_CHECKING:
    from sumo_cohesion.simulation.setup import Setup

TERMINAL = ("collision", "left_route", "route_end")
"""Outcomes after which nothing is left to decide; any other cuts a run off."""
_NOT_STARTED = "not started"
_LOST = 10.0
"""Metres from the nearest lane of its route, or off it, beyond which the ego has left both."""
_PATIENCE = 60.0
"""Seconds after its departure within which SUMO must have put the ego on the road."""


class Seconds(NamedTuple):
    """Wall time of one step: the ego's perception and planning, all other planned cars', SUMO's."""

    perception: float
    plan: float
    fleet: float
    sumo: float


@dataclass(frozen=True, slots=True)
class Moment:
    """One step that was driven.

    Attributes
    ----------
    scene, overview : the truth when it was decided, and all of it that can be seen.
    observation, plan : what the ego saw of it, and decided.
    planned : the vehicles besides the ego that planners drove.
    seconds : wall time.
    """

    scene: Scene
    overview: Overview
    observation: Observation
    plan: Plan
    planned: frozenset[str]
    seconds: Seconds


@dataclass(frozen=True, slots=True)
class Ending:
    """How a run ended.

    Attributes
    ----------
    scene : the truth after the last step.
    outcome : collision, left_route, route_end, finished, or stopped.
    touched, touched_by_sumo : vehicles the ego touched, and those that SUMO says it touched.
    triggered : SUMO's time (s) of each of the scenario's events, by number.
    fleet : what became of the other planned cars (Fleet.summary).
    """

    scene: Scene
    outcome: str
    touched: tuple[str, ...]
    touched_by_sumo: tuple[str, ...]
    triggered: dict[int, float]
    fleet: dict[str, Any]


class Listener(Protocol):
    """Hears of every step, and of the end: a recorder, a twin, a clock."""

    def on_step(self, moment: Moment) -> None:
        """Hear of a step that was driven."""

    def on_end(self, ending: Ending) -> None:
        """Hear how it ended; once, and not if the run was left before."""


class Episode:
    """One run of SUMO with an ego that the caller drives; a context manager.

    At most one runs per process. ``outcome`` is empty while it goes on. Then the run has either
    *terminated* (a collision, the end of the route, or the ego left it) or was *truncated* (its
    time was up, SUMO stopped, or it was closed): what would have come is unknown.

    Parameters
    ----------
    setup : the run (simulation.setup.prepare).
    listeners : who is told of every step.
    gui : show SUMO's window.
    outputs : folder that takes what the user's additional files make SUMO write, when the episode
        is closed; without it that is lost.

    Raises
    ------
    UserError
        By reset and step, if SUMO rejects the network or the demand. The listeners have heard of
        all steps before, and of the end.
    SimulationError
        If the simulation cannot be trusted.
    """

    def __init__(
        self,
        setup: Setup,
        listeners: Sequence[Listener] = (),
        *,
        gui: bool = False,
        outputs: Path | None = None,
    ) -> None:
        self._setup = setup
        self._listeners = listeners
        self._gui = gui
        self._outputs = outputs
        self._sensor = setup.sensor
        self._open = contextlib.ExitStack()
        self.outcome = _NOT_STARTED

    def __enter__(self) -> Episode:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End SUMO; the last observation and outcome stay."""
        self.outcome = self.outcome or "closed"
        self._open.close()

    def reset(self) -> Observation:
        """Start the run, anew if it has begun: the same traffic every time."""
        self.close()
        setup = self._setup
        self._open = contextlib.ExitStack()
        with contextlib.ExitStack() as opening:
            folder = Path(opening.enter_context(tempfile.TemporaryDirectory()))
            run = setup.write_inputs(folder, self._gui)
            if self._outputs is not None and run.output_folder is not None:
                opening.callback(  # once SUMO is closed, and has written the last of it
                    shutil.copytree, run.output_folder, self._outputs, dirs_exist_ok=True
                )
            sumo = opening.enter_context(Simulator(run, setup.ego_size, setup.read_radius))
            scene = sumo.insert_ego(latest=setup.scenario.ego.depart + _PATIENCE)
            self._open = opening.pop_all()
        self._sumo = sumo
        self._drivers = Drivers(setup.scenario.events, setup.not_human, setup.seed, scene.time)
        self._fleet = Fleet(setup)
        self._end = scene.time + setup.scenario.duration
        self.outcome = ""
        return self._look(scene)

    @property
    def terminated(self) -> bool:
        """Tell whether the run has come to an end of its own."""
        return self.outcome in TERMINAL

    @property
    def truncated(self) -> bool:
        """Tell whether the run was cut off."""
        return self.outcome not in ("", _NOT_STARTED, *TERMINAL)

    @property
    def scene(self) -> Scene:
        """The truth around the ego now."""
        return self._scene

    @property
    def observation(self) -> Observation:
        """What the ego sees now."""
        return self._observation

    def step(self, decided: Plan | Control | None, spent: Spent = Spent()) -> Observation:  # noqa: B008
        """Drive one step.

        Parameters
        ----------
        decided : the ego's plan, of which the first control is driven; a control alone; or None,
            and SUMO drives the ego.
        spent : the caller's own wall time, for the record.

        Returns
        -------
        What the ego sees after the step.
        """
        if self.outcome:
            raise SimulationError(f"the episode is over ({self.outcome}); call reset() first")
        plan = decided if isinstance(decided, Plan) else _plan_of(decided, self._observation)
        scene, overview, observation = self._scene, self._overview, self._observation
        t0 = perf_counter()
        others = self._fleet.drive(scene, overview)
        t1 = perf_counter()
        ego = drive(scene.ego, plan, self._setup.settings)
        try:
            self._drivers.act(scene.time, self._sumo, others)
            self._sumo.step(ego, others)
            following = self._sumo.read()
        except (StoppedError, SimulationError):
            self._finish(scene, STOPPED, ())
            raise
        seconds = Seconds(
            self._looking + spent.remembering, spent.planning, t1 - t0, perf_counter() - t1
        )
        planned = frozenset(others)
        moment = Moment(scene, overview, observation, plan, planned, seconds)
        for listener in self._listeners:
            listener.on_step(moment)
        return self._arrive(following)

    def _arrive(self, scene: Scene) -> Observation:
        """See where the step has led, and whether it was the last."""
        before = self._observation.ego
        found = contacts(scene.ego, scene.ego_size, scene.states, scene.sizes)
        touched = tuple([scene.ids[i] for i in found])
        observation = self._look(scene)
        outcome = "collision" if touched else self._outcome(before.s, before.d, scene)
        if outcome:
            self._finish(scene, outcome, touched)
        return observation

    def _look(self, scene: Scene) -> Observation:
        # Who has come or gone is settled first: it decides who is followed.
        self._fleet.meet(scene, self._sumo)
        t0 = perf_counter()
        self._scene = scene
        self._overview = self._sensor.survey(scene, self._setup.road, self._fleet.not_followed)
        self._observation = self._overview.seen_by(EGO)
        self._looking = perf_counter() - t0
        return self._observation

    def _outcome(self, s: float, d: float, there: Scene) -> str:
        """Why the run ends here; empty if it goes on. The ego was at (s, d) a step ago."""
        road = self._setup.road
        aside = abs(d - road.nearest_lane(s, d))
        if _LOST < aside < inf and road.away(there.ego.x, there.ego.y) > _LOST:
            return "left_route"
        if at_end(road, s):
            return "route_end" if road.lane_of(s, d) < road.n_route_lanes else "left_route"
        return "finished" if there.time > self._end - STEP / 2 else ""

    def _finish(self, scene: Scene, outcome: str, touched: tuple[str, ...]) -> None:
        self.outcome = outcome
        told = () if outcome == STOPPED else tuple(self._sumo.reported_contacts())
        ending = Ending(
            scene, outcome, touched, told, self._drivers.triggered, self._fleet.summary()
        )
        for listener in self._listeners:
            listener.on_end(ending)


def _plan_of(control: Control | None, observation: Observation) -> Plan:
    states = np.array([observation.ego])
    if control is None:
        return Plan(controls=(), states=states, status="sumo")
    return Plan(controls=(Control(*control),), states=states, status="driven from outside")
