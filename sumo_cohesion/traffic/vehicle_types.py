"""SUMO's vehicle types: those of files, those of distributions, and those that are built in.

https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html
"""

from __future__ import annotations

import copy
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from math import inf, isfinite
from typing import NamedTuple

from sumo_cohesion.errors import UserError

DEFAULT_TYPE = "DEFAULT_VEHTYPE"
"""SUMO's type of a vehicle that names none."""
_BUILT_IN = {
    DEFAULT_TYPE: "passenger",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_CONTAINERTYPE": "container",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_RAILTYPE": "rail",
    "DEFAULT_TAXITYPE": "taxi",
}
"""The types that SUMO has before it reads any, and their classes."""
_UNEVEN = {"private", "vip", "pedestrian", "passenger", "hov", "motorcycle", "moped", "bicycle"}
_UNEVEN |= {"evehicle", "ship", "custom1", "custom2", "scooter", "wheelchair"}
"""Classes whose usual speedDev is 0.1; measured in SUMO 1.28, as are the next."""
_RATHER_EVEN = {"taxi", "coach", "delivery", "truck", "trailer"}
"""Classes whose usual speedDev is 0.05; that of all others is 0."""
_NORMAL = re.compile(r"(normc?)\(([^)]*)\)")
_STEPS = 20
"""Desired speeds that a flow's cars are spread over."""


class SpeedFactor(NamedTuple):
    """Desired speed over the limit: normal, drawn anew while it is not within [low, high]."""

    mean: float
    deviation: float
    low: float = 0.2
    high: float = 2.0

    def times(self, factor: float) -> SpeedFactor:
        """Scale it."""
        return SpeedFactor(*(factor * value for value in self))

    def written(self) -> str:
        """As SUMO reads it."""
        if not self.deviation:
            return f"norm({self.mean:.6f},0)"
        if self.high == inf:
            return f"norm({self.mean:.6f},{self.deviation:.6f})"
        return "normc({:.6f},{:.6f},{:.6f},{:.6f})".format(*self)


class VehicleTypes:
    """Types and distributions of types below some roots, by name."""

    def __init__(self, roots: Iterable[ET.Element]) -> None:
        self._types: dict[str, ET.Element] = {}
        self._distributions: dict[str, ET.Element] = {}
        for root in roots:
            for kind in root.iter("vType"):
                self._types[kind.get("id", "")] = kind
            for kind in root.iter("vTypeDistribution"):
                self._distributions[kind.get("id", "")] = kind

    def __contains__(self, name: str) -> bool:
        return name in self._types or name in self._distributions or name in _BUILT_IN

    def written(self, name: str) -> ET.Element | None:
        """Return the type of that name; None if no file has it."""
        return self._types.get(name)

    def vehicle_class(self, name: str) -> str:
        """SUMO's class (vClass) of a type; that of cars if nothing says otherwise."""
        kind = self._types.get(name, ET.Element("vType"))
        return kind.get("vClass", _BUILT_IN.get(name, "passenger"))

    def is_distribution(self, name: str) -> bool:
        """Tell whether a name is that of a distribution of types."""
        return name in self._distributions

    def choices(self, name: str, above: Sequence[str] = ()) -> list[tuple[str, float]]:
        """Types that a vehicle of this type or distribution can have; their weights add up to 1.

        ``above`` are distributions that this one is in.
        """
        distribution = self._distributions.get(name)
        if distribution is None or name in above:
            return [(name, 1.0)]
        members = [(kind.get("id", ""), kind) for kind in distribution.iter("vType")]
        weights = [_number(kind.get("probability"), 1.0) for _, kind in members]
        given = (distribution.get("probabilities") or "").split()
        for i, member in enumerate((distribution.get("vTypes") or "").split()):
            kind = self._types.get(member, ET.Element("vType"))
            members.append((member, kind))
            weights.append(_number(given[i] if i < len(given) else kind.get("probability"), 1.0))
        total = sum(weights) or 1.0
        return [
            (one, share * weight / total)
            for (member, _), weight in zip(members, weights, strict=True)
            for one, share in self.choices(member, (*above, name))
        ] or [(name, 1.0)]

    def speed_factor(self, name: str) -> SpeedFactor:
        """Distribution of the speed factor of a type, as SUMO has it.

        Raises
        ------
        UserError
            If it cannot be understood.
        """
        kind = self._types.get(name, ET.Element("vType"))
        vehicle_class = self.vehicle_class(name)
        mean, deviation = kind.get("speedFactor", "1.0"), kind.get("speedDev")
        try:
            factor = _parsed(mean, _usual_deviation(vehicle_class))
            if deviation is not None:
                factor = factor._replace(deviation=float(deviation))
        except ValueError:
            raise UserError(
                f"vType {name!r}: speedFactor {mean!r} with speedDev {deviation!r} cannot be "
                "combined with randomize.speed; write a number or normc(mean,dev,min,max)"
            ) from None
        return factor

    def at_paces(self, name: str, own: SpeedFactor | None, share: float, new: str) -> ET.Element:
        """Build a distribution called ``new``: this type, up to a share faster or slower.

        ``own`` is a speed factor that goes before that of the type.
        """
        distribution = ET.Element("vTypeDistribution", id=new)
        for member, weight in self.choices(name):
            factor = own or self.speed_factor(member)
            like = self._types[member] if member in self._types else as_built_in(member)
            for step in range(_STEPS):
                pace = 1.0 + share * ((2 * step + 1) / _STEPS - 1.0)
                kind = copy.deepcopy(like)
                kind.attrib.pop("speedDev", None)
                kind.set("id", f"{new}_{len(distribution)}")
                kind.set("speedFactor", factor.times(pace).written())
                kind.set("probability", f"{weight / _STEPS:.10g}")
                distribution.append(kind)
        return distribution

    def free_name(self, name: str) -> str:
        """Name of a new type: this one, or one like it that nothing has."""
        while name in self:
            name += "_"
        return name


def as_built_in(name: str) -> ET.Element:
    """Return one of SUMO's built-in types, to be written out."""
    if name == DEFAULT_TYPE:
        return ET.Element("vType", id=name)
    return ET.Element("vType", id=name, vClass=_BUILT_IN.get(name, "passenger"))


def is_built_in(name: str) -> bool:
    """Tell whether SUMO has a type before it reads any."""
    return name in _BUILT_IN


def _usual_deviation(vehicle_class: str) -> float:
    if vehicle_class in _UNEVEN:
        return 0.1
    return 0.05 if vehicle_class in _RATHER_EVEN else 0.0


def _parsed(text: str, deviation: float) -> SpeedFactor:
    """Read a speedFactor: a number, norm(mean,dev) or normc(mean,dev,min,max)."""
    normal = _NORMAL.fullmatch(text.replace(" ", ""))
    if normal is None:
        return SpeedFactor(_finite(text), deviation)
    name, inside = normal.groups()
    mean, *rest = (_finite(part) for part in inside.split(","))
    if len(rest) > 3:
        raise ValueError(text)
    bounds = (0.2, 2.0) if name == "normc" else (0.0, inf)
    return SpeedFactor(mean, *(rest or [0.0]), *bounds[max(len(rest) - 1, 0) :])


def _finite(text: str) -> float:
    number = float(text)
    if not isfinite(number):
        raise ValueError(text)
    return number


def _number(text: str | None, otherwise: float) -> float:
    try:
        return _finite(text or "")
    except ValueError:
        return otherwise
