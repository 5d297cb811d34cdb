"""Demand: read a scenario's route and additional files, and make of them those of one run.

SUMO's demand format: https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html
"""

from __future__ import annotations

import difflib
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from sumo_cohesion.errors import UserError
from sumo_cohesion.state import EGO
from sumo_cohesion.traffic.demand_files import AdditionalFile, Demand
from sumo_cohesion.traffic.library import vehicle_type_attributes
from sumo_cohesion.traffic.randomize import (
    Starts,
    randomize,
    refuse_what_cannot_vary,
    seconds,
    what_stays,
)
from sumo_cohesion.traffic.settings import EgoDemand, Randomization
from sumo_cohesion.traffic.vehicle_types import (
    DEFAULT_TYPE,
    VehicleTypes,
    as_built_in,
    is_built_in,
)

if TYPE_CHECKING:
    from sumo_cohesion.traffic.network import Network

_FASTEST = 200 / 3.6
"""SUMO's maxSpeed (m/s) of a car whose type says none: the ego's."""
_WITHOUT_SUBLANES = {"LC2013", "LC2013_CC", "DK2008"}
"""Lane change models that SUMO refuses as soon as there are sublanes."""


class CheckedDemand(NamedTuple):
    """The ego's route, and what there is to say about the demand, one line each."""

    route: list[str]
    notes: tuple[str, ...]


def check_demand(
    network: Network,
    demand: Demand,
    ego: EgoDemand,
    randomization: Randomization,
    fixed: Collection[str],
    named: Collection[str],
) -> CheckedDemand:
    """Check the demand against the network before SUMO sees either.

    ``fixed`` are vehicles that are not humans, ``named`` those that the scenario speaks of.
    """
    route = network.route(ego.origin, ego.destination)
    _check_ego(network, ego)
    _check_edges(network, demand)
    for element in demand.routes.iter():
        _require_finite(demand.source, element)
    _check_names(demand, named)
    _check_order(demand)
    starts = Starts(demand.roots(), network)
    refuse_what_cannot_vary(demand.routes, starts, ego, randomization, fixed)
    return CheckedDemand(route, tuple(what_stays(demand, starts, ego, randomization, fixed)))


def _check_ego(network: Network, ego: EgoDemand) -> None:
    n_lanes, length = network.n_lanes(ego.origin), network.edge_length(ego.origin)
    if ego.lane >= n_lanes:
        raise UserError(
            f"ego.lane = {ego.lane}, but edge {ego.origin!r} has lanes 0 to {n_lanes - 1}"
        )
    for_cars = network.lanes_for_cars(ego.origin)
    if ego.lane not in for_cars:
        raise UserError(
            f"ego.lane = {ego.lane}, which is not for cars on edge {ego.origin!r}; choose "
            + " or ".join(map(str, for_cars))
        )
    if ego.position > length:
        raise UserError(
            f"ego.position = {ego.position:g}, but edge {ego.origin!r} is {length:.1f} m long"
        )
    limit = min(network.speed_limit(ego.origin), _FASTEST)
    if ego.speed > limit + 0.01:  # as much as SUMO lets pass
        raise UserError(
            f"ego.speed = {ego.speed:g}, but SUMO starts no car on edge {ego.origin!r} faster than "
            f"{limit:.2f} m/s; choose at most that"
        )


def _check_edges(network: Network, demand: Demand) -> None:
    edges = set(network.edges())
    for element in demand.routes.iter():
        for edge in (element.get("edges") or "").split():
            if edge not in edges:
                raise UserError(
                    f"{demand.source}: a route uses edge {edge!r}, which {network.path.name} does "
                    "not have"
                )


def _check_names(demand: Demand, named: Collection[str]) -> None:
    ids: set[str] = set()
    flows: set[str] = set()
    for root in demand.roots():
        for element in root.iter():
            if element.tag in ("vehicle", "trip", "flow"):
                (flows if element.tag == "flow" else ids).add(element.get("id", ""))
    if EGO in ids:
        raise UserError(f"the demand has a vehicle {EGO!r}; the scenario's [ego] adds it")
    for name in sorted(named):
        if name in flows and name not in ids:
            raise UserError(
                f"the scenario names {name!r}, which is a flow; name its vehicles: "
                f"{name}.0, {name}.1 and so on"
            )
        if name not in ids and name.rpartition(".")[0] not in flows:
            raise UserError(f"the scenario names vehicle {name!r}, which no route file has")


def _check_order(demand: Demand) -> None:
    """Refuse additional files that speak of what the route files have: SUMO reads these later."""
    early = VehicleTypes(file.root for file in demand.additional)
    late = VehicleTypes([demand.routes])
    routes_early = {name for file in demand.additional for name in _routes_in(file.root)}
    routes_late = set(_routes_in(demand.routes))
    for file in demand.additional:
        for element in file.root.iter():
            kind, route = element.get("type", DEFAULT_TYPE), element.get("route")
            if element.tag == "routeProbReroute":
                route = element.get("id")
            elif element.tag not in ("vehicle", "trip", "flow"):
                continue
            wrong = [f"vehicle type {kind!r}"] if kind not in early and kind in late else []
            if route is not None and route not in routes_early and route in routes_late:
                wrong.append(f"route {route!r}")
            if wrong:
                raise UserError(
                    f"{file.path}: uses the {wrong[0]} of a route file, but SUMO reads additional "
                    f"files first; put the {wrong[0]} into an additional file"
                )


def _routes_in(root: ET.Element) -> Iterator[str]:
    for tag in ("route", "routeDistribution"):
        for element in root.iter(tag):
            yield element.get("id", "")


def _require_finite(source: str, element: ET.Element) -> None:
    """Reject nan and inf: SUMO takes them without a word and simulates nonsense."""
    for key, text in element.attrib.items():
        if key != "id" and _not_finite(text):
            raise UserError(
                f"{source}: {key} = {text!r} of {element.tag} {element.get('id', '')!r} is not "
                "a finite number"
            )


def _not_finite(text: str) -> bool:
    return text.strip().lower().lstrip("+-") in ("nan", "inf", "infinity")


def check_human_type(attributes: Mapping[str, float | str]) -> None:
    """Check names and numbers of vType attributes: SUMO ignores a misspelt one without a word."""
    known = vehicle_type_attributes() if attributes else ()
    for name, value in attributes.items():
        if known and name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise UserError(f"human_type: SUMO's vehicle types have no attribute {name!r}{hint}")
        if _not_finite(str(value)):
            raise UserError(f"human_type.{name} = {value} is not a finite number")


def build_demand(
    demand: Demand,
    network: Network,
    route: Sequence[str],
    ego: EgoDemand,
    randomization: Randomization,
    human_type: Mapping[str, float | str],
    fixed: Collection[str],
    seed: int,
) -> Demand:
    """Make the demand of one run: route files and the ego in one <routes>, varied by the seed.

    ``human_type`` are vType attributes for the types of all humans. ``fixed`` are vehicles that
    are not humans (stalled cars, an ambulance): always kept, their speed unchanged. What was
    read is used up. The same seed always gives the same demand.
    """
    changed = _set_human_type(demand, human_type, fixed) if human_type else set()
    _refuse_models_without_sublanes(demand)
    randomize(demand, Starts(demand.roots(), network), ego, randomization, fixed, seed)
    _add_ego(demand, route, ego)
    files = (
        AdditionalFile(file.path, file.root, file.root in changed) for file in demand.additional
    )
    return Demand(demand.routes, tuple(files))


def _kinds(root: ET.Element, but: Collection[str] = ()) -> set[str]:
    """Names of the types that vehicles, trips and flows have."""
    return {
        element.get("type", DEFAULT_TYPE)
        for element in root.iter()
        if element.tag in ("vehicle", "trip", "flow") and element.get("id") not in but
    }


def _set_human_type(
    demand: Demand, attributes: Mapping[str, float | str], fixed: Collection[str]
) -> set[ET.Element]:
    """Set attributes on every vehicle type that a human has; types of others stay as they are.

    Returns the roots below which something has changed.
    """
    types = VehicleTypes(demand.roots())
    kinds = {
        name
        for root in demand.roots()
        for kind in _kinds(root, fixed)
        for name, _ in types.choices(kind)
    }
    changed = set()
    for name in sorted(kinds):
        kind = types.written(name)
        if kind is None:
            if not is_built_in(name):
                raise UserError(
                    f"human_type: no route file or additional file has the vehicle type {name!r}"
                )
            kind = as_built_in(name)
            # Before anybody has it: SUMO takes it no later.
            having = (root for root in demand.roots() if name in _kinds(root))
            next(having, demand.roots()[0]).insert(0, kind)
        changed.add(kind)
        for key, value in attributes.items():
            kind.set(key, value if isinstance(value, str) else f"{value:.10g}")
    return {root for root in demand.roots() if not changed.isdisjoint(root.iter("vType"))}


def _refuse_models_without_sublanes(demand: Demand) -> None:
    types = VehicleTypes(demand.roots())
    used = {
        name for root in demand.roots() for kind in _kinds(root) for name, _ in types.choices(kind)
    }
    for name in sorted(used):
        kind = types.written(name)
        model = "" if kind is None else kind.get("laneChangeModel", "")
        if model in _WITHOUT_SUBLANES:
            raise UserError(
                f"vType {name!r}: laneChangeModel {model!r} knows no sublanes, and the sublane "
                "model is always on; make it SL2015"
            )


def _add_ego(demand: Demand, route: Sequence[str], ego: EgoDemand) -> None:
    """Add the ego and its type, and put all departures in the order of time that SUMO wants."""
    name = VehicleTypes(demand.roots()).free_name(EGO)
    kind = ET.Element(
        "vType",
        id=name,
        laneChangeModel="SL2015",
        length=f"{ego.length:g}",
        width=f"{ego.width:g}",
        speedDev="0",
        color="orange",
    )
    vehicle = ET.Element(
        "vehicle",
        id=EGO,
        type=name,
        depart=f"{ego.depart:g}",
        departLane=str(ego.lane),
        departPos=f"{ego.position:g}",
        departSpeed=f"{ego.speed:g}",
        insertionChecks="none",
    )
    ET.SubElement(vehicle, "route", edges=" ".join(route))
    elements = [kind, *demand.routes, vehicle]
    timed = [e for e in elements if e.get("depart") or e.get("begin")]
    untimed = [e for e in elements if not (e.get("depart") or e.get("begin"))]
    demand.routes[:] = [*untimed, *sorted(timed, key=_departure)]


def _departure(element: ET.Element) -> float:
    """Seconds; 0 for what is no time."""
    return seconds(element.get("depart") or element.get("begin")) or 0.0
