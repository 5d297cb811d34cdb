"""Demand: write the route file of one run, with what its seed varies.

SUMO's demand format: https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html
"""

from __future__ import annotations

import difflib
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from sumo_cohesion.errors import UserError
from sumo_cohesion.state import EGO
from sumo_cohesion.traffic.library import vehicle_type_attributes
from sumo_cohesion.traffic.network import Network, check_xml

DEMAND_FILE = "demand.rou.xml"
_DEFAULT_TYPE = "DEFAULT_VEHTYPE"
"""SUMO's type of a vehicle that names none."""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class EgoDemand(BaseModel):
    """Where the ego starts and where it goes.

    ``position`` (m) and ``lane`` follow SUMO: front bumper from the start of the edge, lanes
    counted from the right. ``depart`` (s) leaves other traffic time to form.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    origin: str
    destination: str
    lane: Annotated[int, Field(ge=0)]
    position: NonNegative
    speed: NonNegative
    depart: Annotated[float, Field(ge=0, le=604_800)] = 0.0  # a week, most of it empty steps
    length: Positive = 5.0
    width: Positive = 1.8


class Randomization(BaseModel):
    """What a seed varies, besides SUMO's own random numbers.

    Attributes
    ----------
    lead_spacing : [low, high] (m) between the fronts of consecutive cars ahead of the ego in
        its lane, each gap drawn anew; the first gap is the ego's own.
    position : every other vehicle starts up to so many metres before or after its place.
    speed : every human's desired speed changes by up to this share, on top of the speedDev of
        its type (SUMO itself would ignore speedDev once a vehicle has a speedFactor).
    humans : [fewest, most] human cars; the first so many of the route files are kept.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    lead_spacing: tuple[Positive, Positive] | None = None
    position: NonNegative = 0.0
    speed: Annotated[float, Field(ge=0, lt=1)] = 0.0
    humans: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Randomization:
        for name in ("lead_spacing", "humans"):
            pair = getattr(self, name)
            if pair is not None and pair[0] > pair[1]:
                raise ValueError(f"{name} must be [low, high] with low <= high, not {list(pair)}")
        return self


def check_demand(
    network: Network, route_files: Sequence[Path], ego: EgoDemand, named: Collection[str]
) -> list[str]:
    """Check the demand against the network before SUMO sees either.

    Returns the ego's route. ``named`` are vehicle ids that the scenario speaks of.
    """
    route = network.route(ego.origin, ego.destination)
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
    edges = set(network.edges())
    ids: set[str] = set()
    flows: set[str] = set()
    for path in route_files:
        for element in check_xml(path, "routes").iter():
            if element.tag == "route" or element.get("edges") is not None:
                for edge in (element.get("edges") or "").split():
                    if edge not in edges:
                        raise UserError(
                            f"{path}: a route uses edge {edge!r}, which {network.path.name} "
                            "does not have"
                        )
            if element.tag in ("vehicle", "trip", "flow"):
                (flows if element.tag == "flow" else ids).add(element.get("id", ""))
            _require_finite(path, element)
    if EGO in ids:
        raise UserError(f"a route file has a vehicle {EGO!r}; the scenario's [ego] adds it")
    for name in sorted(named):
        if name in flows and name not in ids:
            raise UserError(
                f"the scenario names {name!r}, which is a flow; name its vehicles: "
                f"{name}.0, {name}.1 and so on"
            )
        if name not in ids and name.rpartition(".")[0] not in flows:
            raise UserError(f"the scenario names vehicle {name!r}, which no route file has")
    return route


def _require_finite(path: Path, element: ET.Element) -> None:
    """Reject nan and inf: SUMO takes them without a word and simulates nonsense."""
    for key, text in element.attrib.items():
        if key != "id" and _not_finite(text):
            raise UserError(
                f"{path}: {key} = {text!r} of {element.tag} {element.get('id', '')!r} is not a "
                "finite number"
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
    route_files: Sequence[Path],
    route: Sequence[str],
    ego: EgoDemand,
    randomization: Randomization,
    human_type: Mapping[str, float | str],
    fixed: Collection[str],
    seed: int,
) -> ET.Element:
    """Merge route files and the ego into one <routes>, varied by the seed.

    ``human_type`` are vType attributes for the types of all humans. ``fixed`` are vehicles that
    are not humans (stalled cars, an ambulance): always kept, their speed unchanged. The same
    seed always gives the same demand.
    """
    merged = ET.Element("routes")
    for path in route_files:
        merged.extend(check_xml(path, "routes"))
    if human_type:
        _set_human_type(merged, human_type, fixed)
    rng = np.random.default_rng(seed)
    others = [v for v in merged if v.tag == "vehicle"]
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

    leads = _leads(humans, ego) if spacing else []
    types = {t.get("id"): t for t in merged.iter("vType")}
    for vehicle, metres, factor, normal in zip(others, shift, pace, temper, strict=True):
        if vehicle not in leads:
            _shift_along(vehicle, float(metres))
        if vehicle in humans and randomization.speed:
            own = _speed_factor(vehicle, types, float(normal))
            vehicle.set("speedFactor", f"{own * float(factor):.6f}")
    for vehicle, position in zip(leads, ego.position + np.cumsum(gaps), strict=False):
        _shift_along(vehicle, float(position) - float(vehicle.get("departPos", 0.0)))
    for vehicle in humans[int(count) :]:
        merged.remove(vehicle)
    _add_ego(merged, route, ego)
    return merged


def write_demand(demand: ET.Element, folder: Path) -> Path:
    """Write a demand built by build_demand and return the file's path."""
    path = folder / DEMAND_FILE
    ET.indent(demand)
    ET.ElementTree(demand).write(path, encoding="UTF-8", xml_declaration=True)
    return path


def _set_human_type(
    routes: ET.Element, attributes: Mapping[str, float | str], fixed: Collection[str]
) -> None:
    """Set attributes on every vehicle type that a human has; types of others stay as they are."""
    kinds = {
        v.get("type", _DEFAULT_TYPE)
        for v in routes
        if v.tag in ("vehicle", "trip", "flow") and v.get("id") not in fixed
    }
    for distribution in routes.iter("vTypeDistribution"):
        if distribution.get("id") in kinds:
            kinds.discard(distribution.get("id", ""))
            kinds |= set((distribution.get("vTypes") or "").split())
            kinds |= {kind.get("id", "") for kind in distribution.iter("vType")}
    types = {kind.get("id", ""): kind for kind in routes.iter("vType")}
    for name in sorted(kinds):
        if name == _DEFAULT_TYPE and name not in types:
            types[name] = ET.Element("vType", id=name)
            routes.insert(0, types[name])
        if name not in types:
            raise UserError(f"human_type: no route file has the vehicle type {name!r}")
        for key, value in attributes.items():
            types[name].set(key, value if isinstance(value, str) else f"{value:.10g}")


def _leads(humans: Sequence[ET.Element], ego: EgoDemand) -> list[ET.Element]:
    """Humans that start ahead of the ego in its lane, nearest first."""

    def position(vehicle: ET.Element) -> float:
        return float(vehicle.get("departPos", "nan"))

    ahead = [
        v
        for v in humans
        if v.get("departLane") == str(ego.lane)
        and _numeric(v.get("departPos"))
        and position(v) > ego.position
    ]
    return sorted(ahead, key=position)


def _numeric(text: str | None) -> bool:
    try:
        return isfinite(float(text or ""))
    except ValueError:
        return False


def _speed_factor(vehicle: ET.Element, types: dict[str | None, ET.Element], normal: float) -> float:
    """Desired speed over the limit: the vehicle's own, or drawn from its type as SUMO would.

    SUMO draws from a normal distribution cut off at 0.2 and 2 (its defaults for cars).
    """
    if _numeric(vehicle.get("speedFactor")):
        return float(vehicle.get("speedFactor", 1.0))
    kind = types.get(vehicle.get("type"), ET.Element("vType"))
    mean, deviation = kind.get("speedFactor", "1.0"), kind.get("speedDev", "0.1")
    if not (_numeric(mean) and _numeric(deviation)):
        raise UserError(
            f"vType {kind.get('id')!r}: speedFactor {mean!r} with speedDev {deviation!r} cannot be "
            "combined with randomize.speed; give plain numbers"
        )
    return min(max(float(mean) + float(deviation) * normal, 0.2), 2.0)


def _shift_along(vehicle: ET.Element, metres: float) -> None:
    """Move a vehicle's departure, and the stop it stands at, along its lane."""
    if metres == 0.0 or not _numeric(vehicle.get("departPos")):
        return
    at = max(float(vehicle.get("departPos", 0.0)) + metres, 0.0)
    vehicle.set("departPos", f"{at:.3f}")
    for stop in vehicle.iter("stop"):
        for key in ("startPos", "endPos"):
            if _numeric(stop.get(key)):
                stop.set(key, f"{float(stop.get(key, 0.0)) + metres:.3f}")


def _add_ego(routes: ET.Element, route: Sequence[str], ego: EgoDemand) -> None:
    kind = ET.Element(
        "vType",
        id=EGO,
        laneChangeModel="SL2015",
        length=f"{ego.length:g}",
        width=f"{ego.width:g}",
        speedDev="0",
        color="orange",
    )
    routes.insert(0, kind)
    vehicle = ET.SubElement(
        routes,
        "vehicle",
        id=EGO,
        type=EGO,
        depart=f"{ego.depart:g}",
        departLane=str(ego.lane),
        departPos=f"{ego.position:g}",
        departSpeed=f"{ego.speed:g}",
        insertionChecks="none",
    )
    ET.SubElement(vehicle, "route", edges=" ".join(route))
    # SUMO wants departures in order of time.
    timed = [e for e in routes if e.get("depart") or e.get("begin")]
    for element in timed:
        routes.remove(element)
    routes.extend(sorted(timed, key=_departure))


def _departure(element: ET.Element) -> float:
    """Seconds, which SUMO also takes as [days:]hours:minutes:seconds; 0 for what is no time."""
    text = element.get("depart") or element.get("begin") or "0"
    parts = text.split(":")
    if len(parts) not in (1, 3, 4) or not all(map(_numeric, parts)):
        return 0.0
    units = (1.0, 60.0, 3600.0, 86_400.0)
    return sum(float(part) * unit for part, unit in zip(reversed(parts), units, strict=False))
