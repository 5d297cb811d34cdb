"""The picture of a run: the ego's path among the humans', and why it followed them."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from sumo_cohesion.errors import UserError
from sumo_cohesion.experiments.comparison import COMPARISON_FILE, run_folder
from sumo_cohesion.experiments.rollout import Rollout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

EGO_COLOURS = {"nominal": "tab:blue", "cohesive": "tab:orange", "paper": "tab:green"}
"""The paper draws the nominal robot blue and the cohesive one orange."""
PICTURE = "paths.png"


def draw_run(folder: Path, out: Path | None = None) -> Path:
    """Draw one run from its folder; returns the picture's path."""
    rollout = Rollout.read(folder)
    return _save(_draw([rollout]), out or folder / PICTURE)


def draw_comparison(folder: Path, out: Path | None = None, seed: int | None = None) -> Path:
    """Draw one seed of a comparison, one panel per planner; returns the picture's path."""
    try:
        about = json.loads((folder / COMPARISON_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{folder}: not a comparison ({error}); run compare again") from None
    chosen = about["seeds"][0] if seed is None else seed
    if chosen not in about["seeds"]:
        raise UserError(f"{folder}: has no seed {chosen}; its seeds are {about['seeds']}")
    rollouts = [Rollout.read(run_folder(folder, p, chosen)) for p in about["planners"]]
    return _save(_draw(rollouts), out or folder / PICTURE)


def _save(figure: Figure, path: Path) -> Path:
    try:
        figure.savefig(path, dpi=150)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from None
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    return path


def _draw(rollouts: list[Rollout]) -> Figure:
    # The object interface draws without a screen and leaves the user's pyplot state alone.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    explained = [r for r in rollouts if len(r.agreement)]
    rows = len(rollouts) + bool(explained)
    figure = Figure(figsize=(11, 2.3 * rows + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(rows, 1, sharex=True))
    window = _window(rollouts)
    for axis, rollout in zip(axes, rollouts, strict=False):
        _draw_paths(axis, rollout, window)
    if explained:
        _draw_pull(axes[-1], explained[-1])
    axes[0].set_xlim(*window)
    axes[-1].set_xlabel("along the road, s [m]")
    info = rollouts[0].info
    figure.suptitle(
        f"{info['scenario']['name']}, seed {info['seed']}: {info['scenario']['summary']}"
    )
    return figure


def _window(rollouts: list[Rollout]) -> tuple[float, float]:
    """Stretch of road worth showing: around the first contact, or else the whole run."""
    ego = pd.concat([r.trajectory[r.trajectory["vehicle"] == "ego"] for r in rollouts])
    low, high = float(ego["s"].min()), float(ego["s"].max())
    for rollout in rollouts:
        if rollout.info["touched"]:
            own = rollout.trajectory[rollout.trajectory["vehicle"] == "ego"]
            at = float(own["s"].iloc[-1])
            return max(low, at - 220.0), min(high, at + 160.0)
    return low, high


def _draw_paths(axis: Axes, rollout: Rollout, window: tuple[float, float]) -> None:
    """Draw all paths, and all cars at the moment that matters most."""
    table, info = rollout.trajectory, rollout.info
    colour = EGO_COLOURS.get(info["planner"], "tab:red")
    inside = table[table["s"].between(*window)]
    for name, car in inside.groupby("vehicle", sort=False):
        own = name == "ego"
        axis.plot(car["s"], car["d"], color=colour if own else "0.6", lw=2.0 if own else 1.0)
    for _, now in inside[inside["time"] == _moment(rollout)].iterrows():
        face = "white" if now["visible"] else "0.6"
        axis.add_patch(_box(now, colour if now["vehicle"] == "ego" else face))
    ego = table[table["vehicle"] == "ego"].iloc[: len(rollout.plan)]
    for edge in ("road_right", "road_left"):
        axis.plot(ego["s"], rollout.plan[edge], color="black", lw=1.2)
    right, left = rollout.plan["road_right"].min(), rollout.plan["road_left"].max()
    lanes = inside.groupby("lane")["d"].median().sort_index()
    for a, b in pairwise(lanes):
        axis.axhline((a + b) / 2, color="0.8", lw=0.8, ls="--")
    axis.set_ylim(right - 0.6, left + 0.6)
    end = f"collides with {info['touched'][0]}" if info["touched"] else info["outcome"]
    axis.set_title(f"{info['planner']}: {end}", loc="left", fontsize="medium", color=colour)
    axis.set_ylabel("across, d [m]")


def _moment(rollout: Rollout) -> float:
    """Time of the contact, or when the ego passed a hidden car, or the end."""
    table = rollout.trajectory
    hidden = table[table["vehicle"].isin(rollout.info["hidden"])]
    if rollout.info["touched"] or hidden.empty:
        return float(table["time"].iloc[-1])
    pair = hidden.merge(table[table["vehicle"] == "ego"], on="time", suffixes=("", "_ego"))
    return float(pair["time"].iloc[int((pair["s"] - pair["s_ego"]).abs().argmin())])


def _box(car: pd.Series, face: str) -> Rectangle:
    from matplotlib.patches import Rectangle

    corner = (car["s"] - car["length"] / 2, car["d"] - car["width"] / 2)
    return Rectangle(
        corner,
        car["length"],
        car["width"],
        angle=float(np.degrees(car["road_heading"])),
        rotation_point="center",
        facecolor=face,
        edgecolor="black",
        zorder=3,
    )


def _draw_pull(axis: Axes, rollout: Rollout) -> None:
    """Show which group's steering features pulled, where the ego then was."""
    ego = rollout.trajectory[rollout.trajectory["vehicle"] == "ego"][["time", "s"]]
    steering = rollout.agreement[
        rollout.agreement["feature"].isin(["lateral", "heading", "direction"])
    ]
    pull = steering.groupby(["time", "group"], sort=False)["pull"].sum().unstack("group")
    at = ego.set_index("time")["s"].reindex(pull.index)
    for group in pull.columns:
        axis.plot(at, pull[group], lw=1.2, label=f"{group} group")
    axis.set_title(
        f"{rollout.info['planner']}: who pulled it sideways (cost of ignoring them)",
        loc="left",
        fontsize="medium",
    )
    axis.set_ylabel("pull")
    axis.legend(loc="upper right", fontsize="small", frameon=False)
