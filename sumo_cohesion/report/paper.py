"""The paper's figures, drawn from own runs; each function returns a figure to be saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from sumo_cohesion.report import drawing
from sumo_cohesion.report.drawing import ego_colour, ego_of, humans_of
from sumo_cohesion.state import FloatArray
from sumo_cohesion.tables.rollout import Rollout

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 12.3
"""Inches; 1600 pixels at 130 dots per inch."""
PARTED = 0.5
"""Metres across between two egos in the same traffic from which they drive differently."""
INSTANTS = 4
"""How often each car is drawn; the earlier, the fainter."""
BEFORE, AFTER = 60.0, 180.0
"""Metres of road shown around the place where two egos part."""
BESIDE = (-150.0, 125.0)
"""Metres shown behind and ahead of where a car at the speed limit would be."""
PASSING = 24.0
"""Seconds for which a special vehicle is followed from the first event near it."""
ALONG, ACROSS, SPEED, TIME = "along the road, s [m]", "across, d [m]", "speed [m/s]", "time [s]"
TERM_TITLES = {
    "car": "reward for avoiding other cars",
    "lane": "reward for keeping to a lane",
    "edge": "reward for staying on the road",
}
FEATURE_LABELS = {
    "lateral": "across, Δd",
    "longitudinal": "along, Δs",
    "heading": "heading, ΔΨ",
    "distance": "distance, ‖Δp‖",
    "direction": "direction of Δp",
}
FEATURE_STYLES = (
    {"color": "tab:purple", "lw": 1.5},
    {"color": "tab:red", "lw": 3.0},
    {"color": "tab:green", "lw": 1.5},
    {"color": "black", "lw": 1.5, "ls": "--"},
    {"color": "tab:gray", "lw": 1.5},
)
"""At a steady course Δs and ‖Δp‖ coincide: a thin dashed line on a thick one shows both."""


# Driving features


def draw_features(
    rollout: Rollout, time: float, s: FloatArray, d: FloatArray, terms: Mapping[str, FloatArray]
) -> Figure:
    """Heat maps of reward terms over the road; red is higher reward (paper, figure 2).

    Parameters
    ----------
    rollout, time : whose cars stand on the maps, and when (s): the nearest step is taken.
    s, d : (S,) and (D,) places (m), evenly spaced, in the road frame.
    terms : arrays (D, S) by name, as planning.landscape.reward_landscape returns them.
    """
    table = rollout.trajectory
    step = table["time"].iloc[int((table["time"] - time).abs().argmin())]
    now = table[table["time"].eq(step) & table["s"].between(s[0], s[-1])]
    figure = drawing.new_figure(WIDTH, 1.75 * len(terms) + 0.5)
    axes = np.atleast_1d(figure.subplots(len(terms), 1, sharex=True))
    half_s, half_d = (s[1] - s[0]) / 2, (d[1] - d[0]) / 2
    extent = (s[0] - half_s, s[-1] + half_s, d[0] - half_d, d[-1] + half_d)
    for letter, axis, (name, values) in zip("abcdef", axes, terms.items(), strict=False):
        image = axis.imshow(values, cmap="coolwarm", origin="lower", aspect="auto", extent=extent)
        figure.colorbar(image, ax=axis, pad=0.01)
        drawing.draw_road(axis, [rollout], (float(s[0]), float(s[-1])))
        for _, car in now.iterrows():
            own = car["vehicle"] == "ego"
            face = ego_colour(rollout) if own else "none"
            axis.add_patch(drawing.car_box(car, face, lw=1.2))
        axis.set_title(f"({letter}) {TERM_TITLES.get(name, name)}", loc="left", fontsize="medium")
        axis.set_ylabel(ACROSS)
        axis.set_ylim(extent[2:])
    axes[-1].set_xlim(extent[:2])
    axes[-1].set_xlabel(ALONG)
    return figure


# Driving scenarios


def draw_scenarios(pairs: Sequence[tuple[Rollout, Rollout]]) -> Figure:
    """Draw each scenario's nominal run above its cohesive run (paper, figure 4).

    The view follows from the runs. With a special vehicle: beside a car at the speed limit, so
    that what catches up moves and the rest nearly stands. Where the two egos part: the road
    there. Otherwise they differ in speed alone: speed over time.
    """
    views = [_view(*pair) for pair in pairs]
    heights = [
        _HEIGHTS[view] + any(rollout.plan["on_exit"].any() for rollout in pair)
        for view, pair in zip(views, pairs, strict=True)
    ]
    figure = drawing.new_figure(WIDTH, sum(heights) + 0.4)
    parts = figure.subfigures(len(pairs), 1, height_ratios=heights, squeeze=False)[:, 0]
    for letter, part, view, pair in zip("abcdefghij", parts, views, pairs, strict=False):
        info = pair[0].info["scenario"]
        title = f"({letter}) {info['name']}: {info['summary']}"
        part.suptitle(title, x=0.01, ha="left", fontsize="medium")
        if view == "speed":
            axis = part.subplots()
            draw_speeds(axis, pair)
            axis.legend(loc="center", ncols=5, fontsize="small", frameon=False)
            _small(axis)
            continue
        upper, lower = part.subplots(2, 1, sharex=True)
        draw = _draw_beside if view == "beside" else _draw_parting
        draw((upper, lower), pair)
    figure.legend(
        handles=_legend(),
        loc="outside lower center",
        ncols=6,
        fontsize="small",
        frameon=False,
    )
    return figure


_HEIGHTS = {"road": 3.2, "beside": 3.2, "speed": 2.1}


def _view(nominal: Rollout, cohesive: Rollout) -> str:
    if nominal.info["special"]:
        return "beside"
    return "speed" if _parting(nominal, cohesive) is None else "road"


def _parting(nominal: Rollout, cohesive: Rollout) -> pd.Series | None:
    """Row of the first instant at which the egos are no longer side by side; None if never."""
    both = ego_of(nominal).merge(ego_of(cohesive), on="time", suffixes=("", "_cohesive"))
    apart = both[(both["d"] - both["d_cohesive"]).abs() > PARTED]
    return None if apart.empty else apart.iloc[0]


def _draw_parting(axes: Sequence[Axes], pair: tuple[Rollout, Rollout]) -> None:
    """Draw the stretch of road on which the egos part."""
    parting = _parting(*pair)
    assert parting is not None, "draw_scenarios draws speeds then"
    window = float(parting["s"]) - BEFORE, float(parting["s"]) + AFTER
    ego = ego_of(pair[1])
    crossing = ego[ego["s"].between(window[0] + 5.0, window[1] - 10.0)]["time"]
    instants = np.linspace(crossing.iloc[0], crossing.iloc[-1], INSTANTS).tolist()
    for axis, rollout in zip(axes, pair, strict=True):
        table = rollout.trajectory
        inside = table[table["s"].between(*window)]
        drawing.draw_paths(axis, rollout, inside)
        # A run that ends early has its end as its last instant.
        times = [time for time in instants if time <= float(table["time"].iloc[-1])]
        times += [float(table["time"].iloc[-1])] if len(times) < INSTANTS else []
        _draw_instants(axis, rollout, inside, times)
        drawing.draw_road(axis, pair, window)
        _name(axis, rollout)
    axes[1].set_xlim(*window)
    axes[1].set_xlabel(ALONG)
    early = any(r.info["touched"] for r in pair)
    _say_instants(axes, instants, " and at the contact" if early else "")


def _draw_beside(axes: Sequence[Axes], pair: tuple[Rollout, Rollout]) -> None:
    """Draw what happens around a car at the speed limit that starts where the ego does."""
    start = _alarm(pair[0])
    times = np.linspace(start, start + PASSING, INSTANTS).tolist()
    for axis, rollout in zip(axes, pair, strict=True):
        moving = _beside(rollout)
        table = moving.trajectory
        table = table[table["time"].between(times[0], times[-1]) & table["s"].between(*BESIDE)]
        drawing.draw_paths(axis, rollout, table)
        _draw_instants(axis, rollout, table, times)
        right, left = rollout.plan["road_right"].median(), rollout.plan["road_left"].median()
        for edge in (right, left):
            axis.axhline(edge, color="black", lw=1.2)
        for line in drawing.lane_lines(rollout):
            axis.axhline(line, color="0.8", lw=0.8, ls="--", zorder=0.5)
        axis.set_ylim(right - 0.6, left + 0.6)
        _name(axis, rollout)
    axes[1].set_xlim(*BESIDE)
    axes[1].set_xlabel("ahead of a car that keeps the speed limit [m]")
    _say_instants(axes, times)


def _alarm(rollout: Rollout) -> float:
    """Time (s) of the first event near the ego; without one, half a view before it is passed."""
    events = rollout.info["scenario"]["events"]
    times = rollout.info["events"]
    near = [times[str(i)] for i, e in enumerate(events) if e["near"] and str(i) in times]
    if near:
        return float(min(near))
    special = rollout.trajectory[rollout.trajectory["vehicle"].isin(rollout.info["special"])]
    both = special.merge(ego_of(rollout), on="time", suffixes=("", "_ego"))
    if both.empty:
        return float(rollout.trajectory["time"].iloc[0])
    nearest = float(both["time"].iloc[int((both["s"] - both["s_ego"]).abs().argmin())])
    return max(nearest - PASSING / 2, float(rollout.trajectory["time"].iloc[0]))


def _beside(rollout: Rollout) -> Rollout:
    """Return the same run with s measured from a car at the limit, from the ego's start."""
    table, ego = rollout.trajectory, ego_of(rollout)
    limit = float(rollout.plan["speed_limit"].median())
    reference = ego["s"].iloc[0] + limit * (table["time"] - ego["time"].iloc[0])
    return replace(rollout, trajectory=table.assign(s=table["s"] - reference))


def _draw_instants(
    axis: Axes, rollout: Rollout, rows: pd.DataFrame, times: Sequence[float]
) -> None:
    """Draw everybody at some times, the last one boldest; a car that stands still only once."""
    still = rows.groupby("vehicle")["speed"].transform("max") < 0.1
    for i, time in enumerate(times):
        now = rows["time"] == rows["time"].iloc[int((rows["time"] - time).abs().argmin())]
        strength = 0.25 + 0.75 * (i + 1) / len(times)
        drawing.draw_cars(axis, rollout, rows[now & ~still], strength, zorder=3.0 + 0.1 * i)
    drawing.draw_cars(axis, rollout, rows[still].drop_duplicates("vehicle"))


def _say_instants(axes: Sequence[Axes], times: Sequence[float], also: str = "") -> None:
    said = f"cars every {times[1] - times[0]:.1f} s{also}, the last ones boldest"
    axes[0].set_title(said, loc="right", fontsize="small", color="0.4")
    for axis in axes:
        _small(axis)


def _name(axis: Axes, rollout: Rollout) -> None:
    title = f"{rollout.info['planner']}: {fate(rollout)}"
    axis.set_title(title, loc="left", fontsize="small", color=ego_colour(rollout))
    axis.set_ylabel(ACROSS)


def _small(axis: Axes) -> None:
    axis.tick_params(labelsize="small")
    for label in (axis.xaxis.label, axis.yaxis.label):
        label.set_fontsize("small")


def fate(rollout: Rollout) -> str:
    """Say what became of the ego, as a verb: what it touched, or what its scenario is about."""
    info, metrics = rollout.info, rollout.metrics.iloc[0]
    if info["touched"]:
        return drawing.ending(rollout)
    if metrics["exited"]:
        return "takes the exit"
    if info["special"]:
        after = float(metrics["yield_time"])
        return f"makes way after {after:.1f} s" if np.isfinite(after) else "does not make way"
    hidden = rollout.trajectory[rollout.trajectory["vehicle"].isin(info["hidden"])]
    if len(hidden):
        passed = ego_of(rollout)["s"].iloc[-1] > hidden["s"].max()
        return f"passes {info['hidden'][0]}" if passed else f"does not reach {info['hidden'][0]}"
    return "stays on its route"


def _legend() -> list[Artist]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    faces = {
        "nominal": drawing.EGO_COLOURS["nominal"],
        "cohesive": drawing.EGO_COLOURS["cohesive"],
        "human": drawing.HUMAN,
        "unseen by the ego": drawing.UNSEEN,
        "special vehicle": drawing.SPECIAL,
    }
    boxes = [Patch(facecolor=c, edgecolor="black", label=name) for name, c in faces.items()]
    return [*boxes, Line2D([], [], color=drawing.PATH, lw=1.0, label="human's path")]


# Speeds, nothing to match, one feature in common


def draw_speeds(axis: Axes, rollouts: Sequence[Rollout]) -> None:
    """Draw the egos' speeds over time, the humans' mean and range in the last run, the limit."""
    last = rollouts[-1]
    humans = humans_of(last).groupby("time")["speed"].agg(["min", "mean", "max"])
    axis.fill_between(
        humans.index, humans["min"], humans["max"], color="0.9", label="humans' range"
    )
    axis.plot(humans.index, humans["mean"], color="0.4", lw=1.2, label="humans' mean")
    axis.plot(
        last.plan["time"],
        last.plan["speed_limit"],
        color="black",
        ls=":",
        zorder=2.6,
        label="limit",
    )
    for rollout in rollouts:
        ego = ego_of(rollout)
        axis.plot(
            ego["time"],
            ego["speed"],
            color=ego_colour(rollout),
            lw=2.0,
            label=rollout.info["planner"],
        )
    axis.set_xlim(float(last.plan["time"].iloc[0]), float(last.plan["time"].iloc[-1]))
    axis.set_xlabel(TIME)
    axis.set_ylabel(SPEED)


def draw_nothing_to_match(nominal: Rollout, cohesive: Rollout) -> Figure:
    """Lay both egos' paths and speeds over one another (paper, figure 5).

    The humans drive around the ego, so that they, too, differ a little between the runs: full
    lines are those around the nominal ego, dashed ones those around the cohesive ego.
    """
    pair = (nominal, cohesive)
    figure = drawing.new_figure(WIDTH, 5.6)
    paths, speeds = figure.subplots(2, 1)
    ego = pd.concat([ego_of(rollout) for rollout in pair])
    window = float(ego["s"].min()), float(ego["s"].max())
    drawing.draw_road(paths, pair, window)
    for rollout, style in zip(pair, ("-", "--"), strict=True):
        planner = rollout.info["planner"]
        for axis, x, y in ((paths, "s", "d"), (speeds, "time", "speed")):
            for i, (_, car) in enumerate(humans_of(rollout).groupby("vehicle", sort=False)):
                label = f"humans around {planner}" if i == 0 else None
                axis.plot(car[x], car[y], color=drawing.PATH, lw=1.0, ls=style, label=label)
            own = ego_of(rollout)
            colour = ego_colour(rollout)
            axis.plot(own[x], own[y], color=colour, lw=2.0, ls=style, zorder=2.5, label=planner)
    paths.set_xlim(*window)
    paths.set_xlabel(ALONG)
    paths.set_ylabel(ACROSS)
    speeds.plot(
        cohesive.plan["time"],
        cohesive.plan["speed_limit"],
        color="black",
        ls=":",
        zorder=2.6,
        label="limit",
    )
    speeds.set_xlim(float(ego["time"].min()), float(ego["time"].max()))
    speeds.set_xlabel(TIME)
    speeds.set_ylabel(SPEED)
    lines, labels = speeds.get_legend_handles_labels()
    figure.legend(
        lines, labels, loc="outside upper center", ncols=5, fontsize="small", frameon=False
    )
    return figure


def precision(rollout: Rollout, group: str = "road") -> pd.DataFrame:
    """Precision 1/(variance + floor) of each social feature of a group.

    Returns
    -------
    One row per time, one column per feature; NaN where fewer cars than min_cars voted. This is
    how well they agree, whether or not the group was given a vote.
    """
    rows = rollout.agreement[rollout.agreement["group"] == group]
    table = rows.pivot(index="time", columns="feature", values="precision")
    return table[[name for name in rollout.info["features"] if name in table and name != "place"]]


def draw_common_feature(nominal: Rollout, cohesive: Rollout, group: str = "road") -> Figure:
    """Draw what the humans agree on, beside what the egos make of it (paper, figure 6)."""
    figure = drawing.new_figure(WIDTH, 4.8)
    left, right = figure.subplots(1, 2)
    table = precision(cohesive, group)
    for name, style in zip(map(str, table), cycle(FEATURE_STYLES), strict=False):
        left.plot(table.index, table[name], label=FEATURE_LABELS.get(name, name), **style)
    most = 1.0 / cohesive.info["cohesion"]["variance_floor"]
    left.axhline(most, color="black", lw=0.8, ls=":", label="perfect agreement")
    left.set_yscale("log")
    left.set_xlabel(TIME)
    left.set_ylabel("precision λ = 1/(σ² + floor)")
    left.set_title(f"(a) what the {group} group agrees on", loc="left", fontsize="medium")
    draw_speeds(right, (nominal, cohesive))
    right.set_title("(b) what the egos do", loc="left", fontsize="medium")
    left.set_xlim(right.get_xlim())
    for axis in (left, right):
        axis.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.13),
            ncols=3,
            fontsize="small",
            frameon=False,
        )
    return figure


# Noise


def draw_noise(cases: Sequence[tuple[str, Rollout]]) -> Figure:
    """One panel per level of noise: how the ego fares that follows noisier humans (figure 7).

    Parameters
    ----------
    cases : label of the level, and a run; runs with the same label share a panel. All on the
        same road.
    """
    labels = list(dict.fromkeys(label for label, _ in cases))
    figure = drawing.new_figure(WIDTH, 1.75 * len(labels) + 0.6)
    axes = np.atleast_1d(figure.subplots(len(labels), 1, sharex=True))
    window = _around_hidden([rollout for _, rollout in cases])
    for axis, label in zip(axes, labels, strict=True):
        runs = [rollout for name, rollout in cases if name == label]
        for rollout in runs:
            inside = rollout.trajectory[rollout.trajectory["s"].between(*window)]
            drawing.draw_paths(axis, rollout, inside)
            hidden = inside[inside["vehicle"].isin(rollout.info["hidden"])]
            drawing.draw_cars(axis, rollout, hidden.drop_duplicates("vehicle"))
            drawing.draw_cars(axis, rollout, _beside_hidden(rollout, inside))
        drawing.draw_road(axis, runs, window)
        fates = "; ".join(f"{r.info['planner']} {fate(r)}" for r in runs)
        axis.set_title(f"{label}: {fates}", loc="left", fontsize="medium")
        axis.set_ylabel(ACROSS)
    # Noise is small beside a road's width: show as much of the road as the paths need.
    paths = [r.trajectory[r.trajectory["s"].between(*window)]["d"] for _, r in cases]
    low, high = (f(axis.get_ylim()[i] for axis in axes) for i, f in enumerate((min, max)))
    for axis in axes:
        axis.set_ylim(low, min(high, max(float(d.max()) for d in paths) + 1.5))
    axes[-1].set_xlim(*window)
    axes[-1].set_xlabel(ALONG)
    figure.legend(
        handles=[h for h in _legend() if h.get_label() not in ("human", "special vehicle")],
        loc="outside lower center",
        ncols=4,
        fontsize="small",
        frameon=False,
    )
    return figure


def _around_hidden(rollouts: Sequence[Rollout]) -> tuple[float, float]:
    """Stretch of road (m) around the hidden cars, or what the egos drove if there are none."""
    hidden = [r.trajectory[r.trajectory["vehicle"].isin(r.info["hidden"])]["s"] for r in rollouts]
    at = pd.concat(hidden)
    if at.empty:
        s = pd.concat([ego_of(rollout)["s"] for rollout in rollouts])
        return float(s.min()), float(s.max())
    return float(at.min()) - 150.0, float(at.max()) + 110.0


def _beside_hidden(rollout: Rollout, inside: pd.DataFrame) -> pd.DataFrame:
    """Row of the ego where it is nearest to a hidden car; empty if it is never in the window."""
    hidden = inside[inside["vehicle"].isin(rollout.info["hidden"])]
    ego = inside[inside["vehicle"] == "ego"]
    if hidden.empty or ego.empty:
        return ego.tail(1)
    return ego.loc[[(ego["s"] - hidden["s"].iloc[0]).abs().idxmin()]]


# Rates


def draw_rates(rates: pd.DataFrame) -> Figure:
    """Success rates with their intervals, one line per claim and scenario, a point per planner.

    Parameters
    ----------
    rates : columns claim, scenario, planner, rate, low, high (shares) and n (runs).
    """
    cases = list(dict.fromkeys(zip(rates["claim"], rates["scenario"], strict=True)))
    planners = list(dict.fromkeys(rates["planner"]))
    figure = drawing.new_figure(WIDTH, 0.6 * len(cases) + 1.2)
    axis = figure.subplots()
    spread = 0.5 / max(len(planners), 1)
    for j, planner in enumerate(planners):
        rows = rates[rates["planner"] == planner]
        at = [cases.index(c) for c in zip(rows["claim"], rows["scenario"], strict=True)]
        y = np.array(at, dtype=float) + (j - (len(planners) - 1) / 2) * spread
        rate = rows["rate"].to_numpy(float)
        reach = np.array([rate - rows["low"].to_numpy(float), rows["high"].to_numpy(float) - rate])
        axis.errorbar(
            rate,
            y,
            xerr=np.maximum(reach, 0.0),
            fmt="o",
            ms=5,
            capsize=3,
            color=drawing.EGO_COLOURS.get(planner, "0.4"),
            label=planner,
            clip_on=False,
            zorder=3,
        )
    for i in range(1, len(cases)):
        axis.axhline(i - 0.5, color="0.9", lw=0.8)
    axis.set_yticks(range(len(cases)), [f"{claim}\n{scenario}" for claim, scenario in cases])
    axis.set_ylim(len(cases) - 0.5, -0.5)
    axis.set_xlim(0.0, 1.0)
    axis.xaxis.set_major_formatter(lambda x, _: f"{100 * x:.0f} %")
    runs = sorted(set(rates["n"]))
    n = str(runs[0]) if len(runs) == 1 else f"{runs[0]} to {runs[-1]}"
    axis.set_xlabel(f"share of {n} runs, with 95 % Wilson intervals")
    axis.grid(axis="x", color="0.9", lw=0.8)
    figure.legend(loc="outside upper center", ncols=len(planners), fontsize="small", frameon=False)
    return figure
