"""The picture of a run: the ego's path among the humans', and why it followed them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from sumo_cohesion.errors import UserError
from sumo_cohesion.report import drawing
from sumo_cohesion.report.drawing import ego_of
from sumo_cohesion.tables.compared import COMPARISON_FILE, run_folder
from sumo_cohesion.tables.folders import claim
from sumo_cohesion.tables.rollout import Rollout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURE = "paths.png"


def draw_run(folder: Path, out: Path | None = None) -> Path:
    """Draw one run from its folder; returns the picture's path."""
    return _saved(_draw([Rollout.read(folder)]), folder, out)


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
    return _saved(_draw(rollouts), folder, out)


def _saved(figure: Figure, folder: Path, out: Path | None) -> Path:
    if out is not None:
        return drawing.save(figure, out)
    with claim(folder, PICTURE) as path:
        return drawing.save(figure, path)


def _draw(rollouts: list[Rollout]) -> Figure:
    explained = [r for r in rollouts if len(r.agreement)]
    rows = len(rollouts) + bool(explained)
    figure = drawing.new_figure(11, 2.3 * rows + 0.6)
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
    ego = pd.concat([ego_of(r) for r in rollouts])
    low, high = float(ego["s"].min()), float(ego["s"].max())
    for rollout in rollouts:
        if rollout.info["touched"]:
            at = float(ego_of(rollout)["s"].iloc[-1])
            return max(low, at - 220.0), min(high, at + 160.0)
    return low, high


def _draw_paths(axis: Axes, rollout: Rollout, window: tuple[float, float]) -> None:
    """Draw all paths, and all cars at the moment that matters most."""
    table = rollout.trajectory
    inside = table[table["s"].between(*window)]
    drawing.draw_paths(axis, rollout, inside)
    drawing.draw_cars(axis, rollout, inside[inside["time"] == _moment(rollout)])
    drawing.draw_road(axis, [rollout], window)
    title = f"{rollout.info['planner']}: {drawing.ending(rollout)}"
    axis.set_title(title, loc="left", fontsize="medium", color=drawing.ego_colour(rollout))
    axis.set_ylabel("across, d [m]")


def _moment(rollout: Rollout) -> float:
    """Time of the contact, or when the ego passed a hidden car, or the end."""
    table = rollout.trajectory
    hidden = table[table["vehicle"].isin(rollout.info["hidden"])]
    if rollout.info["touched"] or hidden.empty:
        return float(table["time"].iloc[-1])
    pair = hidden.merge(ego_of(rollout), on="time", suffixes=("", "_ego"))
    return float(pair["time"].iloc[int((pair["s"] - pair["s_ego"]).abs().argmin())])


def _draw_pull(axis: Axes, rollout: Rollout) -> None:
    """Show which group's steering features pulled, where the ego then was."""
    ego = ego_of(rollout)[["time", "s"]]
    features = rollout.info["features"].items()
    steering = rollout.agreement[
        rollout.agreement["feature"].isin([name for name, steers in features if steers])
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
