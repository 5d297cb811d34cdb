"""Every table's columns: name, dtype, unit, meaning. docs/tables.md is made of this."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from sumo_cohesion.tables.column import Column
from sumo_cohesion.tables.metrics import METRICS

if TYPE_CHECKING:
    import pandas as pd


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
    Column(
        "reward_*",
        "float64",
        "",
        "reward term over the horizon, weighted: lane, edge, speed, car, curvature, acceleration, "
        "those that are off unless they are given a weight, cohesion (beta included), constraints "
        "(penalties), and what a planner of one's own names",
    ),
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

BATCH = (
    Column("run", "string", "", "key: digest of everything that decides the run's result"),
    Column("status", "string", "", "done, error, crash, timeout, memory or changed"),
    Column("reason", "string", "", "why there is no result, or why the planner failed; or empty"),
    Column("attempts", "int64", "", "how often it was tried"),
    Column("wall_time", "float64", "s", "of the last attempt; NaN if it gave no result"),
)
"""Columns before those of a run's metrics. In a run without result all metrics are missing."""

WEIGHTS = (
    Column("term", "string", "", "of the reward: its weight is the setting planner.reward.TERM"),
    Column("default", "float64", "", "the package's own weight; 0 is off"),
    Column("learned", "float64", "", "the weight; the lane's, as a rule, is one"),
    Column("low", "float64", "", "5 % quantile of a bootstrap over runs; NaN if there is none"),
    Column("high", "float64", "", "95 % quantile of it"),
    Column(
        "error",
        "float64",
        "",
        "standard error of the weight's logarithm, from the likelihood's curvature; 0 of what is "
        "held and of what the others are relative to",
    ),
    Column("identified", "bool", "", "learned, or what the others are relative to"),
    Column("kept_default", "string", "", "why it was not learned; or empty"),
    Column("share", "float64", "", "of the reward's curvature, mean of the segments that are kept"),
)

SEGMENTS = (
    Column("run", "string", "", "run, file or vehicle; what the bootstrap draws"),
    Column("vehicle", "string", "", "whose driving"),
    Column("time", "float64", "s", "when it begins"),
    Column("log_likelihood", "float64", "nats", "of its scaled controls; NaN if it was dropped"),
    Column("free", "float64", "", "f, controls that no bound holds; NaN if it was dropped"),
    Column("misfit", "float64", "", "q / f, about one where the reward fits; NaN if dropped"),
    Column("kept", "bool", "", "part of the last fit"),
    Column("reason", "string", "", "if not: trimmed, or why it was dropped; or empty"),
)

FIT = (
    Column("model", "string", "", "learned, default (at its best scale), or one without a reward"),
    Column("log_likelihood", "float64", "nats/s", "median of the segments that were held out"),
    Column("off_1s", "float64", "m", "mean distance of prediction and driving after 1 s"),
    Column("off_2s", "float64", "m", "after 2 s; NaN if segments are shorter"),
    Column("off_3s", "float64", "m", "after 3 s; NaN if segments are shorter"),
    Column("windows", "int64", "", "how many pieces of driving were predicted"),
)

PREDICTIONS = (
    Column("example", "int64", "", "which piece of driving that was held out"),
    Column("run", "string", "", "as in segments"),
    Column("model", "string", "", "as in fit"),
    Column("horizon", "float64", "s", "how far ahead"),
    Column("off", "float64", "m", "distance of prediction and driving"),
)

LEARNED: dict[str, Sequence[Column]] = {
    "weights": WEIGHTS,
    "segments": SEGMENTS,
    "fit": FIT,
    "predictions": PREDICTIONS,
}
"""What learn finds; those of a run are apart."""

TABLES: dict[str, Sequence[Column]] = {
    "trajectory": TRAJECTORY,
    "plan": PLAN,
    "horizon": HORIZON,
    "agreement": AGREEMENT,
    "timing": TIMING,
    "reference": REFERENCE,
    "metrics": METRICS,
}


def as_table(
    name: str, data: Mapping[str, object] | Sequence[Mapping[str, object]]
) -> pd.DataFrame:
    """Make a DataFrame with the columns and dtypes of the named table, from columns or rows.

    Of columns that it does not name those remain that one of its names with a star stands for.
    """
    import pandas as pd

    told = data if isinstance(data, Mapping) else {key: None for row in data for key in row}
    dtypes: dict[str, str] = {}
    for column in (TABLES | LEARNED)[name]:
        if column.name.endswith("*"):
            found = [key for key in told if key.startswith(column.name[:-1])]
            dtypes |= dict.fromkeys(found, column.dtype)
        else:
            dtypes[column.name] = column.dtype
    return pd.DataFrame(data, columns=list(dtypes)).astype(dtypes)


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
        "`weights`, `segments`, `fit` and `predictions` are what `learn` finds",
        "([learning.md](learning.md)); it writes them with `--report`.\n",
    ]
    for name, columns in {**TABLES, "batch": BATCH, **LEARNED}.items():
        parts += [f"## {name}\n", "| column | type | unit | meaning |", "|---|---|---|---|"]
        parts += [f"| {c.name} | {c.dtype} | {c.unit} | {c.meaning} |" for c in columns]
        parts.append("")
    return "\n".join(parts)
