"""How long and how wide vehicles of SUMO are, and whether they drive as cars, by their types.

SUMO's output names a vehicle's type and nothing else of it. Default sizes:
https://sumo.dlr.de/docs/Vehicle_Type_Parameter_Defaults.html
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from sumo_cohesion.errors import UserError
from sumo_cohesion.traffic.vehicle_types import VehicleTypes
from sumo_cohesion.traffic.xml_files import read_with_includes


class Kind(NamedTuple):
    """Length, width (m) of a vehicle, and whether it drives as cars do."""

    length: float
    width: float
    car: bool = False


CAR = Kind(5.0, 1.8, car=True)
"""What SUMO's passenger cars are, and what a vehicle of an unknown type is taken for."""
BY_CLASS = {
    "passenger": CAR,
    "private": CAR,
    "taxi": CAR,
    "hov": CAR,
    "evehicle": CAR,
    "vip": CAR,
    "custom1": CAR,
    "custom2": CAR,
    "delivery": Kind(6.5, 2.16, car=True),
    "emergency": Kind(6.5, 2.16),
    "authority": Kind(5.0, 1.8),
    "army": Kind(5.0, 1.8),
    "truck": Kind(7.1, 2.4),
    "trailer": Kind(16.5, 2.55),
    "bus": Kind(12.0, 2.5),
    "coach": Kind(14.0, 2.6),
    "motorcycle": Kind(2.2, 0.9),
    "moped": Kind(2.1, 0.78),
    "bicycle": Kind(1.6, 0.65),
    "scooter": Kind(1.2, 0.5),
    "wheelchair": Kind(1.2, 0.72),
    "pedestrian": Kind(0.215, 0.478),
    "tram": Kind(22.0, 2.4),
    "rail_urban": Kind(109.5, 3.0),
    "rail": Kind(135.0, 2.84),
    "rail_electric": Kind(200.0, 2.95),
    "rail_fast": Kind(200.0, 2.95),
    "subway": Kind(109.5, 3.0),
    "cable_car": CAR._replace(car=False),
    "ship": Kind(17.0, 4.0),
    "container": Kind(6.096, 2.438),
    "drone": Kind(0.5, 0.5),
    "aircraft": Kind(72.7, 79.8),
}
"""Default sizes by vClass, as measured in SUMO 1.28."""


def kinds_of(
    types: Iterable[str], demand: Sequence[Path] = ()
) -> tuple[dict[str, Kind], list[str]]:
    """Return the kind of each of some types, and what there is to say.

    ``demand`` are route and additional files in which the types are written.
    """
    written = VehicleTypes([read_with_includes(path) for path in demand])
    kinds: dict[str, Kind] = {}
    unknown = []
    for name in types:
        # A vehicle that was changed during the run has a copy of its type: truck@vehicle.
        known = next((n for n in (name, name.partition("@")[0]) if n in written), None)
        if known is None:
            unknown.append(name)
        kinds[name] = CAR if known is None else _kind(known, written)
    if not unknown:
        return kinds, []
    named = [name for name in unknown if name]
    shown = ", ".join(named[:3]) + (", …" if named[3:] else "")
    whose = f"vehicles of the types {shown}" if named else "its vehicles"
    return kinds, [
        f"it does not say how long {whose} are: taken for cars of {CAR.length:g} x {CAR.width:g} m "
        "(the route files that have the types would tell)"
    ]


def _kind(name: str, types: VehicleTypes) -> Kind:
    usual = BY_CLASS.get(types.vehicle_class(name), CAR._replace(car=False))
    element = types.written(name)
    sizes = []
    for attribute, value in (("length", usual.length), ("width", usual.width)):
        text = None if element is None else element.get(attribute)
        try:
            size = value if text is None else float(text)
        except ValueError:
            size = 0.0
        if not (isfinite(size) and size > 0.0):
            raise UserError(f"vType {name!r}: its {attribute} {text!r} is no size; mend it")
        sizes.append(size)
    return Kind(sizes[0], sizes[1], usual.car)
