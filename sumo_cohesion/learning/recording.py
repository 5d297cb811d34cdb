"""Driving as it was recorded: who was where, and along which road."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from sumo_cohesion.road import Road

COLUMNS = ("time", "vehicle", "x", "y", "length", "width")
"""What a recording's table must have, in this order."""


@dataclass(frozen=True)
class Recording:
    """Vehicles that drove together.

    Attributes
    ----------
    name : of the run or file, for messages and tables.
    table : one row per time and vehicle, by vehicle and then by time: time (s), vehicle, x, y (m,
        its centre), length, width (m). Times of a vehicle may be apart (it was out of sight).
    roads : the road that each vehicle drove along, in the table's coordinates. Only vehicles that
        have one demonstrate; all others are merely driven around.
    interval : seconds between two rows of a vehicle.
    notes : what there is to say about it, one line each.
    """

    name: str
    table: pd.DataFrame
    roads: Mapping[str, Road]
    interval: float
    notes: tuple[str, ...] = ()
