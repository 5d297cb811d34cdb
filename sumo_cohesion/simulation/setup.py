"""One run, checked and ready: everything that decides its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import index
from pathlib import Path

from sumo_cohesion.errors import UserError
from sumo_cohesion.perception.observation import Sensor
from sumo_cohesion.planning.planners import Planner
from sumo_cohesion.planning.registry import (
    AnyPlanner,
    check_planner,
    cohesion_of,
    make_planner,
    planner_name,
)
from sumo_cohesion.planning.route import check_road
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.overrides import settings_from
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.scenario import Scenario, load_scenario
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.traffic.demand import build_demand, check_demand, check_human_type
from sumo_cohesion.traffic.demand_files import read_demand
from sumo_cohesion.traffic.input_files import write_input_files, write_portable_files
from sumo_cohesion.traffic.network import Network
from sumo_cohesion.traffic.outputs import SumoOutputs
from sumo_cohesion.traffic.simulator import SumoRun

_MARGIN = 50.0
"""Metres beyond the sensing range that are read and recorded, too."""


@dataclass(frozen=True)
class Inputs:
    """What a run is made of, but for its seed: settings as they are used, files as they lie."""

    scenario: Scenario
    planner_name: str
    settings: PlannerSettings
    cohesion: CohesionSettings
    network: Path
    routes: tuple[Path, ...]
    additional: tuple[Path, ...]


@dataclass(frozen=True)
class Setup(Inputs):
    """One run, checked and ready: everything that decides its result.

    ``traffic_lights`` are those of the route, which planned cars do not know; ``outputs`` only
    adds to what is written; ``notes`` is what there is to say about the demand.
    """

    planner: AnyPlanner
    seed: int
    route: tuple[str, ...]
    road: Road
    traffic_lights: tuple[str, ...] = ()
    outputs: SumoOutputs | None = None
    notes: tuple[str, ...] = ()

    @property
    def not_human(self) -> set[str]:
        """Vehicles that the scenario hides or calls special: a stalled car, an ambulance."""
        return {*self.scenario.sensing.hidden, *self.scenario.sensing.special}

    @property
    def ego_size(self) -> tuple[float, float]:
        """Length, width (m) of the ego."""
        return self.scenario.ego.length, self.scenario.ego.width

    @property
    def penetration(self) -> float:
        """Share of other cars that the planner drives; none if the planner is SUMO itself."""
        return 0.0 if self.planner_name == "sumo" else self.scenario.fleet.penetration

    @property
    def recorded_radius(self) -> float:
        """Metres around the ego within which vehicles are recorded."""
        return self.scenario.sensing.range + _MARGIN

    @property
    def read_radius(self) -> float:
        """Metres around the ego within which vehicles are read from SUMO.

        With a fleet, all that a planned car at the edge of the ego's range senses.
        """
        return self.recorded_radius + (self.scenario.sensing.range if self.penetration else 0.0)

    @property
    def sensor(self) -> Sensor:
        """What planned cars can see."""
        sensing = self.scenario.sensing
        return Sensor(sensing.range, frozenset(sensing.hidden), frozenset(sensing.special))

    def make_planner(self) -> Planner:
        """Make a planner for one car."""
        return make_planner(self.planner, self.settings, self.cohesion)

    def road_along(self, route: Sequence[str]) -> Road:
        """Road along any route of this network; raises UserError if no car can drive along it."""
        return road_of(self.network, route)

    def write_inputs(self, folder: Path, gui: bool = False, *, portable: bool = False) -> SumoRun:
        """Write this seed's demand and return what SUMO needs.

        ``portable``: all of it into the folder, which can then be moved.
        """
        scenario = self.scenario
        demand = build_demand(
            read_demand(self.routes, self.additional),
            _network(self.network, *_version(self.network)),
            self.route,
            scenario.ego,
            scenario.randomize,
            scenario.human_type,
            self.not_human,
            self.seed,
        )
        write = write_portable_files if portable else write_input_files
        files = write(demand, self.network, folder)
        return SumoRun(
            network=files.network,
            demand=files.demand,
            additional=files.additional,
            seed=self.seed,
            lateral_resolution=scenario.lateral_resolution,
            gui=gui,
            outputs=self.outputs,
            output_folder=files.outputs,
        )


def resolve(request: RunRequest) -> Inputs:
    """Load and validate the settings and find the files, quickly: nothing is opened yet."""
    settings, cohesion, scenario_overrides = settings_from(request.overrides)
    loaded, name = (
        load_scenario(request.scenario, scenario_overrides),
        planner_name(request.planner),
    )
    return Inputs(
        scenario=loaded,
        planner_name=name,
        settings=settings,
        cohesion=cohesion_of(name, cohesion),
        network=loaded.file(loaded.network, "networks"),
        routes=tuple(loaded.file(name, "routes") for name in loaded.routes),
        additional=tuple(loaded.file(name, "routes") for name in loaded.additional),
    )


def prepare(request: RunRequest) -> Setup:
    """Check everything a run needs before SUMO starts.

    Raises
    ------
    UserError
        If the scenario, its network or demand, the planner or a setting is wrong.
    """
    seed, planner = _seed(request.seed), request.planner
    inputs = resolve(request)
    loaded = inputs.scenario
    if isinstance(planner, str):
        check_planner(planner)
    elif not isinstance(planner, type) and loaded.fleet.penetration:
        raise UserError(
            "fleet.penetration: every planned car needs a planner of its own; give the planner's "
            "class or name instead of an object"
        )
    network = _network(inputs.network, *_version(inputs.network))
    fixed = {*loaded.sensing.hidden, *loaded.sensing.special}
    named = set(fixed)
    for event in loaded.events:
        named |= {*event.who} | ({event.near} if event.near else set())
    check_human_type(loaded.human_type)
    demand = read_demand(inputs.routes, inputs.additional)
    route, notes = check_demand(network, demand, loaded.ego, loaded.randomize, fixed, named)
    road = _road(inputs.network, *_version(inputs.network), tuple(route))
    check_road(inputs.planner_name, inputs.settings, road, loaded.ego.position, loaded.duration)
    return Setup(
        **vars(inputs),
        planner=planner,
        seed=seed,
        route=tuple(route),
        road=road,
        traffic_lights=tuple(network.traffic_lights(route)),
        notes=notes,
    )


def road_of(network: Path, route: Sequence[str]) -> Road:
    """Road along a route of a network file, read once; raises UserError if there is none."""
    if not network.is_file():
        raise UserError(f"{network}: the network is no longer there")
    return _road(network, *_version(network), tuple(route))


def _seed(given: object) -> int:
    try:
        seed = int(index(given))  # type: ignore[arg-type]
    except TypeError:
        raise UserError(f"seed {given!r} is no whole number") from None
    if not 0 <= seed < 2**31:
        raise UserError(f"seed {seed} is out of range; SUMO takes 0 to 2147483647")
    return seed


def _version(path: Path) -> tuple[int, int]:
    """Return when a file was changed and how long it is: if either differs, it is read again."""
    stat = path.stat()
    return stat.st_mtime_ns, stat.st_size


@lru_cache(maxsize=16)
def _network(path: Path, _changed: int, _size: int) -> Network:
    return Network(path)


@lru_cache(maxsize=64)
def _road(path: Path, changed: int, size: int, route: tuple[str, ...]) -> Road:
    return _network(path, changed, size).road(route)
