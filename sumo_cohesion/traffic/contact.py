"""Contact between cars: the truth about collisions.

SUMO's own report misses an ego that reaches into a neighbouring lane while its centre is still
in its own, so contact is decided here and SUMO's report is kept beside it.
"""

from __future__ import annotations

import numpy as np

from sumo_cohesion.state import CartesianState, FloatArray, IntArray


def contacts(
    ego: CartesianState, ego_size: tuple[float, float], states: FloatArray, sizes: FloatArray
) -> IntArray:
    """Find which vehicles' boxes overlap the ego's box.

    Separating axis test for oriented rectangles (Gottschalk, Lin, Manocha 1996, OBBTree): two
    rectangles are apart if and only if their projections on one of the four side directions are.

    Parameters
    ----------
    ego : Cartesian state of the ego's centre (m, rad).
    ego_size : length, width (m).
    states : (n, 4) x, y, heading, speed of the others' centres, same frame.
    sizes : (n, 2) length, width (m).

    Returns
    -------
    Indices of the vehicles in contact, ascending.

    >>> row = np.array([[4.9, 0.0, 0.0, 0.0], [5.1, 0.0, 0.0, 0.0]])
    >>> contacts(CartesianState(0.0, 0.0, 0.0, 0.0), (5.0, 1.8), row, np.full((2, 2), [5.0, 1.8]))
    array([0])
    """
    reach = (np.hypot(*ego_size) + np.hypot(sizes[:, 0], sizes[:, 1])) / 2
    offset = states[:, :2] - (ego.x, ego.y)
    near = np.flatnonzero(offset[:, 0] ** 2 + offset[:, 1] ** 2 < reach**2)
    if near.size == 0:
        return near
    dx, dy = offset[near].T
    half_length, half_width = sizes[near].T / 2
    ego_length, ego_width = ego_size[0] / 2, ego_size[1] / 2
    cos_e, sin_e = np.cos(ego.heading), np.sin(ego.heading)
    cos_o, sin_o = np.cos(states[near, 2]), np.sin(states[near, 2])
    cos_r = np.abs(cos_e * cos_o + sin_e * sin_o)
    sin_r = np.abs(cos_e * sin_o - sin_e * cos_o)
    apart = (
        (np.abs(dx * cos_e + dy * sin_e) >= ego_length + half_length * cos_r + half_width * sin_r)
        | (np.abs(dy * cos_e - dx * sin_e) >= ego_width + half_length * sin_r + half_width * cos_r)
        | (np.abs(dx * cos_o + dy * sin_o) >= half_length + ego_length * cos_r + ego_width * sin_r)
        | (np.abs(dy * cos_o - dx * sin_o) >= half_width + ego_length * sin_r + ego_width * cos_r)
    )
    return np.asarray(near[~apart])
