"""What every picture of a run is made of: roads, paths and cars, in one set of colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sumo_cohesion.errors import UserError
from sumo_cohesion.tables.rollout import Rollout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

EGO_COLOURS = {"nominal": "tab:blue", "cohesive": "tab:orange", "paper": "tab:green"}
"""The paper draws the nominal robot blue and the cohesive one orange."""
HUMAN, UNSEEN, SPECIAL, PATH = "white", "0.6", "tab:red", "0.6"
"""Faces of the other cars' boxes, and the colour of their paths."""
JUMP = 1.0
"""Metres per step by which an edge jumps only where the ego changed from one strip to another."""
MARGIN = 5.0
"""Metres by which edges reach beyond the window, so that they end at its frame."""
LANE_WIDTHS = (2.0, 5.0)
"""Metres; dividing the road by its lanes is believed only if it gives such lanes."""


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure of this size in inches.

    The object interface draws without a screen and leaves the user's pyplot state alone.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path, dpi: int = 150) -> Path:
    """Write a figure to a file; the same figure gives the same file.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    # matplotlib would write its version into a PNG.
    about = {"Software": None} if path.suffix.lower() == ".png" else None
    try:
        figure.savefig(path, dpi=dpi, metadata=about)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from None
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    return path


def ego_of(rollout: Rollout) -> pd.DataFrame:
    """Rows of the trajectory that are the ego's."""
    return rollout.trajectory[rollout.trajectory["vehicle"] == "ego"]


def ego_colour(rollout: Rollout) -> str:
    """Colour of this run's ego, by its planner."""
    return EGO_COLOURS.get(rollout.info["planner"], "tab:purple")


def humans_of(rollout: Rollout) -> pd.DataFrame:
    """Rows of the trajectory that are human drivers'."""
    info = rollout.info
    table = rollout.trajectory
    others = table["vehicle"].isin({"ego", *info["hidden"], *info["special"]})
    if "planned" in table:  # runs from before there were fleets have no such column
        others |= table["planned"]
    return table[~others]


def ending(rollout: Rollout) -> str:
    """How the run ended, in words for a title."""
    info = rollout.info
    return f"collides with {info['touched'][0]}" if info["touched"] else str(info["outcome"])


def faded(colour: str, strength: float) -> tuple[float, float, float]:
    """Mix a colour with white: 1 leaves it, 0 is white. What lies beneath never shows through."""
    from matplotlib.colors import to_rgb

    red, green, blue = (1.0 - strength * (1.0 - part) for part in to_rgb(colour))
    return red, green, blue


def car_box(car: pd.Series, face: Any, **style: Any) -> Rectangle:
    """Outline of one row of a trajectory, in the road frame: turned before it is stretched."""
    from matplotlib.patches import Rectangle

    corner = (car["s"] - car["length"] / 2, car["d"] - car["width"] / 2)
    return Rectangle(
        corner,
        car["length"],
        car["width"],
        angle=float(np.degrees(car["road_heading"])),
        rotation_point="center",
        facecolor=face,
        **{"edgecolor": "black", "zorder": 3.0} | style,
    )


def draw_cars(
    axis: Axes, rollout: Rollout, rows: pd.DataFrame, strength: float = 1.0, zorder: float = 3.0
) -> None:
    """Draw a box for each row: the ego's colour, red if special, grey if the ego cannot see it.

    Less ``strength``, down to 0, makes the boxes fainter.
    """
    for _, car in rows.iterrows():
        face = HUMAN if car["visible"] else UNSEEN
        if car["vehicle"] in rollout.info["special"]:
            face = SPECIAL
        if car["vehicle"] == "ego":
            face = ego_colour(rollout)
        edge = faded("black", strength)
        axis.add_patch(car_box(car, faded(face, strength), edgecolor=edge, zorder=zorder))


def draw_paths(axis: Axes, rollout: Rollout, rows: pd.DataFrame) -> None:
    """Draw everybody's path d(s) through these rows of the trajectory."""
    for name, car in rows.groupby("vehicle", sort=False):
        if name == "ego":
            axis.plot(car["s"], car["d"], color=ego_colour(rollout), lw=2.0, zorder=2.5)
        else:
            axis.plot(car["s"], car["d"], color=PATH, lw=1.0)


def draw_road(axis: Axes, rollouts: Sequence[Rollout], window: tuple[float, float]) -> None:
    """Draw the road's edges where these runs' egos drove, its lane lines, and set the d-axis.

    An ego on an exit drove on a strip of its own; its edges begin anew there.
    """
    low, high = np.inf, -np.inf
    for rollout in rollouts:
        s = ego_of(rollout)["s"].iloc[: len(rollout.plan)].to_numpy()
        inside = (s >= window[0] - MARGIN) & (s <= window[1] + MARGIN)
        for name in ("road_right", "road_left"):
            edge = rollout.plan[name].where(rollout.plan[name].diff().abs().fillna(0.0) < JUMP)
            axis.plot(s[inside], edge[inside], color="black", lw=1.2)
            low, high = min(low, edge[inside].min()), max(high, edge[inside].max())
    for line in lane_lines(rollouts[0]):
        axis.axhline(line, color="0.8", lw=0.8, ls="--", zorder=0.5)
    if low < high:
        axis.set_ylim(low - 0.6, high + 0.6)


def lane_lines(rollout: Rollout) -> list[float]:
    """Lateral positions (m) of the lines between the route's lanes, taken to be equally wide.

    Empty if the road is no such road: the tables hold the road's edges, not its lanes.
    """
    plan = rollout.plan[~rollout.plan["on_exit"]]
    lanes = int(rollout.info["n_route_lanes"])
    if plan.empty:
        return []
    right, left = float(plan["road_right"].median()), float(plan["road_left"].median())
    if not LANE_WIDTHS[0] <= (left - right) / lanes <= LANE_WIDTHS[1]:
        return []
    return [float(line) for line in np.linspace(right, left, lanes + 1)[1:-1]]
