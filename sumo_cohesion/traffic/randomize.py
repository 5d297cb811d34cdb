"""What a seed varies in the demand: where cars start, how fast they want to be, how many."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import islice
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from sumo_cohesion.errors import UserError
from sumo_cohesion.traffic.vehicle_types import DEFAULT_TYPE, SpeedFactor, VehicleTypes

if TYPE_CHECKING:
    from sumo_cohesion.traffic.demand_files import Demand
    from sumo_cohesion.traffic.network import Network
    from sumo_cohesion.traffic.settings import EgoDemand, Randomization

_SAME_TIME = 1.0
"""Seconds around the ego's departure in which those depart that start ahead of it."""
_DRAWS = 1000
"""How often a speed factor is drawn anew until it is within its bounds."""


def number(text: str | None) -> float | None:
    """Return a finite number, or None for any other text."""
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if isfinite(value) else None


def seconds(text: str | None) -> float | None:
    """Return a time (s), which SUMO also takes as [days:]hours:minutes:seconds; or None."""
    parts = [number(part) for part in (text or "").split(":")]
    if len(parts) not in (1, 3, 4):
        return None
    units = (1.0, 60.0, 3600.0, 86_400.0)
    total = 0.0
    for part, unit in zip(reversed(parts), units, strict=False):
        if part is None:
            return None
        total += part * unit
    return total


class Starts:
    """Where vehicles start, as far as the files say it."""

    def __init__(self, roots: Iterable[ET.Element], network: Network) -> None:
        self._network = network
        self._lengths: dict[str, float] = {}
        self._routes: dict[str, list[list[str]]] = {}
        for root in roots:
            for route in root.iter("route"):
                if route.get("id") is not None:
                    self._routes[route.get("id", "")] = [_edges(route)]
            for several in root.iter("routeDistribution"):
                if several.get("id") is not None:
                    self._routes[several.get("id", "")] = list(self._of(several))

    def _of(self, distribution: ET.Element) -> Iterator[list[str]]:
        for name in (distribution.get("routes") or "").split():
            yield from self._routes.get(name, [[]])
        for route in distribution.iter("route"):
            yield from [_edges(route)] if route.get("edges") else self._by_name(route.get("refId"))

    def _by_name(self, name: str | None) -> list[list[str]]:
        return self._routes.get(name or "", [[]])

    def edge(self, vehicle: ET.Element) -> str | None:
        """Edge that a vehicle, trip or flow starts on; None if SUMO chooses it."""
        if vehicle.get("from") is not None:
            return vehicle.get("from")
        at = vehicle.get("departEdge", "0")
        if not at.isdecimal():
            return None
        if vehicle.get("route") is not None:
            routes = self._by_name(vehicle.get("route"))
        else:
            inside = vehicle.find("routeDistribution")
            routes = list(self._of(vehicle if inside is None else inside))
        found = {route[int(at)] if int(at) < len(route) else None for route in routes}
        return found.pop() if len(found) == 1 else None

    def length(self, edge: str | None) -> float | None:
        """Length (m) of an edge; None if the edge is not known."""
        if edge is None:
            return None
        if edge not in self._lengths:
            self._lengths[edge] = self._network.edge_length(edge)
        return self._lengths[edge]

    def position(self, vehicle: ET.Element) -> float | None:
        """Metres from the start of its edge; None if SUMO chooses the place or its edge."""
        at, length = number(vehicle.get("departPos")), self.length(self.edge(vehicle))
        if at is None or at >= 0.0:
            return at
        return None if length is None else max(at + length, 0.0)

    def move(self, vehicle: ET.Element, metres: float) -> None:
        """Move a vehicle's departure along its edge, and the stops it makes there, never off it."""
        at = number(vehicle.get("departPos"))
        if metres == 0.0 or at is None:
            return
        edge = self.edge(vehicle)
        length, stops = self.length(edge), self._stops(vehicle, edge)
        offset = length or 0.0
        if at < 0.0 and length is None:  # from the end of we do not know what
            metres = min(metres, -0.001 - at)
        else:
            at += offset if at < 0.0 else 0.0
            places = [at, *(place + (offset if place < 0.0 else 0.0) for *_, place in stops)]
            metres = max(metres, -min(places))
            if length is not None:
                metres = min(metres, max(length - max(places), 0.0))
        vehicle.set("departPos", f"{at + metres:.3f}")
        for stop, key, place in stops:
            stop.set(key, f"{place + metres + (offset if place < 0.0 else 0.0):.3f}")

    @staticmethod
    def _stops(vehicle: ET.Element, edge: str | None) -> list[tuple[ET.Element, str, float]]:
        """Where a vehicle stops on an edge: the stop, which end of it, and its place."""
        found = []
        for stop in vehicle.iter("stop"):
            on = stop.get("edge") or stop.get("lane", "").rpartition("_")[0]
            for key in ("startPos", "endPos"):
                place = number(stop.get(key))
                if place is not None and (edge is None or on == edge):
                    found.append((stop, key, place))
        return found


def _edges(element: ET.Element) -> list[str]:
    return (element.get("edges") or "").split()


def cars_of(routes: ET.Element) -> list[ET.Element]:
    """Vehicles and trips of the route files, in file order: those of which each is one car."""
    return [element for element in routes if element.tag in ("vehicle", "trip")]


def leads(humans: Iterable[ET.Element], starts: Starts, ego: EgoDemand) -> list[ET.Element]:
    """Humans that start with the ego, ahead of it in its lane, nearest first."""
    ahead = []
    for vehicle in humans:
        if vehicle.get("departLane") == str(ego.lane) and _with_the_ego(vehicle, starts, ego):
            at = starts.position(vehicle)
            if at is not None and at > ego.position:
                ahead.append((at, vehicle))
    return [vehicle for _, vehicle in sorted(ahead, key=lambda found: found[0])]


def _with_the_ego(vehicle: ET.Element, starts: Starts, ego: EgoDemand) -> bool:
    time = seconds(vehicle.get("depart"))
    if time is None or abs(time - ego.depart) > _SAME_TIME:
        return False
    return starts.edge(vehicle) == ego.origin


def randomize(
    demand: Demand,
    starts: Starts,
    ego: EgoDemand,
    randomization: Randomization,
    fixed: Collection[str],
    seed: int,
) -> None:
    """Vary the cars of a demand's route files; the same seed always does the same."""
    routes = demand.routes
    types = VehicleTypes(demand.roots())
    rng = np.random.default_rng(seed)
    others = cars_of(routes)
    humans = [v for v in others if v.get("id") not in fixed]
    # Draws are made for every vehicle, kept or not, so that one setting does not shift another's.
    shift = rng.uniform(-1.0, 1.0, len(others)) * randomization.position
    pace = 1.0 + rng.uniform(-1.0, 1.0, len(others)) * randomization.speed
    temper = rng.standard_normal(len(others))
    spacing = randomization.lead_spacing
    gaps = rng.uniform(*spacing, len(others)) if spacing else np.zeros(len(others))
    count = (
        rng.integers(randomization.humans[0], randomization.humans[1] + 1)
        if randomization.humans
        else len(humans)
    )
    choice = rng.random(len(others))

    ahead = leads(humans[: int(count)], starts, ego) if spacing else []
    spaced, human = set(ahead), set(humans)
    for i, vehicle in enumerate(others):
        if vehicle not in spaced:
            starts.move(vehicle, float(shift[i]))
        if vehicle in human and randomization.speed:
            own = _speed_factor(vehicle, types, float(temper[i]), float(choice[i]), (seed, i))
            vehicle.set("speedFactor", f"{own * float(pace[i]):.6f}")
    for vehicle, position in zip(ahead, ego.position + np.cumsum(gaps), strict=False):
        at = starts.position(vehicle)
        if at is not None:
            starts.move(vehicle, float(position) - at)
    left_out = set(humans[int(count) :])
    routes[:] = [element for element in routes if element not in left_out]
    if randomization.speed:
        _vary_flows(routes, types, randomization.speed)


def _speed_factor(
    vehicle: ET.Element,
    types: VehicleTypes,
    normal: float,
    choice: float,
    again: tuple[int, int],
) -> float:
    """Desired speed over the limit: the vehicle's own, or drawn from its type as SUMO would.

    A vehicle of a distribution gets one of its types, as SUMO would give it one.
    """
    name = vehicle.get("type", DEFAULT_TYPE)
    if types.is_distribution(name):
        names, weights = zip(*types.choices(name), strict=True)
        upper = np.cumsum(weights)
        name = names[int(np.searchsorted(upper[:-1], choice * upper[-1], side="right"))]
        vehicle.set("type", name)
    own = number(vehicle.get("speedFactor"))
    return own if own is not None else _drawn(types.speed_factor(name), normal, again)


def _drawn(factor: SpeedFactor, normal: float, again: tuple[int, int]) -> float:
    """One speed factor, drawn anew (seed: ``again``) while it is out of bounds, as in SUMO."""
    drawn = factor.mean + factor.deviation * normal
    if factor.low <= drawn <= factor.high:
        return drawn
    tries = factor.mean + factor.deviation * np.random.default_rng(again).standard_normal(_DRAWS)
    within = tries[(factor.low <= tries) & (tries <= factor.high)]
    return float(within[0]) if within.size else min(max(drawn, factor.low), factor.high)


def _vary_flows(routes: ET.Element, types: VehicleTypes, share: float) -> None:
    """Give flows types of their own, of which SUMO draws one for each car."""
    made: dict[tuple[str, float | None], str] = {}
    for flow in list(routes.iter("flow")):  # as they are now: types will be added
        name, own = flow.get("type", DEFAULT_TYPE), number(flow.attrib.pop("speedFactor", None))
        if (name, own) not in made:
            made[name, own] = new = types.free_name(f"{name}_at_paces_{len(made)}")
            alone = None if own is None else SpeedFactor(own, 0.0)
            routes.insert(0, types.at_paces(name, alone, share, new))
        flow.set("type", made[name, own])


def refuse_what_cannot_vary(
    routes: ET.Element,
    starts: Starts,
    ego: EgoDemand,
    randomization: Randomization,
    fixed: Collection[str],
) -> None:
    """Raise UserError if a seed is to vary what only SUMO decides, or what does not fit."""
    for holder in (routes, *routes.iter("interval")):
        for flow in holder.findall("flow"):
            times = [flow.get(key, holder.get(key)) for key in ("begin", "end")]
            _refuse_flow(flow, times, starts, ego, randomization, fixed)
    if randomization.lead_spacing:
        humans = [v for v in cars_of(routes) if v.get("id") not in fixed]
        ahead = leads(_at_most(humans, randomization), starts, ego)
        reach = ego.position + len(ahead) * randomization.lead_spacing[1]
        length = starts.length(ego.origin)
        if length is not None and reach > length:
            raise UserError(
                f"randomize.lead_spacing: {len(ahead)} cars at up to "
                f"{randomization.lead_spacing[1]:g} m reach {reach:.0f} m, but edge "
                f"{ego.origin!r} is {length:.1f} m long; choose less, or another ego.position"
            )


def _at_most(humans: Sequence[ET.Element], randomization: Randomization) -> Iterator[ET.Element]:
    return islice(humans, randomization.humans[1] if randomization.humans else None)


def _refuse_flow(
    flow: ET.Element,
    times: Sequence[str | None],
    starts: Starts,
    ego: EgoDemand,
    randomization: Randomization,
    fixed: Collection[str],
) -> None:
    name, at = flow.get("id", ""), starts.position(flow)
    instead = "write its cars as <vehicle> or <trip>"
    if randomization.humans:
        raise UserError(
            f"randomize.humans counts cars, and how many the flow {name!r} has only SUMO knows; "
            f"{instead}, or leave randomize.humans out"
        )
    if randomization.position and number(flow.get("departPos")) is not None:
        raise UserError(
            f"randomize.position: all cars of the flow {name!r} start at one departPos, "
            f'{flow.get("departPos")}; {instead}, or give the flow departPos="random"'
        )
    if randomization.speed and any(car.rpartition(".")[0] == name for car in fixed):
        raise UserError(
            f"randomize.speed: the flow {name!r} has a hidden or special car, whose speed stays as "
            "it is; write that car as a <vehicle>"
        )
    in_lane = flow.get("departLane") == str(ego.lane) and starts.edge(flow) == ego.origin
    if randomization.lead_spacing and in_lane and at is not None and at > ego.position:
        begin, end = seconds(times[0]) or 0.0, seconds(times[1])
        if begin <= ego.depart + _SAME_TIME and (end is None or end >= ego.depart - _SAME_TIME):
            raise UserError(
                f"randomize.lead_spacing: the flow {name!r} starts ahead of the ego in its lane, "
                f"all its cars at departPos {flow.get('departPos')}; {instead}"
            )


def what_stays(
    demand: Demand,
    starts: Starts,
    ego: EgoDemand,
    randomization: Randomization,
    fixed: Collection[str],
) -> Iterator[str]:
    """Say what a seed does not vary though the scenario may seem to ask for it."""
    routes = demand.routes
    cars = cars_of(routes)
    humans = [v for v in cars if v.get("id") not in fixed]
    if randomization.position:
        placed = [*cars, *routes.iter("flow")]
        yield from _several(
            "randomize.position leaves {} where SUMO puts it, its departPos is no number",
            [v for v in placed if number(v.get("departPos")) is None],
        )
    if randomization.lead_spacing:
        if not leads(humans, starts, ego):
            yield (
                "randomize.lead_spacing moves nobody: no human starts ahead of the ego on edge "
                f"{ego.origin!r} with departLane {ego.lane} at the time {ego.depart:g} s"
            )
        yield from _several(
            "randomize.lead_spacing leaves {} where it is, its departLane is no number",
            [
                v
                for v in humans
                if number(v.get("departLane")) is None
                and _with_the_ego(v, starts, ego)
                and (starts.position(v) or 0.0) > ego.position
            ],
        )
    if randomization.humans and randomization.humans[1] > len(humans):
        yield (
            f"randomize.humans asks for up to {randomization.humans[1]}, and the route files have "
            f"{len(humans)}"
        )
    if randomization.varies:
        for file in demand.additional:
            tags = ("vehicle", "trip", "flow")
            found = [element for element in file.root.iter() if element.tag in tags]
            where = f"randomize leaves {{}} as it is: it is in {file.path.name}, no route file"
            yield from _several(where, found)


def _several(note: str, elements: Sequence[ET.Element]) -> Iterator[str]:
    """One note about the first of some elements, which tells how many there are."""
    if elements:
        first = f"{elements[0].tag} {elements[0].get('id', '')!r}"
        others = len(elements) - 1
        yield note.format(first + (f" (and {others} others)" if others else ""))
