"""Metrics: pure functions of the saved tables, each declared where it is worked out.

A metric is a function with its columns above it. What it needs of a run it names as arguments
(`declared.Measured`); it returns a value, or by name the values of its columns.

Surrogate safety measures as in SUMO's SSM device
(https://sumo.dlr.de/docs/Simulation/Output/SSM_Device.html), computed from the driven states.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sumo_cohesion.state import LANE_WIDTH, RESCUED, STEP, FloatArray
from sumo_cohesion.tables.column import Column
from sumo_cohesion.tables.declared import METRICS, OF_REFERENCE, metric, run_metrics, succeeded

__all__ = ["METRICS", "OF_REFERENCE", "run_metrics", "succeeded"]  # all are declared from here on

if TYPE_CHECKING:
    import pandas as pd

HARD_BRAKE = 4.5
"""m/s², SUMO's default comfortable deceleration: braking harder is not normal driving."""


@metric(
    Column(
        "outcome",
        "string",
        "",
        "why it ended: collision, finished, route_end, left_route; stopped: by SUMO, no success",
    ),
)
def outcome(info: Mapping[str, Any]) -> str:
    """Return what ended the run (simulation.episode)."""
    return str(info["outcome"])


@metric(
    Column("collision", "bool", "", "the ego's box touched another's"),
    Column("collision_with", "string", "", "id of the car touched, empty if none"),
    Column("collision_time", "float64", "s", "seconds after the start; NaN if none"),
    Column("collision_visible", "bool", "", "the car touched was one the ego could see"),
    Column("sumo_collision", "bool", "", "SUMO itself reported a contact of the ego"),
)
def collision_metrics(info: Mapping[str, Any], ego: pd.DataFrame) -> dict[str, Any]:
    """Whether, with whom and when the ego touched another; the run ends with it."""
    touched, time = info["touched"], ego["time"]
    return {
        "collision": bool(touched),
        "collision_with": touched[0] if touched else "",
        "collision_time": float(time.iloc[-1] - time.iloc[0]) if touched else np.nan,
        "collision_visible": bool(set(touched) - set(info["hidden"])),
        "sumo_collision": bool(info["touched_by_sumo"]),
    }


@metric(
    Column("off_road", "bool", "", "the ego's side left the drivable strip"),
)
def off_road(ego: pd.DataFrame, plan: pd.DataFrame) -> bool:
    """Tell whether the ego's side was ever beyond an edge of the drivable strip."""
    d = ego["d"].to_numpy()[: len(plan)]
    half = ego["width"].to_numpy()[: len(plan)] / 2
    beyond = (d - half < plan["road_right"]) | (d + half > plan["road_left"])
    return bool(beyond.any())


@metric(
    Column("exited", "bool", "", "the ego left its route by an exit, judged by geometry"),
)
def exited(plan: pd.DataFrame) -> bool:
    """Tell whether the ego was ever on an exit that has parted from its route."""
    return bool(plan["on_exit"].any())


@metric(
    Column("distance", "float64", "m", "driven along the route"),
    Column("travel_time", "float64", "s", "from start to end of the run"),
    Column("mean_speed", "float64", "m/s", "distance / travel time"),
)
def travel_metrics(ego: pd.DataFrame) -> dict[str, float]:
    """How far and how fast the ego came along its route."""
    distance = float(ego["s"].iloc[-1] - ego["s"].iloc[0])
    seconds = float(ego["time"].iloc[-1] - ego["time"].iloc[0])
    return {"distance": distance, "travel_time": seconds, "mean_speed": distance / seconds}


@metric(
    Column(
        "speed_gap_closed",
        "float64",
        "",
        "share of the humans' gap to the limit, 5 to 15 s after the start",
    ),
)
def speed_gap_closed(ego: pd.DataFrame, humans: pd.DataFrame, plan: pd.DataFrame) -> float:
    """Share of the gap between the limit and the humans' speed that the ego closed.

    (ego - limit) / (humans - limit), of means over 5 s to 15 s after the start, when the ego has
    had time to adapt and the humans are still near: those it sees within 80 m. NaN
    if they differ from the limit by less than 0.5 m/s, or there are none.
    """
    start = float(ego["time"].iloc[0])
    own = ego[ego["time"].between(start + 5.0, start + 15.0)]
    near = humans[humans["visible"]].merge(own[["time", "s"]], on="time", suffixes=("", "_ego"))
    near = near[(near["s"] - near["s_ego"]).abs() <= 80.0]
    if near.empty:
        return np.nan
    limit = float(plan["speed_limit"][plan["time"].isin(own["time"])].mean())
    gap = float(near["speed"].mean()) - limit
    return float((own["speed"].mean() - limit) / gap) if abs(gap) >= 0.5 else np.nan


@metric(
    Column("max_excess_speed", "float64", "m/s", "largest, over the mean of the humans in 80 m"),
)
def max_excess_speed(ego: pd.DataFrame, humans: pd.DataFrame) -> float:
    """Largest excess (m/s) of the ego's speed over the mean of the humans within 80 m.

    Negative if the ego was always slower; NaN if there never was a human so near.
    """
    pair = humans.merge(ego[["time", "s", "speed"]], on="time", suffixes=("", "_ego"))
    near = pair[(pair["s"] - pair["s_ego"]).abs() <= 80.0]
    by_time = near.groupby("time")
    return float((by_time["speed_ego"].first() - by_time["speed"].mean()).max())


@metric(
    Column("max_lateral_shift", "float64", "m", "largest distance across from where it started"),
)
def max_lateral_shift(ego: pd.DataFrame) -> float:
    """Largest distance across the road (m) from where the ego started."""
    return float((ego["d"] - ego["d"].iloc[0]).abs().max())


@metric(
    Column("max_speed_shift", "float64", "m/s", "largest difference from the limit"),
)
def max_speed_shift(ego: pd.DataFrame, plan: pd.DataFrame) -> float:
    """Largest difference (m/s) between the ego's speed and the limit of its route."""
    speed = ego["speed"].to_numpy()[: len(plan)]
    return float(np.abs(speed - plan["speed_limit"].to_numpy()).max())


@metric(
    Column(
        "speed_most_agreed",
        "float64",
        "",
        "share of steps in which the road group agrees most on the two features of speed",
    ),
)
def speed_most_agreed(
    agreement: pd.DataFrame, speed_features: Collection[str] = ("distance", "longitudinal")
) -> float:
    """Share of steps in which the road group's largest precisions are those of the speed.

    That is of distance and longitudinal, among all social features (paper, figure 7a). Only steps
    in which the group has enough cars count; NaN if there are none.
    """
    road = agreement[(agreement["group"] == "road") & agreement["precision"].notna()]
    by_feature = road.pivot_table(index="time", columns="feature", values="precision")
    if not set(speed_features) < set(by_feature.columns):
        return np.nan  # none, or those of a planner that has other features
    of_speed = by_feature[list(speed_features)].min(axis=1)
    others = by_feature.drop(columns=list(speed_features)).max(axis=1)
    return float((of_speed > others).mean())


@metric(
    Column("plan_lateral_change", "float64", "m", "largest, what cohesion changed in one plan"),
    Column("plan_speed_change", "float64", "m/s", "largest, what cohesion changed in one plan"),
    Column("twin_lateral_deviation", "float64", "m", "largest distance across from the twin"),
    Column("twin_speed_deviation", "float64", "m/s", "largest difference from the twin"),
)
def reference_metrics(ego: pd.DataFrame, reference: pd.DataFrame) -> dict[str, float]:
    """Say what cohesion changed: largest absolute values over the run; NaN without a reference.

    plan_*: within one horizon, against the nominal plan from the same state. twin_*: against a
    nominal car that started as the ego did and drove through the same traffic on its own.
    """
    twin = reference.merge(ego[["time", "d", "speed"]], on="time")
    return {
        "plan_lateral_change": _largest(reference["plan_lateral"]),
        "plan_speed_change": _largest(reference["plan_speed"]),
        "twin_lateral_deviation": _largest(twin["d"] - twin["twin_d"]),
        "twin_speed_deviation": _largest(twin["speed"] - twin["twin_speed"]),
    }


@metric(
    Column("nominal_lateral_deviation", "float64", "m", "as twin, but from nominal's own run"),
    Column("nominal_speed_deviation", "float64", "m/s", "as twin, but from nominal's own run"),
)
def nominal_metrics() -> dict[str, float]:
    """As of the twin, but against nominal's own run of the same seed: compare() fills it in."""
    return {"nominal_lateral_deviation": np.nan, "nominal_speed_deviation": np.nan}


def deviation(ego: pd.DataFrame, other: pd.DataFrame) -> tuple[float, float]:
    """Largest distance across (m) and difference of speed (m/s) between two runs' egos.

    ``ego`` and ``other`` have columns time, d, speed; only times that both have count.
    """
    both = ego.merge(other, on="time", suffixes=("", "_other"))
    return _largest(both["d"] - both["d_other"]), _largest(both["speed"] - both["speed_other"])


def _largest(values: pd.Series) -> float:
    return float(values.abs().max()) if len(values) else np.nan


@metric(
    Column("emergency_delay", "float64", "s", "lost by the special vehicle since the first event"),
    Column("yield_time", "float64", "s", "from the first event to the ego being half a lane right"),
)
def emergency_metrics(
    info: Mapping[str, Any], ego: pd.DataFrame, others: pd.DataFrame
) -> dict[str, float]:
    """How long the special vehicle was held up, and how soon the ego made way.

    emergency_delay: from the scenario's first ``near`` event to the end of the run, the time
    (s) that the special vehicle lost against driving at the fastest speed it ever had. yield_time:
    seconds from that event until the ego was half a lane right of where it was. NaN
    where there is no special vehicle or event, or the ego never moved over.
    """
    nothing = {"emergency_delay": np.nan, "yield_time": np.nan}
    numbers = [i for i, e in enumerate(info["scenario"]["events"]) if e["near"] is not None]
    if not info["special"] or not numbers or str(numbers[0]) not in info["events"]:
        return nothing
    event = float(info["events"][str(numbers[0])])
    vehicle = others[others["vehicle"] == info["special"][0]]
    after = vehicle[vehicle["time"] >= event]
    if len(after) < 2:
        return nothing
    passed = float(after["time"].iloc[-1] - after["time"].iloc[0])
    driven = float(after["s"].iloc[-1] - after["s"].iloc[0])
    own = ego[ego["time"] >= event]
    aside = own[own["d"] < own["d"].iloc[0] - LANE_WIDTH / 2]
    fastest = float(vehicle["speed"].max())
    return {
        "emergency_delay": passed - driven / fastest if fastest > 0.0 else np.nan,
        "yield_time": float(aside["time"].iloc[0] - event) if len(aside) else np.nan,
    }


@metric(
    Column("passing_lane", "float64", "", "ego's lane as the special vehicle passes; NaN if never"),
    Column("passing_shift", "float64", "m", "ego's way to the left from its start until then"),
)
def passing_metrics(
    info: Mapping[str, Any], ego: pd.DataFrame, others: pd.DataFrame
) -> dict[str, float]:
    """Where the ego is at the step in which the special vehicle, until then behind, is ahead.

    passing_lane: its lane; passing_shift: its d (m, left positive) less that at its start. NaN
    if it is never passed.
    """
    nothing = {"passing_lane": np.nan, "passing_shift": np.nan}
    if not info["special"]:
        return nothing
    vehicle = others[others["vehicle"] == info["special"][0]]
    both = ego.merge(vehicle[["time", "s"]], on="time", suffixes=("", "_special"))
    ahead = (both["s_special"] > both["s"]).to_numpy()
    passes = np.flatnonzero(~ahead[:-1] & ahead[1:])
    if not passes.size:
        return nothing
    then = both.iloc[passes[0] + 1]
    return {
        "passing_lane": float(then["lane"]),
        "passing_shift": float(then["d"] - ego["d"].iloc[0]),
    }


@metric(
    Column(
        "aside_share",
        "float64",
        "",
        "ego's way aside over that of its lane's humans, 0.3 m or more",
    ),
)
def aside_share(info: Mapping[str, Any], ego: pd.DataFrame, others: pd.DataFrame) -> float:
    """How far the ego moved aside for the special vehicle, as a share of what humans did.

    A car's way aside is its d when the special vehicle is nearest to it along the road (as it
    passes, if it does) less its d at the start. The ego's is divided by the mean of the humans
    that started in the ego's lane: 0 is staying put, 1 doing as they did, negative the other way.
    Each car at its own moment, because a siren reaches one after the other; the ego's lane alone,
    because other lanes may move the other way. NaN without a special vehicle or such humans, or
    if these moved by less than 0.3 m.
    """
    if not info["special"]:
        return np.nan
    special = others[others["vehicle"] == info["special"][0]]
    planned = others["vehicle"][others["planned"]].unique()
    not_human = [*info["hidden"], *info["special"], *planned]
    start = others[others["time"] == ego["time"].iloc[0]]
    lane = start["lane"] == ego["lane"].iloc[0]
    names = start["vehicle"][lane & ~start["vehicle"].isin(not_human)]
    ways = [_way_aside(others[others["vehicle"] == name], special) for name in names]
    # Who was out of sight before the special vehicle came into it says nothing.
    known = [way for way in ways if not np.isnan(way)]
    mean = float(np.mean(known)) if known else np.nan
    return _way_aside(ego, special) / mean if abs(mean) >= 0.3 else np.nan


def _way_aside(car: pd.DataFrame, special: pd.DataFrame) -> float:
    """Way to the left (m) from a car's start to when the special vehicle is nearest along s."""
    both = car.merge(special[["time", "s"]], on="time", suffixes=("", "_special"))
    if both.empty:
        return np.nan
    nearest = (both["s_special"] - both["s"]).abs().argmin()
    return float(both["d"].iloc[nearest] - car["d"].iloc[0])


@metric(
    Column("lane_changes", "int64", "", "changes of the ego's nearest lane"),
)
def lane_changes(ego: pd.DataFrame) -> int:
    """How often the ego's nearest lane changed."""
    return int((np.diff(ego["lane"]) != 0).sum())


@metric(
    Column("min_gap", "float64", "m", "smallest bumper-to-bumper gap to a car ahead in its path"),
    Column("min_ttc", "float64", "s", "smallest time to collision; NaN if never closing in"),
    Column("max_drac", "float64", "m/s²", "largest deceleration needed to avoid a crash"),
)
def gap_metrics(ego: pd.DataFrame, others: pd.DataFrame) -> dict[str, float]:
    """Smallest gap and time to collision, largest deceleration needed, to cars in the path.

    A car is in the ego's path if it is ahead and their widths overlap. With gap g (m, bumper to
    bumper) and closing speed v > 0 (m/s): TTC = g / v (s), DRAC = v² / 2g (m/s²). NaN where no
    car was ever in the path (gap) or none was being closed in on; at contact the gap is 0 and
    the other two are of the last step before it. Source: SSM device, above.
    """
    pair = others.merge(ego, on="time", suffixes=("", "_ego"))
    gap = pair["s"] - pair["s_ego"] - (pair["length"] + pair["length_ego"]) / 2
    aside = (pair["d"] - pair["d_ego"]).abs() - (pair["width"] + pair["width_ego"]) / 2
    in_path = (pair["s"] > pair["s_ego"]) & (aside < 0)
    gap = gap[in_path]
    speed = pair["speed"] * np.cos(pair["road_heading"])
    closing = (pair["speed_ego"] * np.cos(pair["road_heading_ego"]) - speed)[in_path]
    risky = (closing > 0) & (gap > 0)
    g, v = gap[risky], closing[risky]
    return {
        "min_gap": _least(gap.clip(lower=0.0)),
        "min_ttc": _least(g / v),
        "max_drac": -_least(-(v**2) / (2 * g)),
    }


def _least(values: pd.Series) -> float:
    return float(values.min()) if len(values) else np.nan


@metric(
    Column("pet", "float64", "s", "smallest post-encroachment time behind another; NaN if none"),
)
def post_encroachment_time(ego: pd.DataFrame, others: pd.DataFrame) -> float:
    """Smallest time (s) from another car's rear leaving a place to the ego's front entering it.

    Only places that both cover sideways count; NaN if the ego never follows anyone.
    Source: SSM device, above (PET).
    """
    smallest = np.nan
    front = (ego["s"] + ego["length"] / 2).to_numpy()
    time, d, half = ego["time"].to_numpy(), ego["d"].to_numpy(), ego["width"].to_numpy() / 2
    for _, car in others.groupby("vehicle", sort=False):
        rear = (car["s"] - car["length"] / 2).to_numpy()
        # A car that stands leaves nothing; keep the last moment at each place.
        moving = np.concatenate((np.diff(rear) > 1e-3, [False]))
        if moving.sum() < 2:
            continue
        rear, t, at = rear[moving], car["time"].to_numpy()[moving], car["d"].to_numpy()[moving]
        left = np.interp(front, rear, t, left=np.nan, right=np.nan)
        aside = np.abs(np.interp(front, rear, at) - d)
        pet = (time - left)[aside < half + float(car["width"].iloc[0]) / 2]
        pet = pet[pet >= 0]
        if pet.size:
            smallest = float(np.fmin(smallest, pet.min()))
    return smallest


@metric(
    Column("max_jerk", "float64", "m/s³", "largest change of the ego's acceleration"),
)
def max_jerk(ego: pd.DataFrame) -> float:
    """Largest |change of acceleration| per second (m/s³), by differences of the speed."""
    return _peak(_rate(_rate(ego["speed"].to_numpy(), ego), ego))


@metric(
    Column(
        "max_lateral_acceleration",
        "float64",
        "m/s²",
        "largest speed · yaw rate of the ego; SUMO's own turns in steps where lanes bend",
    ),
)
def max_lateral_acceleration(ego: pd.DataFrame) -> float:
    """Largest |speed · yaw rate| (m/s²)."""
    heading = np.unwrap(ego["heading"].to_numpy())
    return _peak(ego["speed"].to_numpy()[1:] * _rate(heading, ego))


def _rate(values: FloatArray, table: pd.DataFrame) -> FloatArray:
    """Differences per second; the table gives the step."""
    step = table["time"].iloc[1] - table["time"].iloc[0]
    return np.asarray(np.diff(values) / step)


def _peak(values: FloatArray) -> float:
    return float(np.abs(values).max()) if values.size else 0.0


@metric(
    Column("human_mean_speed", "float64", "m/s", "mean over humans that ever moved"),
    Column("human_hard_brakes", "int64", "", "times a human began to brake harder than 4.5 m/s²"),
)
def human_metrics(humans: pd.DataFrame) -> dict[str, float]:
    """Mean speed of the humans near the ego, and how often one began to brake hard."""
    moved = humans.groupby("vehicle")["speed"].transform("max") > 0.1
    humans = humans[moved]
    brakes = 0
    for _, car in humans.groupby("vehicle", sort=False):
        time, speed = car["time"].to_numpy(), car["speed"].to_numpy()
        step = np.diff(time)
        # A car may leave the range and come back: such a gap is no braking.
        hard = (np.diff(speed) / step < -HARD_BRAKE - 1e-6) & (step < 1.5 * STEP)
        brakes += int((hard & ~np.concatenate(([False], hard[:-1]))).sum())
    mean_speed = float(humans["speed"].mean()) if len(humans) else np.nan
    return {"human_mean_speed": mean_speed, "human_hard_brakes": brakes}


@metric(
    Column("plan_failures", "int64", "", "steps driven by the fallback"),
    Column("plan_rescues", "int64", "", "steps in which the solver failed and IPOPT did not"),
    Column("interventions", "int64", "", "steps in which the last resort changed the control"),
)
def plan_metrics(plan: pd.DataFrame) -> dict[str, int]:
    """How many steps the fallback drove, IPOPT rescued, the last resort changed."""
    return {
        "plan_failures": int(plan["fallback"].sum()),
        "plan_rescues": int(plan["status"].str.startswith(RESCUED).sum()),
        "interventions": int(plan["intervened"].sum()),
    }


@metric(
    Column(
        "penetration",
        "float64",
        "",
        "mean share of planned cars, ego included, among those in its range; no hidden, special",
    ),
    Column("fleet_size", "int64", "", "distinct cars that planners drove besides the ego"),
    Column("fleet_collisions", "int64", "", "of these, how many touched something while planned"),
    Column(
        "fleet_interventions", "int64", "", "as interventions, over all planned cars but the ego"
    ),
    Column("fleet_failures", "int64", "", "as plan_failures, over all planned cars but the ego"),
)
def fleet_metrics(
    info: Mapping[str, Any], ego: pd.DataFrame, others: pd.DataFrame
) -> dict[str, float]:
    """How many cars planners drove, and how these fared.

    penetration: planned cars over all cars in the ego's sensing range, the ego among both,
    hidden and special vehicles among neither; the mean over the steps driven.
    """
    driven = ego.iloc[:-1].set_index("time")["planned"]
    seen = others[others["visible"] & ~others["vehicle"].isin(info["special"])]
    by_time = seen.groupby("time")["planned"].agg(["sum", "size"]).reindex(driven.index)
    count = by_time.fillna(0.0)
    fleet = info["fleet"]
    return {
        "penetration": float(((count["sum"] + driven) / (count["size"] + 1.0)).mean()),
        "fleet_size": int(others["vehicle"][others["planned"]].nunique()),
        "fleet_collisions": len(fleet["touched"]),
        "fleet_interventions": fleet["interventions"],
        "fleet_failures": fleet["failures"],
    }


@metric(
    Column("plan_ms_median", "float64", "ms", "planner's call, median"),
    Column("plan_ms_p99", "float64", "ms", "planner's call, 99th percentile"),
)
def time_metrics(timing: pd.DataFrame) -> dict[str, float]:
    """Wall time of the planner's call."""
    return {
        "plan_ms_median": float(timing["plan_ms"].median()),
        "plan_ms_p99": float(timing["plan_ms"].quantile(0.99)),
    }
