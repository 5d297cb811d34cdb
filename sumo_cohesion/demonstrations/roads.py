"""The roads that vehicles drove along, and why others have none."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np
import pandas as pd

from sumo_cohesion.demonstrations.matching import Matcher, thinned
from sumo_cohesion.errors import UserError
from sumo_cohesion.road import Road
from sumo_cohesion.road_shape import NoRoadError
from sumo_cohesion.state import FloatArray
from sumo_cohesion.traffic.network import Network

FARTHEST = 20.0
"""Metres from every lane from which on a vehicle is not on the network."""
_STRIDE = 10.0
"""Metres between two positions that are looked for on a road."""

Edges = tuple[str, ...]


def roads_driven(
    table: pd.DataFrame,
    edges: Mapping[str, Sequence[str]],
    build: Callable[[Edges], Road],
    others: Mapping[str, str] | None = None,
) -> tuple[dict[str, Road], list[str]]:
    """Build the road of each vehicle, one for all that drove along the same edges.

    Parameters
    ----------
    table : a checked recording.
    edges : of each vehicle, in the order in which it passed them.
    build : makes the road along some edges, or raises NoRoadError.
    others : vehicles without a road, each with the reason, which goes on after "the vehicle".

    Returns
    -------
    The roads by vehicle, and for every reason why some have none one line.
    """
    known: dict[Edges, Road | str] = {}
    roads: dict[str, Road] = {}
    without: dict[str, list[str]] = defaultdict(list)
    for vehicle, points in ways(table).items():
        if others is not None and vehicle in others:
            without[others[vehicle]].append(vehicle)
            continue
        passed = tuple(edges.get(vehicle, ()))
        if passed not in known:
            known[passed] = _road(passed, build)
        road = known[passed]
        if isinstance(road, str):
            without[road].append(vehicle)
        elif not _follows(road, points):
            without["does not keep to the road along its edges"].append(vehicle)
        else:
            roads[vehicle] = road
    return roads, [_told(reason, names) for reason, names in without.items()]


def ways(table: pd.DataFrame) -> dict[str, FloatArray]:
    """Positions (n, 2) of each vehicle of a checked table, in the order of time."""
    points = table[["x", "y"]].to_numpy(dtype=float)
    return {
        str(v): points[rows] for v, rows in table.groupby("vehicle", sort=False).indices.items()
    }


def along_network(network: Network) -> Callable[[Edges], Road]:
    """Return what builds roads along edges of a network, the shortest way from each to the next."""
    bridges: dict[tuple[str, str], list[str]] = {}

    def build(passed: Edges) -> Road:
        route = [*passed[:1]]
        try:
            for pair in pairwise(passed):
                if pair not in bridges:
                    bridges[pair] = network.route(*pair)
                route += bridges[pair][1:]
            return network.road(route)
        except UserError as error:
            # Of messages to who chose a route only the reason is of interest here.
            reason = error.__cause__
            said = f"drove a way that {reason}" if isinstance(reason, NoRoadError) else f"({error})"
            raise NoRoadError(said) from None

    return build


def check_fit(points: FloatArray, network: Network, name: str) -> Matcher:
    """Return the network's edges to match, if most of some points (n, 2) are on one of them.

    Raises
    ------
    UserError
        If they are not.
    """
    edges = network.for_cars()
    if not edges:
        raise UserError(f"{network.path}: has no lanes for cars; give another network")
    matcher = Matcher(edges)
    off = matcher.away(points) > FARTHEST
    if 2 * int(off.sum()) > len(points):
        raise UserError(
            f"{name}: most of it is farther than {FARTHEST:g} m from every lane for cars of "
            f"{network.path}; give the network that was driven on, and positions in its own "
            "coordinates (SUMO: without --fcd-output.geo and --fcd-output.utm)"
        )
    return matcher


def _road(passed: Edges, build: Callable[[Edges], Road]) -> Road | str:
    """Build the road along some edges; or say why there is none."""
    if not passed:
        return "was on no lane for cars"
    try:
        road = build(passed)
    except NoRoadError as error:
        return str(error)
    except Exception as error:
        # Lanes that make no sense cause whatever they happen to.
        return f"drove along lanes that make no road ({type(error).__name__}: {error})"
    # Where a road meets itself, a place beside it can be in two places along it.
    if road.returns(0.0, road.length) is not None:
        return "drove a way that comes back to where it was"
    return road


def _follows(road: Road, points: FloatArray) -> bool:
    """Tell whether a way goes along a road, without leaps along it that it did not make."""
    places = points[thinned(points, _STRIDE)]
    driven, _ = road.to_frenet(np.column_stack((places, np.zeros((len(places), 2)))))
    along = np.diff(driven[:, 0])
    moved = np.hypot(*np.diff(places, axis=0).T)
    # In a bend the way along the road's line is not as long as the way beside it.
    astray = np.abs(along - moved) > 0.5 * moved + _STRIDE
    return not astray.any() and bool((np.abs(driven[:, 1]) <= FARTHEST).mean() > 0.5)


def _told(reason: str, names: Sequence[str]) -> str:
    shown = ", ".join(names[:3]) + (", …" if names[3:] else "")
    do = "vehicle does" if len(names) == 1 else "vehicles do"
    return f"{len(names)} {do} not demonstrate ({shown}): {reason}"
