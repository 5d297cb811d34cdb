"""The reward over the road: what the ego would earn if it were somewhere else (paper, figure 2)."""

from __future__ import annotations

import casadi as ca
import numpy as np

from sumo_cohesion.planning import reward
from sumo_cohesion.planning.problem import FAR_AWAY
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.road import Road
from sumo_cohesion.state import FloatArray, Observation

PLACES = ("car", "lane", "edge")
"""The reward terms that depend on where the ego is, in the paper's order."""


def reward_landscape(
    observation: Observation,
    road: Road,
    settings: PlannerSettings,
    s: FloatArray,
    d: FloatArray,
) -> dict[str, FloatArray]:
    """Weighted reward terms theta · phi at every place (s, d), the other cars as they stand.

    Parameters
    ----------
    observation : what the ego sees; all its cars count, not only the nearest.
    s, d : (S,) and (D,) places (m) in the road frame. The road's edges are those of the strip
        that the ego is on.

    Returns
    -------
    One array (D, S) for each of PLACES; higher is better.
    """
    lanes = road.lanes_at(s).T
    widths = road.lane_width[road.index(s)].T
    missing = np.isnan(lanes)
    right, left = road.drivable_at(s, np.full(s.shape, observation.ego.d))
    symbols = [ca.SX.sym(name) for name in ("s", "d", "right", "left")]
    lane, width = (ca.SX.sym(name, len(lanes)) for name in ("lanes", "widths"))
    cars = _cars(observation)
    relative = reward.in_frames(symbols[0], symbols[1], cars)
    inputs = reward.StageInputs(lane, width, symbols[2], symbols[3], 0.0, *relative, cars[5, :].T)
    state = (symbols[0], symbols[1], 0.0, 0.0)
    stays = (0.0, 0.0)
    at = reward.Point(state, stays, stays, inputs, observation.ego_size[1], settings.friction)
    terms = reward.terms(at, PLACES)
    weighted = [getattr(settings.reward, name) * terms[name] for name in PLACES]
    function = ca.Function("landscape", [*symbols, lane, width], weighted)
    # CasADi takes one column per place; s runs fastest.
    along = [np.tile(row, d.size)[None] for row in (s, right, left)]
    columns = (
        along[0],
        np.repeat(d, s.size)[None],
        *along[1:],
        np.tile(np.where(missing, FAR_AWAY, lanes), d.size),
        np.tile(np.where(missing, 1.0, widths), d.size),
    )
    values = function(*columns)
    return {
        name: np.asarray(value, dtype=float).reshape(d.size, s.size)
        for name, value in zip(PLACES, values, strict=True)
    }


def _cars(observation: Observation) -> ca.DM:
    """Columns as in reward.in_frames; without any car, one that is far away."""
    s, d, heading, _ = observation.states.T
    half_length, half_width = ((observation.sizes + observation.ego_size) / 2).T
    cars = np.array((s, d, np.cos(heading), np.sin(heading), half_length, half_width))
    return ca.DM(cars if cars.size else np.array([[FAR_AWAY, 0.0, 1.0, 0.0, 1.0, 1.0]]).T)
