"""Every table's columns: name, dtype, unit, meaning. docs/tables.md is made of this."""

from __future__ import annotations

from typing import NamedTuple

import pandas as pd


class Column(NamedTuple):
    """One column of a table."""

    name: str
    dtype: str
    unit: str
    meaning: str


TRAJECTORY = (
    Column("time", "float64", "s", "SUMO time"),
    Column("vehicle", "string", "", "SUMO id; the ego is 'ego'"),
    Column("visible", "bool", "", "the ego's perception saw it"),
    Column("planned", "bool", "", "a planner drove it in the step from here; else SUMO did"),
    Column("x", "float64", "m", "centre, east"),
    Column("y", "float64", "m", "centre, north"),
    Column("heading", "float64", "rad", "counter-clockwise from east"),
    Column("speed", "float64", "m/s", "as SUMO reports it"),
    Column("s", "float64", "m", "centre, along the ego's route"),
    Column("d", "float64", "m", "centre, left of the reference line"),
    Column("road_heading", "float64", "rad", "heading relative to the road"),
    Column("lane", "int64", "", "nearest lane of the route, 0 = rightmost; exits come last"),
    Column("length", "float64", "m", "vehicle length"),
    Column("width", "float64", "m", "vehicle width"),
)

PLAN = (
    Column("time", "float64", "s", "SUMO time at which the plan was made"),
    Column("status", "string", "", "solved, rescued by ipopt, sumo, or why the plan is a fallback"),
    Column(
        "fallback", "bool", "", "no usable plan: the last one went on, or the ego braked in lane"
    ),
    Column("intervened", "bool", "", "the last resort changed the control; the status says why"),
    Column("iterations", "int64", "", "solver iterations"),
    Column("curvature", "float64", "1/m", "driven control; NaN if SUMO drives"),
    Column(
        "acceleration", "float64", "m/s²", "driven control, before friction; NaN if SUMO drives"
    ),
    Column("road_right", "float64", "m", "d of the drivable strip's right edge at the ego"),
    Column("road_left", "float64", "m", "d of the drivable strip's left edge at the ego"),
    Column("on_exit", "bool", "", "nearest to an exit, and off its route by more than a lane"),
    Column("speed_limit", "float64", "m/s", "of the ego's route at the ego"),
    Column("reward_lane", "float64", "", "reward term over the horizon, weighted"),
    Column("reward_edge", "float64", "", "reward term over the horizon, weighted"),
    Column("reward_speed", "float64", "", "reward term over the horizon, weighted"),
    Column("reward_car", "float64", "", "reward term over the horizon, weighted"),
    Column("reward_curvature", "float64", "", "reward term over the horizon, weighted"),
    Column("reward_acceleration", "float64", "", "reward term over the horizon, weighted"),
    Column("reward_cohesion", "float64", "", "cohesion term, beta included"),
    Column("reward_constraints", "float64", "", "penalties for being too close to a visible car"),
)

HORIZON = (
    Column("time", "float64", "s", "SUMO time at which the plan was made"),
    Column("stage", "int64", "", "steps from then: 1 is where the driven control leads"),
    Column("s", "float64", "m", "planned, along the ego's route"),
    Column("d", "float64", "m", "planned, left of the reference line"),
    Column("road_heading", "float64", "rad", "planned, relative to the road"),
    Column("speed", "float64", "m/s", "planned"),
)

AGREEMENT = (
    Column("time", "float64", "s", "SUMO time"),
    Column("group", "string", "", "position, lane or road"),
    Column("feature", "string", "", "social feature; 'place' is where across the road, in lanes"),
    Column("n", "int64", "", "cars that voted"),
    Column("mean", "float64", "", "of the normalised feature, each car by its reliability"),
    Column("variance", "float64", "", "of what the cars do, their habits included"),
    Column("precision", "float64", "", "1 / (variance + floor); NaN: too few cars to agree"),
    Column("weight", "float64", "", "precision as it counts; 0: the group has no vote on it"),
    Column("own", "float64", "", "the ego's value if it keeps its course"),
    Column("pull", "float64", "", "beta · weight · (mean − own)²: what ignoring it would cost"),
)

TIMING = (
    Column("time", "float64", "s", "SUMO time"),
    Column("perception_ms", "float64", "ms", "scene to observation and history"),
    Column("social_ms", "float64", "ms", "groups, features, agreement"),
    Column("solver_ms", "float64", "ms", "inside the solver"),
    Column("plan_ms", "float64", "ms", "the planner's whole call"),
    Column("fleet_ms", "float64", "ms", "perception and planning of all planned cars but the ego"),
    Column("sumo_ms", "float64", "ms", "SUMO's step, and reading the next scene"),
)

REFERENCE = (
    Column("time", "float64", "s", "SUMO time"),
    Column(
        "plan_lateral", "float64", "m", "largest change of d within the horizon, plan minus nominal"
    ),
    Column(
        "plan_speed",
        "float64",
        "m/s",
        "largest change of speed within the horizon, plan minus nominal",
    ),
    Column("twin_s", "float64", "m", "the nominal twin: along the ego's route"),
    Column("twin_d", "float64", "m", "the nominal twin: left of the reference line"),
    Column("twin_speed", "float64", "m/s", "the nominal twin"),
)

METRICS = (
    Column("scenario", "string", "", "scenario name"),
    Column("planner", "string", "", "planner name"),
    Column("seed", "int64", "", "seed of demand and SUMO"),
    Column("success", "bool", "", "every condition of the scenario's [success] holds"),
    Column("outcome", "string", "", "why it ended: collision, finished, route_end, left_route"),
    Column("collision", "bool", "", "the ego's box touched another's"),
    Column("collision_with", "string", "", "id of the car touched, empty if none"),
    Column("collision_time", "float64", "s", "seconds after the start; NaN if none"),
    Column("collision_visible", "bool", "", "the car touched was one the ego could see"),
    Column("sumo_collision", "bool", "", "SUMO itself reported a contact of the ego"),
    Column("off_road", "bool", "", "the ego's side left the drivable strip"),
    Column("exited", "bool", "", "the ego left its route by an exit, judged by geometry"),
    Column("distance", "float64", "m", "driven along the route"),
    Column("travel_time", "float64", "s", "from start to end of the run"),
    Column("mean_speed", "float64", "m/s", "distance / travel time"),
    Column(
        "speed_gap_closed",
        "float64",
        "",
        "share of the humans' gap to the limit, 5 to 15 s after the start",
    ),
    Column("max_excess_speed", "float64", "m/s", "largest, over the mean of the humans in 80 m"),
    Column("max_lateral_shift", "float64", "m", "largest distance across from where it started"),
    Column("max_speed_shift", "float64", "m/s", "largest difference from the limit"),
    Column(
        "speed_most_agreed",
        "float64",
        "",
        "share of steps in which the road group agrees most on the two features of speed",
    ),
    Column("plan_lateral_change", "float64", "m", "largest, what cohesion changed in one plan"),
    Column("plan_speed_change", "float64", "m/s", "largest, what cohesion changed in one plan"),
    Column("twin_lateral_deviation", "float64", "m", "largest distance across from the twin"),
    Column("twin_speed_deviation", "float64", "m/s", "largest difference from the twin"),
    Column("nominal_lateral_deviation", "float64", "m", "as twin, but from nominal's own run"),
    Column("nominal_speed_deviation", "float64", "m/s", "as twin, but from nominal's own run"),
    Column("emergency_delay", "float64", "s", "lost by the special vehicle since the first event"),
    Column("yield_time", "float64", "s", "from the first event to the ego being half a lane right"),
    Column("passing_lane", "float64", "", "ego's lane as the special vehicle passes; NaN if never"),
    Column("passing_shift", "float64", "m", "ego's way to the left from its start until then"),
    Column(
        "aside_share",
        "float64",
        "",
        "ego's way aside over that of its lane's humans, 0.3 m or more",
    ),
    Column("lane_changes", "int64", "", "changes of the ego's nearest lane"),
    Column("min_gap", "float64", "m", "smallest bumper-to-bumper gap to a car ahead in its path"),
    Column("min_ttc", "float64", "s", "smallest time to collision; NaN if never closing in"),
    Column("max_drac", "float64", "m/s²", "largest deceleration needed to avoid a crash"),
    Column("pet", "float64", "s", "smallest post-encroachment time behind another; NaN if none"),
    Column("max_jerk", "float64", "m/s³", "largest change of the ego's acceleration"),
    Column(
        "max_lateral_acceleration",
        "float64",
        "m/s²",
        "largest speed · yaw rate of the ego; SUMO's own turns in steps where lanes bend",
    ),
    Column("human_mean_speed", "float64", "m/s", "mean over humans that ever moved"),
    Column("human_hard_brakes", "int64", "", "times a human began to brake harder than 4.5 m/s²"),
    Column("plan_failures", "int64", "", "steps driven by the fallback"),
    Column("plan_rescues", "int64", "", "steps in which the solver failed and IPOPT did not"),
    Column("interventions", "int64", "", "steps in which the last resort changed the control"),
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
    Column("plan_ms_median", "float64", "ms", "planner's call, median"),
    Column("plan_ms_p99", "float64", "ms", "planner's call, 99th percentile"),
)

BATCH = (
    Column("run", "string", "", "key: digest of everything that decides the run's result"),
    Column("status", "string", "", "done, error, crash, timeout, memory or changed"),
    Column("reason", "string", "", "why there is no result, or why the planner failed; or empty"),
    Column("attempts", "int64", "", "how often it was tried"),
    Column("wall_time", "float64", "s", "of the last attempt; NaN if it gave no result"),
)
"""Columns before those of a run's metrics. In a run without result all metrics are missing."""

OF_REFERENCE = (
    "plan_lateral_change",
    "plan_speed_change",
    "twin_lateral_deviation",
    "twin_speed_deviation",
)
"""Metrics that need a scenario's ``reference``."""

TABLES = {
    "trajectory": TRAJECTORY,
    "plan": PLAN,
    "horizon": HORIZON,
    "agreement": AGREEMENT,
    "timing": TIMING,
    "reference": REFERENCE,
    "metrics": METRICS,
}


def as_table(name: str, data: dict[str, object] | list[dict[str, object]]) -> pd.DataFrame:
    """Make a DataFrame with exactly the columns and dtypes of the named table."""
    columns = TABLES[name]
    frame = pd.DataFrame(data, columns=[c.name for c in columns])
    return frame.astype({c.name: c.dtype for c in columns})


def describe_tables() -> str:
    """Describe all tables in Markdown: docs/tables.md is this text."""
    parts = [
        "# Tables\n",
        "Every run's folder holds these tables as parquet, and `run.json`: scenario, planner,",
        "settings, seed, versions and outcome. Made from `sumo_cohesion/tables/columns.py` by",
        "`make docs`.\n",
        "A batch's metrics have the columns of `batch`, then scenario, planner, the names of the",
        "grid and seed, then the rest of `metrics`. Tables that a batch kept have the column `run`",
        "too; its table `ego` is the ego's part of `trajectory`.\n",
    ]
    for name, columns in {**TABLES, "batch": BATCH}.items():
        parts += [f"## {name}\n", "| column | type | unit | meaning |", "|---|---|---|---|"]
        parts += [f"| {c.name} | {c.dtype} | {c.unit} | {c.meaning} |" for c in columns]
        parts.append("")
    return "\n".join(parts)
