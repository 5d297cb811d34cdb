"""What every recording's table has to be, whatever file it came from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.recording import COLUMNS
from sumo_cohesion.state import BoolArray, FloatArray
from sumo_cohesion.traffic.network_check import FARTHEST

SHORTEST, LONGEST = 0.02, 0.2
"""Seconds between two rows of a vehicle: what controls of STEP (state.py) can be made of."""
_UNEVEN = 0.1
"""Share of the interval by which a time may be off."""


def checked(table: pd.DataFrame, name: str) -> tuple[pd.DataFrame, float]:
    """Check a table with COLUMNS, and sort it by vehicle and then by time.

    Gaps are allowed: a vehicle may be out of sight for a while.

    Parameters
    ----------
    table : its index is what a message calls a row by, counted from one.
    name : of the file, for messages.

    Returns
    -------
    The table, with COLUMNS in their order, and the seconds between two rows of a vehicle.

    Raises
    ------
    UserError
        If there are no rows, a number is not finite, an id is empty, two rows are of one vehicle
        at one time, or the times are not evenly, or not suitably, spaced.
    """
    if table.empty:
        raise UserError(f"{name}: holds no vehicles; write it again")
    numbers = [column for column in COLUMNS if column != "vehicle"]
    frame = pd.DataFrame({column: _as_floats(table[column]) for column in numbers})
    for column in numbers:
        _refuse(~np.isfinite(frame[column].to_numpy()), table, column, "is not a number", name)
    for column in ("x", "y"):
        far = np.abs(frame[column].to_numpy()) > FARTHEST
        _refuse(far, table, column, "is nowhere on Earth", name)
    for column in ("length", "width"):
        _refuse(frame[column].to_numpy() <= 0.0, table, column, "is not positive", name)
    ids = table["vehicle"].astype("string").fillna("").str.strip()
    _refuse((ids == "").to_numpy(dtype=bool), table, "vehicle", "is empty", name)
    frame["vehicle"] = ids.astype(str).to_numpy()
    frame = frame.sort_values(["vehicle", "time"], kind="stable", ignore_index=True)
    return frame[list(COLUMNS)], _interval(frame, name)


def _as_floats(values: pd.Series[Any]) -> FloatArray:
    return np.asarray(pd.to_numeric(values, errors="coerce"), dtype=float)


def _refuse(wrong: BoolArray, table: pd.DataFrame, column: str, what: str, name: str) -> None:
    if not wrong.any():
        return
    row = int(wrong.argmax())
    value = table[column].iloc[row]
    shown = "" if what == "is empty" else f" ({value})"
    raise UserError(
        f"{name}: row {table.index[row] + 1}: {column} {what}{shown}; mend it or take the row out"
    )


def _interval(table: pd.DataFrame, name: str) -> float:
    """Seconds between two rows of a vehicle, of a table that is sorted."""
    times, ids = table["time"].to_numpy(), table["vehicle"].to_numpy()
    same = np.flatnonzero(ids[1:] == ids[:-1]) + 1
    if not same.size:
        raise UserError(f"{name}: no vehicle is there more than once, so that none drives")
    apart = times[same] - times[same - 1]
    interval = round(float(np.median(apart)), 6)
    if (apart < _UNEVEN * max(interval, SHORTEST)).any():
        twice = same[int(apart.argmin())]
        raise UserError(
            f"{name}: overlapping ids: vehicle {ids[twice]!r} is there twice at "
            f"{times[twice]:g} s; give every vehicle an id of its own"
        )
    if not 0.99 * SHORTEST < interval < 1.01 * LONGEST:
        raise UserError(
            f"{name}: its rows are {interval:g} s apart; learning needs {SHORTEST:g} to "
            f"{LONGEST:g} s; record it again (SUMO: --step-length 0.1) or resample it"
        )
    steps = apart / interval
    uneven = np.abs(steps - np.maximum(np.rint(steps), 1.0)) > _UNEVEN
    if uneven.any():
        row = same[int(uneven.argmax())]
        raise UserError(
            f"{name}: times are not regular: vehicle {ids[row]!r} is there at "
            f"{times[row - 1]:.10g} and {times[row]:.10g} s, but its rows are {interval:g} s "
            "apart; resample it, or write its times with more digits"
        )
    return interval
