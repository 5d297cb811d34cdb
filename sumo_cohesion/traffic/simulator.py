"""The bridge: start SUMO, read a Scene, put cars where their planners drove them, step, close.

libsumo: https://sumo.dlr.de/docs/Libsumo.html
moveToXY: https://sumo.dlr.de/docs/TraCI/Change_Vehicle_State.html#move_to_xy_0xb4
"""

from __future__ import annotations

import contextlib
import threading
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, degrees, hypot, inf, isfinite, pi, radians, sin
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, NamedTuple

import numpy as np

from sumo_cohesion.errors import SimulationError, StoppedError, UserError
from sumo_cohesion.state import EGO, STEP, CartesianState, Scene
from sumo_cohesion.traffic.contact import contacts
from sumo_cohesion.traffic.library import captured_stderr, first_error, load_libsumo, load_window
from sumo_cohesion.traffic.outputs import SumoOutputs

_LARGEST = 10_000.0
"""Length or width (m) of the largest vehicle that can be meant."""
_POSITION_TOLERANCE = 0.05
"""Metres by which SUMO's car may differ from the driven one. Measured: below 0.001."""
_KEEP_ROUTE_EXACT = 2
"""moveToXY: put the ego exactly there, map it to whatever lane is below, or to none."""
_SPEED_FACTOR = 3.0
_NO_OTHERS: Mapping[str, CartesianState] = MappingProxyType({})

_RUNNING = threading.Lock()  # held as long as a simulation runs


class _Manners(NamedTuple):
    """How SUMO drove a car before it was taken over: what it gets back."""

    max_speed: float
    speed_factor: float
    speed_mode: int
    lane_change_mode: int


@dataclass(frozen=True)
class SumoRun:
    """What SUMO needs to start one run.

    ``output_folder`` is where SUMO writes what the additional files ask for (detectors and the
    like), to the end when it is closed; None if they ask for nothing.
    """

    network: Path
    demand: Path
    additional: tuple[Path, ...]
    seed: int
    lateral_resolution: float
    gui: bool = False
    outputs: SumoOutputs | None = None
    output_folder: Path | None = None

    def options(self) -> list[str]:
        """SUMO's command line, without the program.

        The sublane model is always on: without it an ego between two lanes is a phantom to
        others and collisions are misreported. ``collision.action warn`` leaves both cars in
        the simulation; the own contact test decides.
        """
        pairs: dict[str, object] = {
            "net-file": self.network,
            "route-files": self.demand,
            "step-length": STEP,
            "lateral-resolution": self.lateral_resolution,
            "collision.action": "warn",
            "collision.mingap-factor": 0,
            "collision.check-junctions": "true",
            "time-to-teleport": -1,
            "seed": self.seed,
            "no-step-log": "true",
            "no-warnings": "true",
            "duration-log.disable": "true",
        }
        for path in (self.network, self.demand, *self.additional):
            if "," in str(path):
                raise UserError(
                    f"SUMO splits names of files at commas, and {str(path)!r} has one; rename its "
                    "folder, or for temporary files set TMPDIR to another"
                )
        if self.additional:
            pairs["additional-files"] = ",".join(map(str, self.additional))
        if self.outputs is not None:
            pairs |= self.outputs.options()
        options = [text for key, value in pairs.items() for text in (f"--{key}", str(value))]
        return [*options, "--start", "--quit-on-end"] if self.gui else options

    def write_config(self, path: Path) -> None:
        """Write a .sumocfg that opens this run in plain SUMO, with SUMO driving the ego."""
        root = ET.Element("sumoConfiguration")
        options = self.options()
        for key, value in zip(options[::2], options[1::2], strict=True):
            if key in ("--net-file", "--route-files", "--additional-files"):
                value = ",".join(Path(p).name for p in value.split(","))
            ET.SubElement(root, key[2:], value=value)
        ET.indent(root, "    ")
        ET.ElementTree(root).write(path, encoding="UTF-8", xml_declaration=True)


class Simulator:
    """One SUMO simulation; a context manager, at most one per process.

    Raises
    ------
    UserError
        If SUMO rejects the network or the demand; StoppedError if it does so later on.
    SimulationError
        If a car is not where it was put, or the ego has gone.
    """

    def __init__(self, run: SumoRun, ego_size: tuple[float, float], radius: float) -> None:
        self._run = run
        self._ego_size = ego_size
        self._radius = radius
        self._sizes = {EGO: ego_size}
        self._driven: dict[str, CartesianState] = {}
        self._manners: dict[str, _Manners] = {}
        self._stepped = True
        self._sumo: Any = None
        self._variables: tuple[int, ...] = ()

    def __enter__(self) -> Simulator:
        if not _RUNNING.acquire(blocking=False):
            raise SimulationError(
                "a SUMO simulation is already running in this process, and a second one would "
                "silently replace it; close it first, or use another process"
            )
        try:
            sumo = self._started()
        except BaseException:
            _RUNNING.release()
            raise
        self._sumo = sumo
        tc = sumo.constants
        self._variables = (tc.VAR_POSITION, tc.VAR_ANGLE, tc.VAR_SPEED)
        return self

    def _started(self) -> Any:
        sumo, program = load_window() if self._run.gui else (load_libsumo(), "sumo")
        with captured_stderr() as said:
            try:
                sumo.start([program, *self._run.options()])
            except Exception as error:
                reason = first_error(said()) or str(error)
                raise UserError(f"SUMO cannot start this scenario: {reason}") from None
        return sumo

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            with contextlib.suppress(Exception):
                self._take_up_moves()
            with contextlib.suppress(Exception):
                self._sumo.close()
        finally:  # whatever interrupts it
            _RUNNING.release()

    def _take_up_moves(self) -> None:
        """Step once more: a moveToXY not taken up crashes the next simulation in this process."""
        vehicle = self._sumo.vehicle
        for _ in range(10):
            if self._stepped:
                return
            with contextlib.suppress(StoppedError):
                self._step()
                return
            # What SUMO stumbles over is what it is about to insert.
            for name in {*vehicle.getLoadedIDList()} - {*vehicle.getIDList()}:
                vehicle.remove(name)

    def insert_ego(self, latest: float) -> Scene:
        """Step until SUMO has put the ego on the road and return the first scene.

        ``latest`` (s) is when to give up.
        """
        while EGO not in self._sumo.simulation.getDepartedIDList():
            if self._sumo.simulation.getTime() > latest:
                raise UserError(
                    f"SUMO has not inserted the ego by {latest:g} s; its start is blocked, "
                    "choose another ego.position, ego.lane or ego.depart"
                )
            self._step()
        self._sumo.vehicle.subscribeContext(
            EGO, self._sumo.constants.CMD_GET_VEHICLE_VARIABLE, self._radius, self._variables
        )
        scene = self.read()
        inside = contacts(scene.ego, scene.ego_size, scene.states, scene.sizes)
        if inside.size:
            raise UserError(
                f"at its start the ego would overlap vehicle {scene.ids[inside[0]]!r}; choose "
                "another ego.position, ego.lane or ego.depart"
            )
        return scene

    def _take_over(self, name: str) -> None:
        """Switch off SUMO's own control of a car, unless it is off.

        A high speed factor matters: SUMO reports a car moved faster than its lane's limit
        times that factor at the capped speed, and humans follow what is reported. SUMO's
        bluelight device takes the factor away again from a car that it no longer influences.
        """
        vehicle = self._sumo.vehicle
        factor = vehicle.getSpeedFactor(name)
        if name not in self._manners:
            self._manners[name] = _Manners(
                vehicle.getMaxSpeed(name),
                factor,
                vehicle.getSpeedMode(name),
                vehicle.getLaneChangeMode(name),
            )
        elif factor == _SPEED_FACTOR:
            return
        self._give(name, _Manners(70.0, _SPEED_FACTOR, 0, 0))

    def release(self, name: str) -> None:
        """Give a car back to SUMO as it was taken; `step` does so with all it does not move.

        SUMO drives on from where the car is, into its lane's centre if it is beside it. A car
        beside the road has no lane to drive on, and SUMO takes it out of the simulation.
        """
        manners = self._manners.pop(name, None)
        if manners is not None and name in self._sumo.vehicle.getIDList():
            self._give(name, manners)

    def _give(self, name: str, manners: _Manners) -> None:
        vehicle = self._sumo.vehicle
        # In this order: setMaxSpeed gives the car a type of its own, with speed factor 1.
        vehicle.setMaxSpeed(name, manners.max_speed)
        vehicle.setSpeedFactor(name, manners.speed_factor)
        vehicle.setSpeedMode(name, manners.speed_mode)
        vehicle.setLaneChangeMode(name, manners.lane_change_mode)

    def step(
        self, ego: CartesianState | None, others: Mapping[str, CartesianState] = _NO_OTHERS
    ) -> None:
        """Advance SUMO by one step, with the ego and some others at the given states.

        SUMO drives all that are not given; the ego, too, if it is None.
        """
        driven = dict(others) if ego is None else {EGO: ego, **others}
        for name, state in driven.items():
            if not all(map(isfinite, state)):
                called = "the ego" if name == EGO else f"vehicle {name!r}"
                raise SimulationError(
                    f"{called} would be moved to a place that is no number: {state}"
                )
        for name in [name for name in self._manners if name not in driven]:
            self.release(name)
        for name, state in driven.items():
            self._take_over(name)
            self._move(name, state)
        self._driven = driven
        self._step()

    def _move(self, name: str, state: CartesianState) -> None:
        # SUMO's angles are degrees clockwise from north; its positions are front bumpers.
        half = self._size(name)[0] / 2
        front = state.x + half * cos(state.heading), state.y + half * sin(state.heading)
        angle = (90.0 - degrees(state.heading)) % 360.0
        self._sumo.vehicle.moveToXY(name, "", -1, *front, angle, _KEEP_ROUTE_EXACT)
        self._stepped = False

    def read(self) -> Scene:
        """Read what is around the ego now."""
        vehicle = self._sumo.vehicle
        found = vehicle.getContextSubscriptionResults(EGO)
        position, angle, speed = self._variables
        present: set[str] | None = None
        for name in (EGO, *self._driven):
            if name in found:
                continue
            present = set(vehicle.getIDList()) if present is None else present
            if name in present:
                # Beside the road SUMO's search around the ego finds neither the ego nor others.
                at = vehicle.getPosition(name)
                found[name] = {position: at, angle: vehicle.getAngle(name), speed: 0.0}
            elif name == EGO:
                raise SimulationError("SUMO has removed the ego; it came to the end of its route")
        cars = {
            name: self._centre(row[position], row[angle], row[speed], self._size(name)[0])
            for name, row in found.items()
        }
        for name, driven in self._driven.items():
            if name in cars:
                # SUMO's speed is the same to rounding; its heading is that of the last move.
                cars[name] = self._where_it_was_put(name, cars[name], driven)
        ego = cars.pop(EGO)
        return Scene(
            time=float(self._sumo.simulation.getTime()),
            ego=ego,
            ego_size=self._ego_size,
            ids=tuple(cars),
            states=np.array(list(cars.values()), dtype=float).reshape(-1, 4),
            sizes=np.array([self._sizes[name] for name in cars], dtype=float).reshape(-1, 2),
        )

    @staticmethod
    def _where_it_was_put(
        name: str, found: CartesianState, driven: CartesianState
    ) -> CartesianState:
        error = hypot(found.x - driven.x, found.y - driven.y)
        if not error < _POSITION_TOLERANCE:
            called = "ego" if name == EGO else f"vehicle {name!r}"
            raise SimulationError(
                f"SUMO's {called} is {error:.2f} m from where it was driven to; "
                "the bridge is broken"
            )
        return driven

    def reported_contacts(self) -> list[str]:
        """Vehicles that SUMO itself says the ego touched in the last step."""
        pairs = [(c.collider, c.victim) for c in self._sumo.simulation.getCollisions()]
        return sorted({a if b == EGO else b for a, b in pairs if EGO in (a, b)})

    def vehicles(self) -> list[str]:
        """Ids of all vehicles on the road, the ego's excluded."""
        return [name for name in self._sumo.vehicle.getIDList() if name != EGO]

    def route(self, vehicle: str) -> tuple[str, ...]:
        """Edges of a vehicle's route."""
        return tuple(self._sumo.vehicle.getRoute(vehicle))

    def has_stop(self, vehicle: str) -> bool:
        """Tell whether a vehicle stands at a stop of its route, or has one before it."""
        return bool(self._sumo.vehicle.getStops(vehicle, 1))

    def distance_to_ego(self, vehicle: str) -> float:
        """Metres between a vehicle and the ego; infinite if it is not there."""
        if vehicle not in self._sumo.vehicle.getIDList():
            return inf
        ego, other = (self._sumo.vehicle.getPosition(name) for name in (EGO, vehicle))
        return hypot(ego[0] - other[0], ego[1] - other[1])

    def order_lane(self, vehicle: str, lane: int, seconds: float) -> None:
        """Let a human change to a lane when SUMO finds it safe, trying for so many seconds."""
        self._sumo.vehicle.changeLane(vehicle, lane, seconds)

    def order_sublane(self, vehicle: str, metres: float) -> None:
        """Let a human move aside by so much; left is positive."""
        self._sumo.vehicle.changeSublane(vehicle, metres)

    def order_speed_factor(self, vehicle: str, factor: float) -> None:
        """Give a human another desired speed, as a share of the limit."""
        self._sumo.vehicle.setSpeedFactor(vehicle, factor)

    def order_keep_lane(self, vehicle: str) -> None:
        """Switch off a vehicle's own lane changes."""
        self._sumo.vehicle.setLaneChangeMode(vehicle, 0)

    def _step(self) -> None:
        try:
            self._sumo.simulationStep()
        except Exception as error:
            # What stops SUMO is in the user's files: it meets a vehicle when that departs.
            at = float(self._sumo.simulation.getTime())
            why = str(error).rstrip(". ")
            raise StoppedError(f"SUMO stopped at {at:g} s: {why}; mend the demand") from None
        self._stepped = True

    def _size(self, name: str) -> tuple[float, float]:
        if name not in self._sizes:
            vehicle = self._sumo.vehicle
            size = (float(vehicle.getLength(name)), float(vehicle.getWidth(name)))
            if not all(value <= _LARGEST for value in size):  # NaN is not, either
                raise UserError(
                    f"vehicle {name!r} is {size[0]:g} m long and {size[1]:g} m wide; mend its type"
                )
            self._sizes[name] = size
        return self._sizes[name]

    @staticmethod
    def _centre(
        front: tuple[float, float], angle: float, speed: float, length: float
    ) -> CartesianState:
        heading = radians(90.0 - angle)
        if heading < -pi:
            heading += 2.0 * pi
        x = front[0] - length / 2 * cos(heading)
        y = front[1] - length / 2 * sin(heading)
        return CartesianState(x, y, heading, speed)
