"""The paper's figures show what the tables say."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.patches import Rectangle

from sumo_cohesion import Rollout, UserError, run
from sumo_cohesion.planning.landscape import PLACES, reward_landscape
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.report import drawing, paper
from sumo_cohesion.road import Road
from sumo_cohesion.state import Observation, RoadState

CAR = (5.0, 1.8)
SHORT = {"duration": 3.0}


@pytest.fixture(scope="module")
def same_speed() -> tuple[Rollout, Rollout]:
    nominal, cohesive = (run("same_speed", p, 0, overrides=SHORT) for p in ("nominal", "cohesive"))
    return nominal, cohesive


@pytest.fixture(scope="module")
def swerve() -> tuple[Rollout, Rollout]:
    # Starts shortly before the stalled car's place, with nobody to follow yet.
    near = SHORT | {"ego.position": 640.0}
    nominal, cohesive = (
        run("stalled_swerve", p, 0, overrides=near) for p in ("nominal", "cohesive")
    )
    return nominal, cohesive


def boxes(axis: Axes) -> list[Rectangle]:
    return [patch for patch in axis.patches if isinstance(patch, Rectangle)]


def centre(box: Rectangle) -> tuple[float, float]:
    return box.get_x() + box.get_width() / 2, box.get_y() + box.get_height() / 2


def line(axis: Axes, label: str) -> np.ndarray:
    (found,) = [one for one in axis.lines if one.get_label() == label]
    return np.column_stack(found.get_data())


def looking_at(cars: list[tuple[float, float, float, float]]) -> Observation:
    return Observation(
        time=0.0,
        ego=RoadState(500.0, 0.0, 0.0, 25.0),
        ego_size=CAR,
        ids=tuple(f"car_{i}" for i in range(len(cars))),
        states=np.array(cars, dtype=float).reshape(-1, 4),
        sizes=np.tile(CAR, (len(cars), 1)),
        curvature=np.zeros(len(cars)),
        voter=(True,) * len(cars),
    )


def test_the_landscape_has_the_rewards_closed_form(highway: Road) -> None:
    weights = RewardWeights(car=7.0, lane=2.0, edge=3.0)
    s, d = np.array([500.0, 520.0, 525.0]), np.array([-1.75, 0.0, 3.5])
    terms = reward_landscape(
        looking_at([(520.0, 3.5, 0.0, 20.0)]), highway, PlannerSettings(reward=weights), s, d
    )
    assert tuple(terms) == PLACES
    assert {values.shape for values in terms.values()} == {(3, 3)}
    # One standard deviation along is both half lengths: 5 m. Four behind, none, one ahead.
    assert terms["car"][2] == pytest.approx(-7.0 * np.exp([-8.0, 0.0, -0.5]))
    # A lane's centre; the neighbour lane is four standard deviations away.
    assert terms["lane"][1] == pytest.approx([2.0 * (1 + np.exp(-8.0))] * 3, abs=1e-4)
    # With its centre on the edge the ego is half its width and the margin too far out.
    assert terms["edge"][0] == pytest.approx([-3.0 * (0.9 + 0.3) ** 2] * 3)
    assert terms["edge"][1:] == pytest.approx(0.0)


def test_a_landscape_without_cars_costs_nothing_there(highway: Road) -> None:
    s, d = np.linspace(480.0, 520.0, 5), np.linspace(-1.0, 8.0, 4)
    terms = reward_landscape(looking_at([]), highway, PlannerSettings(), s, d)
    assert terms["car"] == pytest.approx(0.0)


def test_features_show_the_maps_and_the_cars_of_that_step(
    same_speed: tuple[Rollout, Rollout],
) -> None:
    nominal, _ = same_speed
    s, d = np.linspace(150.0, 450.0, 31), np.linspace(-2.0, 9.0, 12)
    terms = {
        name: np.arange(31 * 12, dtype=float).reshape(12, 31) + i for i, name in enumerate("ab")
    }
    figure = paper.draw_features(nominal, 1.52, s, d, terms)
    maps = [axis for axis in figure.axes if axis.images]
    assert len(maps) == 2
    now = nominal.trajectory[nominal.trajectory["time"].round(3) == 1.5]
    for axis, values in zip(maps, terms.values(), strict=True):
        (image,) = axis.images
        assert np.array_equal(image.get_array(), values)
        red, _, blue, _ = image.cmap(image.norm(values.max()))
        assert red > blue
        shown = sorted(centre(box) for box in boxes(axis))
        assert np.array(shown) == pytest.approx(now[["s", "d"]].sort_values("s").to_numpy())


@pytest.mark.slow
def test_humans_that_only_drive_faster_are_drawn_as_speeds() -> None:
    pair = tuple(run("speeding", p, 0, overrides=SHORT) for p in ("nominal", "cohesive"))
    figure = paper.draw_scenarios([(pair[0], pair[1])])
    (axis,) = figure.axes
    for rollout in pair:
        ego = drawing.ego_of(rollout)[["time", "speed"]].to_numpy()
        assert np.array_equal(line(axis, rollout.info["planner"]), ego)
    humans = drawing.humans_of(pair[1])
    assert "ego" not in set(humans["vehicle"])
    mean = humans.groupby("time")["speed"].mean()
    assert line(axis, "humans' mean")[:, 1] == pytest.approx(mean.to_numpy())
    (band,) = [c for c in axis.collections if isinstance(c, PolyCollection)]
    heights = band.get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (humans["speed"].min(), humans["speed"].max())


@pytest.mark.slow
def test_scenario_panels_show_nominal_above_cohesive_where_they_part(
    swerve: tuple[Rollout, Rollout],
) -> None:
    nominal, cohesive = swerve
    assert nominal.info["touched"] == ["stalled"]
    # The same run, moved over: the egos part at once.
    table = cohesive.trajectory
    table = table.assign(d=table["d"].mask(table["vehicle"] == "ego", table["d"] + 1.7))
    upper, lower = paper.draw_scenarios([(nominal, replace(cohesive, trajectory=table))]).axes
    assert upper.get_title("left") == "nominal: collides with stalled"
    assert lower.get_title("left").startswith("cohesive: ")
    assert upper.get_shared_x_axes().joined(upper, lower)
    # Its last box is the ego where it touched, in full colour; earlier ones are fainter.
    blue = to_hex("tab:blue")
    full = [box for box in boxes(upper) if to_hex(box.get_facecolor()) == blue]
    last = drawing.ego_of(nominal).iloc[-1]
    assert [centre(box) for box in full] == [pytest.approx((last["s"], last["d"]))]
    grey = [box for box in boxes(upper) if to_hex(box.get_facecolor()) == "#999999"]
    stalled = nominal.trajectory[nominal.trajectory["vehicle"] == "stalled"].iloc[0]
    assert [centre(box) for box in grey] == [pytest.approx((stalled["s"], stalled["d"]))]
    orange = [b for b in boxes(lower) if np.ptp(b.get_facecolor()[:3]) > 0.1]
    strength = [1.0 - box.get_facecolor()[2] for box in sorted(orange, key=centre)]
    assert strength == sorted(strength)
    assert len(set(strength)) == len(strength) > 1


@pytest.mark.slow
def test_an_ambulance_is_drawn_beside_a_car_at_the_limit() -> None:
    pair = [run("ambulance", p, 0, overrides={"duration": 20.0}) for p in ("nominal", "cohesive")]
    upper, _ = paper.draw_scenarios([(pair[0], pair[1])]).axes
    assert upper.get_title("left") == "nominal: does not make way"
    red = [b for b in boxes(upper) if b.get_facecolor()[0] > 0.8 > b.get_facecolor()[1]]
    at = [centre(box)[0] for box in red]
    assert at == sorted(at)
    # Nominal keeps the limit: it stays at 0 while the ambulance comes nearer.
    ego = [line for line in upper.lines if line.get_color() == "tab:blue"]
    assert np.abs(ego[0].get_xdata()).max() < 1.0
    table = pair[0].trajectory
    ambulance = table[table["vehicle"] == "ambulance"].set_index("time")["s"]
    start = max(pair[0].info["events"].values())
    time = ambulance.index[int(np.abs(ambulance.index - start).argmin())]
    first = ambulance[time] - (table["s"].iloc[0] + 25.0 * (time - table["time"].iloc[0]))
    assert at[0] == pytest.approx(first, abs=0.01)


def test_nothing_to_match_lays_both_egos_over_one_another(
    same_speed: tuple[Rollout, Rollout],
) -> None:
    paths, speeds = paper.draw_nothing_to_match(*same_speed).axes
    for rollout in same_speed:
        planner = rollout.info["planner"]
        ego = drawing.ego_of(rollout)
        assert np.array_equal(line(paths, planner), ego[["s", "d"]].to_numpy())
        assert np.array_equal(line(speeds, planner), ego[["time", "speed"]].to_numpy())
        humans = drawing.humans_of(rollout)
        first = humans[humans["vehicle"] == humans["vehicle"].iloc[0]]
        around = line(paths, f"humans around {planner}")
        assert np.array_equal(around, first[["s", "d"]].to_numpy())


def test_precision_is_one_over_variance_and_floor_where_enough_cars_vote(
    same_speed: tuple[Rollout, Rollout],
) -> None:
    _, cohesive = same_speed
    rows = cohesive.agreement
    rows = rows[(rows["group"] == "road") & (rows["feature"] == "distance")].set_index("time")
    cohesion = cohesive.info["cohesion"]
    table = paper.precision(cohesive)
    assert list(table.columns) == ["lateral", "longitudinal", "heading", "distance", "direction"]
    few = rows["n"] < cohesion["min_cars"]
    assert few.any()
    assert not few.all()
    expected = 1.0 / (rows["variance"][~few] + cohesion["variance_floor"])
    assert table["distance"][~few].to_numpy() == pytest.approx(expected.to_numpy())
    assert table["distance"][few].isna().all()
    most = {"cohesion": cohesion | {"min_cars": int(rows["n"].max())}}
    strict = paper.precision(replace(cohesive, info=cohesive.info | most))
    assert strict["distance"].notna().tolist() == (rows["n"] == rows["n"].max()).tolist()
    # Lateral features have a precision, though the road group has no vote on them.
    given = cohesive.agreement[cohesive.agreement["feature"] == "lateral"]
    assert (given[given["group"] == "road"]["weight"] == 0.0).any()
    assert (table["lateral"].dropna() > 0.0).all()
    left, right = paper.draw_common_feature(*same_speed).axes
    assert left.get_yscale() == "log"
    drawn = line(left, paper.FEATURE_LABELS["distance"])[:, 1]
    assert np.array_equal(drawn, table["distance"].to_numpy(), equal_nan=True)
    assert len(line(right, "cohesive")) == len(drawing.ego_of(cohesive))


@pytest.mark.slow
def test_noise_has_a_panel_per_level_and_says_how_it_went(
    swerve: tuple[Rollout, Rollout],
) -> None:
    nominal, cohesive = swerve
    figure = paper.draw_noise([("0 m", nominal), ("0 m", cohesive), ("1 m", nominal)])
    both, alone = figure.axes
    assert both.get_title("left").startswith("0 m: nominal collides with stalled; cohesive ")
    assert alone.get_title("left") == "1 m: nominal collides with stalled"
    ego = drawing.ego_of(nominal)
    (path,) = [drawn for drawn in alone.lines if drawn.get_color() == "tab:blue"]
    assert np.array_equal(path.get_xdata(), ego["s"].to_numpy())
    assert len(boxes(alone)) == 2  # the ego and the stalled car


def test_rates_are_points_with_their_intervals() -> None:
    columns = ["claim", "scenario", "planner", "rate", "low", "high", "n"]
    rows = [
        ("passes", "stalled", "nominal", 0.0, 0.0, 0.07, 50),
        ("passes", "stalled", "cohesive", 1.0, 0.93, 1.0, 50),
        ("yields", "ambulance", "cohesive", 0.9, 0.7, 0.97, 20),
    ]
    (axis,) = paper.draw_rates(pd.DataFrame(rows, columns=columns)).axes
    assert [label.get_text() for label in axis.get_yticklabels()] == [
        "passes\nstalled",
        "yields\nambulance",
    ]
    nominal, cohesive = axis.containers
    assert list(nominal.lines[0].get_xdata()) == [0.0]
    assert list(cohesive.lines[0].get_xdata()) == [1.0, 0.9]
    (bars,) = cohesive.lines[2]
    ends = [segment[:, 0].tolist() for segment in bars.get_segments()]
    assert ends == [pytest.approx([0.93, 1.0]), pytest.approx([0.7, 0.97])]
    assert "20 to 50" in axis.get_xlabel()


def test_an_exit_ends_one_strip_of_road_and_begins_another(
    same_speed: tuple[Rollout, Rollout],
) -> None:
    nominal, _ = same_speed
    assert drawing.lane_lines(nominal) == pytest.approx([1.75, 5.25])
    away = nominal.plan.index >= 20
    plan = nominal.plan.assign(
        road_left=nominal.plan["road_left"].where(~away, -2.0),
        on_exit=away,
    )
    leaving = replace(nominal, plan=plan)
    assert drawing.lane_lines(leaving) == pytest.approx([1.75, 5.25])
    axis = drawing.new_figure(4, 3).subplots()
    drawing.draw_road(axis, [leaving], (0.0, 1000.0))
    _, left = (one.get_ydata() for one in axis.lines[:2])
    assert np.flatnonzero(np.isnan(left)).tolist() == [20]


@pytest.mark.slow
def test_the_same_figure_gives_the_same_file(
    tmp_path: Path, same_speed: tuple[Rollout, Rollout]
) -> None:
    files = [
        drawing.save(paper.draw_common_feature(*same_speed), tmp_path / f"{i}.png", dpi=60)
        for i in range(2)
    ]
    assert len({hashlib.sha256(file.read_bytes()).hexdigest() for file in files}) == 1
    with pytest.raises(UserError, match="cannot be written"):
        drawing.save(drawing.new_figure(1, 1), tmp_path / "nowhere" / "a.png")
