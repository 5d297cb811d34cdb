"""Metrics on hand-made trajectories with an obvious answer."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from sumo_cohesion.tables import metrics
from sumo_cohesion.tables.intervals import mean_interval, summarize, wilson


def car(name: str, s: np.ndarray, d: float = 0.0, dt: float = 0.1) -> pd.DataFrame:
    speed = np.gradient(s, dt) if len(s) > 1 else np.zeros(1)
    n = len(s)
    return pd.DataFrame(
        {
            "time": np.round(dt * np.arange(n), 6),
            "vehicle": name,
            "planned": False,
            "s": s,
            "d": np.full(n, d),
            "speed": speed,
            "heading": np.zeros(n),
            "road_heading": np.zeros(n),
            "lane": np.zeros(n, dtype=int),
            "length": 5.0,
            "width": 1.8,
        }
    )


TIME = 0.1 * np.arange(51)


def test_gap_ttc_and_drac_by_hand() -> None:
    # 20 m/s behind a car standing 105 m ahead (100 m bumper to bumper), for 4 s: 20 m remain.
    ego = car("ego", 20.0 * TIME[:41])
    lead = car("lead", np.full(41, 105.0))
    result = metrics.gap_metrics(ego, lead)
    assert result["min_gap"] == pytest.approx(20.0)
    assert result["min_ttc"] == pytest.approx(1.0)
    assert result["max_drac"] == pytest.approx(20.0**2 / (2 * 20.0))


def test_cars_beside_behind_or_faster_are_no_threat() -> None:
    ego = car("ego", 20.0 * TIME)
    beside = car("beside", 10.0 + 15.0 * TIME, d=3.5)
    behind = car("behind", -30.0 + 25.0 * TIME)
    result = metrics.gap_metrics(ego, pd.concat([beside, behind]))
    assert all(np.isnan(v) for v in result.values())
    faster = metrics.gap_metrics(ego, car("faster", 30.0 + 25.0 * TIME))
    assert faster["min_gap"] == pytest.approx(25.0)
    assert np.isnan(faster["min_ttc"])


@pytest.mark.parametrize(
    ("aside", "in_path"), [(0.0, True), (1.79, True), (1.81, False), (-1.79, True), (-1.81, False)]
)
def test_a_car_is_in_the_path_if_the_widths_overlap(aside: float, in_path: bool) -> None:
    ego, other = car("ego", 20.0 * TIME, d=7.0), car("a", 60.0 + 10.0 * TIME, d=7.0 + aside)
    assert np.isfinite(metrics.gap_metrics(ego, other)["min_gap"]) == in_path
    assert np.isfinite(metrics.post_encroachment_time(ego, other)) == in_path


def test_closing_in_is_along_the_road_and_however_slowly() -> None:
    # 0.5 m/s at 60 degrees each: 0.25 m/s along the road, 0.9 m apart.
    now = TIME[:1]
    ego, lead = car("ego", now), car("lead", now + 5.9)
    ego["speed"], ego["road_heading"] = 1.5, np.pi / 3
    lead["speed"], lead["road_heading"] = 1.0, -np.pi / 3
    result = metrics.gap_metrics(ego, lead)
    assert result["min_ttc"] == pytest.approx(0.9 / 0.25)
    assert result["max_drac"] == pytest.approx(0.25**2 / 1.8)
    ego["speed"] = 1.0  # as fast as the car ahead: no time, and no braking
    assert np.isnan(metrics.gap_metrics(ego, lead)["min_ttc"])
    assert np.isnan(metrics.gap_metrics(ego, lead)["max_drac"])


def test_at_contact_the_gap_is_nothing_and_the_rest_is_of_the_step_before() -> None:
    ego, lead = car("ego", np.array([0.0, 2.0, 4.0])), car("lead", np.full(3, 8.0))
    result = metrics.gap_metrics(ego, lead)
    assert result["min_gap"] == 0.0
    assert result["min_ttc"] == pytest.approx(1.0 / 20.0)


def test_post_encroachment_of_several_is_the_least_and_counts_from_nothing() -> None:
    ego = car("ego", 20.0 * TIME, d=3.5)
    stands = car("stands", np.full(51, 30.0), d=3.5)
    near, far = (car(n, gap + 5.0 + 20.0 * TIME, d=3.5) for n, gap in (("b", 10.0), ("a", 30.0)))
    for others in ([stands, near, far], [far, near, stands]):
        later = pd.concat(others).assign(time=lambda t: t["time"] + 7.0)
        assert metrics.post_encroachment_time(ego, pd.concat(others)) == pytest.approx(0.5)
        assert metrics.post_encroachment_time(ego.assign(time=TIME + 7.0), later) == pytest.approx(
            0.5
        )
    # However slowly it goes: 2 cm in a step, and the ego comes to where it has just been.
    slow = car("slow", 60.0 + 0.2 * TIME, d=3.5)
    fast = car("ego", 55.0 + 0.3 * TIME, d=3.5)
    assert 0.0 <= metrics.post_encroachment_time(fast, slow) < 0.01
    # Beyond where it was seen last nothing is known of it.
    assert np.isnan(metrics.post_encroachment_time(car("ego", 200.0 + 20.0 * TIME, d=3.5), near))


def test_post_encroachment_time_is_the_time_gap_behind_the_rear() -> None:
    # Both at 20 m/s, centres 45 m apart: the ego's front is 40 m behind the lead's rear: 2 s.
    ego = car("ego", 20.0 * TIME)
    assert metrics.post_encroachment_time(ego, car("a", 45.0 + 20.0 * TIME)) == pytest.approx(2.0)
    assert np.isnan(metrics.post_encroachment_time(ego, car("a", 45.0 + 20.0 * TIME, d=3.5)))
    assert np.isnan(metrics.post_encroachment_time(ego, car("a", np.full(51, 500.0))))


def test_jerk_and_lateral_acceleration() -> None:
    ego = car("ego", 10.0 * TIME)
    ego["speed"] = 10.0 + 0.5 * 3.0 * TIME**2  # jerk 3 m/s³
    assert metrics.max_jerk(ego) == pytest.approx(3.0)
    ego["speed"], ego["heading"] = 20.0, 0.1 * TIME  # yaw rate 0.1 rad/s
    assert metrics.max_lateral_acceleration(ego) == pytest.approx(2.0)
    # Nor when it began, nor where it was heading, nor to which side.
    ego["time"], ego["heading"] = TIME + 7.0, np.pi - 0.1 * TIME
    ego["heading"] = (ego["heading"] + np.pi) % (2 * np.pi) - np.pi
    ego["speed"] = 10.0 - 0.5 * 3.0 * TIME**2
    assert metrics.max_jerk(ego) == pytest.approx(3.0)
    assert metrics.max_lateral_acceleration(ego.assign(speed=20.0)) == pytest.approx(2.0)
    assert metrics.max_jerk(ego[:2]) == 0.0  # two states have one acceleration


def test_hard_brakes_count_onsets_not_steps_and_no_gaps() -> None:
    human = car("a", 20.0 * TIME)
    human["speed"] = np.concatenate(
        [
            np.full(10, 25.0),
            25.0 - 0.6 * np.arange(10),
            np.full(10, 19.0),
            19.0 - 0.5 * np.arange(21),
        ]
    )
    assert metrics.human_metrics(human)["human_hard_brakes"] == 2
    lost = human.drop(index=range(11, 19))
    assert metrics.human_metrics(lost.iloc[:15])["human_hard_brakes"] == 1
    assert metrics.human_metrics(human.iloc[:0])["human_hard_brakes"] == 0


def test_who_comes_back_slower_into_sight_has_not_braked_hard() -> None:
    # 25 m/s, out of sight for 2 s, back with 10 m/s: 7.5 m/s² over the gap.
    human = car("a", 20.0 * TIME)
    human["speed"] = np.where(TIME < 2.0, 25.0, 10.0)
    seen = human[(human["time"] < 1.95) | (human["time"] > 3.85)]
    assert metrics.human_metrics(human)["human_hard_brakes"] == 1
    assert metrics.human_metrics(seen)["human_hard_brakes"] == 0
    # One step that is missing is a gap already.
    assert metrics.human_metrics(human.drop(index=20))["human_hard_brakes"] == 0


def test_humans_are_counted_each_and_only_those_that_drive() -> None:
    brakes = np.where(TIME < 2.0, 20.0, 15.0)
    braking = [car(name, 20.0 * TIME).assign(speed=brakes) for name in ("b", "a")]
    steady = car("c", 30.0 * TIME).assign(speed=30.0)
    parked = car("d", 0.0 * TIME).assign(speed=0.1)
    crawls = car("e", 0.0 * TIME).assign(speed=0.5)
    result = metrics.human_metrics(pd.concat([*braking, steady, parked]))
    assert result["human_hard_brakes"] == 2
    assert result["human_mean_speed"] == pytest.approx((2 * brakes.mean() + 30.0) / 3)
    assert metrics.human_metrics(crawls)["human_mean_speed"] == pytest.approx(0.5)
    assert np.isnan(metrics.human_metrics(parked)["human_mean_speed"])
    # Who comes into sight braking has begun to.
    at_once = car("f", 20.0 * TIME[:3]).assign(speed=[20.0, 19.0, 18.9])
    assert metrics.human_metrics(at_once)["human_hard_brakes"] == 1


def test_hard_is_more_than_what_drivers_find_comfortable() -> None:
    human = car("a", 20.0 * TIME)
    for braking, count in ((4.49, 0), (4.5, 0), (4.51, 1)):
        human["speed"] = 25.0 - braking * np.clip(TIME - 1.0, 0.0, 2.0)
        assert metrics.human_metrics(human)["human_hard_brakes"] == count, braking


def test_off_road_is_when_the_side_crosses_the_edge() -> None:
    plan = pd.DataFrame({"road_right": np.full(51, -1.75), "road_left": np.full(51, 8.75)})
    assert not metrics.off_road(car("ego", TIME, d=-0.84), plan)
    assert metrics.off_road(car("ego", TIME, d=-0.86), plan)
    assert not metrics.off_road(car("ego", TIME, d=7.84), plan)
    assert metrics.off_road(car("ego", TIME, d=7.86), plan)
    # On the edge is on the road; and once is enough.
    exact = pd.DataFrame({"road_right": np.full(51, -0.5), "road_left": np.full(51, 0.5)})
    ego = car("ego", TIME).assign(width=1.0)
    assert not metrics.off_road(ego, exact)
    ego.loc[30, "d"] = 0.01
    assert metrics.off_road(ego, exact)
    # The last row has no plan any more.
    assert not metrics.off_road(ego[:31], exact[:30])


@pytest.mark.parametrize(
    ("conditions", "expected"),
    [
        ({"collision": False}, True),
        ({"collision": True}, False),
        ({"distance": {"min": 600, "max": None}}, True),
        ({"distance": {"min": None, "max": 600}}, False),
        ({"min_ttc": {"min": 1.0}}, False),  # undefined is no success
        ({"collision": False, "distance": {"min": 700}}, False),
        ({"distance": {"min": 650.0}}, True),  # both ends belong to it
        ({"distance": {"max": 650.0}}, True),
        ({}, True),
    ],
)
def test_success_conditions(conditions: dict[str, object], expected: bool) -> None:
    row = {"collision": False, "distance": 650.0, "min_ttc": np.nan}
    assert metrics.succeeded(row, conditions) is expected


def test_wilson_interval_against_the_published_formula() -> None:
    k, n, z = 47, 50, 1.959963984540054
    p = k / n
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert wilson(k, n) == pytest.approx((p, centre - half, centre + half))


def test_mean_interval_covers_and_is_repeatable() -> None:
    values = np.random.default_rng(0).normal(5.0, 1.0, 100).tolist()
    mean, low, high = mean_interval(values)
    assert low < mean < high
    assert high - low == pytest.approx(2 * 1.96 * 0.1, rel=0.25)
    assert mean_interval(values) == (mean, low, high)
    assert mean_interval([3.0, 3.0]) == (3.0, 3.0, 3.0)
    assert mean_interval([3.0]) == (3.0, 3.0, 3.0)
    assert mean_interval([0.0, 0.0, 1.0])[0] == pytest.approx(1 / 3)


def test_summary_counts_only_runs_where_the_metric_is_defined() -> None:
    from sumo_cohesion.tables.metrics import METRICS

    zeros = {"string": "", "bool": False, "int64": 0, "float64": 1.0}
    row = {c.name: zeros[c.dtype] for c in METRICS}
    runs = pd.DataFrame(
        [{**row, "planner": "a", "success": True}, {**row, "planner": "a", "min_ttc": np.nan}]
    )
    summary = summarize(runs).set_index("metric")
    assert summary.loc["success", "value"] == 0.5
    assert summary.loc["min_ttc", "n"] == 1
    assert summary.loc["min_gap", "n"] == 2


def test_emergency_delay_and_yield_time_by_hand() -> None:
    # 33 m/s for 2 s, then held up at 25 m/s for 3 s: 3 · (1 - 25/33) s lost.
    s = np.where(TIME <= 2.0, 33.0 * TIME, 66.0 + 25.0 * (TIME - 2.0))
    ambulance = car("ambulance", s)
    ambulance["speed"] = np.where(TIME <= 2.0, 33.0, 25.0)
    ego = car("ego", 200.0 + 25.0 * TIME)
    ego["d"] = np.where(TIME < 4.0, 7.0, 5.0)
    info = {
        "scenario": {"events": [{"near": None}, {"near": "ambulance"}]},
        "special": ["ambulance"],
        "events": {"1": 1.0},
    }
    result = metrics.emergency_metrics(info, ego, ambulance)
    assert result["emergency_delay"] == pytest.approx(3 * (1 - 25 / 33))
    assert result["yield_time"] == pytest.approx(3.0)
    nothing = metrics.emergency_metrics({**info, "events": {}}, ego, ambulance)
    assert all(np.isnan(v) for v in nothing.values())


def test_the_ego_yields_once_it_is_half_a_lane_right_of_where_it_was() -> None:
    info = {
        "scenario": {"events": [{"near": "ambulance"}]},
        "special": ["ambulance"],
        "events": {"0": 1.0},
    }
    ego, ambulance = car("ego", 25.0 * TIME), car("ambulance", 33.0 * TIME)
    for steps, expected in (([0.0, 1.74, 1.76], 3.0), ([-1.0, 0.74, 0.76], 3.0)):
        right = np.select([TIME < 2.0, TIME < 3.95], steps[:2], steps[2])
        ego["d"] = 7.0 - right
        assert metrics.emergency_metrics(info, ego, ambulance)["yield_time"] == expected
    # From the event on, the step of the event included; two steps are enough to be held up.
    ego["d"] = np.where(TIME < 1.05, 7.0, 0.0)
    assert metrics.emergency_metrics(info, ego, ambulance)["yield_time"] == pytest.approx(0.1)
    two = ambulance[(ambulance["time"] > 0.95) & (ambulance["time"] < 1.15)]
    assert metrics.emergency_metrics(info, ego, two)["emergency_delay"] == pytest.approx(0.0)
    for missing in (
        {**info, "special": []},
        {**info, "scenario": {"events": [{"near": None}]}},
    ):
        nothing = metrics.emergency_metrics(missing, ego, ambulance)
        assert set(nothing) == {"emergency_delay", "yield_time"}
        assert all(np.isnan(v) for v in nothing.values())
    ego["d"] = 7.0 + 2.0 * TIME  # to the left is out of the way of nobody
    assert np.isnan(metrics.emergency_metrics(info, ego, ambulance)["yield_time"])


RESCUE = {"special": ["ambulance"], "hidden": ["stalled"]}


def test_passing_is_the_first_step_with_the_special_vehicle_ahead() -> None:
    ego = car("ego", 100.0 + 20.0 * TIME, d=7.0)
    ego["d"] = 7.0 + 0.2 * TIME
    ego["lane"] = np.where(TIME < 2.0, 2, 1)
    ambulance = car("ambulance", 79.5 + 30.0 * TIME, d=5.25)  # level with the ego after 2.05 s
    result = metrics.passing_metrics(RESCUE, ego, ambulance)
    assert result["passing_lane"] == 1.0
    assert result["passing_shift"] == pytest.approx(0.2 * 2.1)


def test_nobody_is_passed_by_a_special_vehicle_ahead_behind_or_missing() -> None:
    ego = car("ego", 100.0 + 20.0 * TIME)
    ahead = car("ambulance", 101.0 + 30.0 * TIME)
    behind = car("ambulance", 90.0 + 20.0 * TIME)
    for others, info in (
        (ahead, RESCUE),
        (behind, RESCUE),
        (behind.iloc[:0], RESCUE),
        (car("human", 79.5 + 30.0 * TIME), {**RESCUE, "special": []}),
    ):
        result = metrics.passing_metrics(info, ego, others)
        assert set(result) == {"passing_lane", "passing_shift"}
        assert all(np.isnan(value) for value in result.values())


def test_aside_share_compares_each_car_when_the_special_vehicle_is_nearest() -> None:
    # The ambulance is level with the ego at 2 s, with the human ahead at 4 s.
    ambulance = car("ambulance", 30.0 * TIME, d=5.0)
    ego = car("ego", 20.0 + 20.0 * TIME, d=7.0)
    ego["d"] = np.where(TIME < 1.0, 7.0, np.where(TIME < 2.05, 7.6, 9.0))
    human = car("human", 40.0 + 20.0 * TIME, d=7.0)
    human["d"] = np.where(TIME < 3.0, 7.0, np.where(TIME < 4.05, 7.8, 7.0))
    other_lane = car("other", 20.0 + 20.0 * TIME, d=3.5)
    other_lane["d"] = 3.5 - 0.2 * TIME
    other_lane["lane"] = 1
    stalled = car("stalled", np.full(51, 500.0), d=6.0)
    others = pd.concat([ambulance, human, other_lane, stalled])
    assert metrics.aside_share(RESCUE, ego, others) == pytest.approx(0.6 / 0.8)

    mirrored = others.copy()
    mirrored.loc[mirrored["vehicle"] == "human", "d"] *= -1
    assert metrics.aside_share(RESCUE, ego, mirrored) == pytest.approx(-0.6 / 0.8)


def test_aside_share_is_of_those_that_start_in_the_egos_lane_and_from_where_they_start() -> None:
    ambulance = car("ambulance", 30.0 * TIME)
    ego = car("ego", 20.0 + 20.0 * TIME)  # passed after 2 s
    human, other = car("human", 40.0 + 20.0 * TIME), car("other", 40.0 + 20.0 * TIME)
    ego["d"] = np.where(TIME > 0.05, 0.4, 0.0)
    human["d"] = np.where(TIME > 0.05, 0.8, 0.0)
    other["d"] = 5.0 * TIME
    # Both change their lane at once: to be in it later does not count.
    ego["lane"] = np.where(TIME > 0.05, 1, 0)
    human["lane"] = np.where(TIME > 0.05, 2, 0)
    other["lane"] = np.where(TIME > 0.05, 0, 1)
    everybody = pd.concat([ambulance, human, other])
    assert metrics.aside_share(RESCUE, ego, everybody) == pytest.approx(0.5)


def test_aside_share_of_cars_never_passed_is_taken_when_it_is_nearest() -> None:
    ambulance = car("ambulance", 25.0 * TIME)  # gains 5 m/s on both, never reaches them
    ego, human = car("ego", 100.0 + 20.0 * TIME), car("human", 150.0 + 20.0 * TIME)
    ego["d"], human["d"] = 0.1 * TIME, 0.2 * TIME
    both = pd.concat([ambulance, human])
    assert metrics.aside_share(RESCUE, ego, both) == pytest.approx(0.5)


def test_aside_share_is_undefined_without_anybody_who_moved_aside() -> None:
    ego, ambulance = car("ego", 20.0 + 20.0 * TIME), car("ambulance", 30.0 * TIME)
    ego["d"] = 0.5 * TIME
    lazy = car("human", 40.0 + 20.0 * TIME)
    lazy["d"] = np.where(TIME < 3.0, 0.0, 0.29)
    assert np.isnan(metrics.aside_share(RESCUE, ego, pd.concat([ambulance, lazy])))
    assert np.isnan(metrics.aside_share(RESCUE, ego, ambulance))
    lazy["d"] *= 2
    assert np.isfinite(metrics.aside_share(RESCUE, ego, pd.concat([ambulance, lazy])))
    assert np.isnan(metrics.aside_share({**RESCUE, "special": []}, ego, lazy))


def test_speed_gap_closed_by_hand() -> None:
    time = np.round(0.1 * np.arange(201), 6)
    ego, other = car("ego", 26.5 * time), car("a", 30.0 + 27.5 * time)
    other["visible"] = True
    plan = pd.DataFrame({"time": time, "speed_limit": 25.0})
    assert metrics.speed_gap_closed(ego, other, plan) == pytest.approx(0.6)
    # Only those within 80 m are near.
    for away, expected in ((79.5, 1.5 / 2.0), (80.5, 0.6), (-80.5, 0.6)):
        far = car("b", away + 26.5 * time).assign(visible=True, speed=26.5)
        both = pd.concat([other, far])
        assert metrics.speed_gap_closed(ego, both, plan) == pytest.approx(expected)
    other["visible"] = False
    assert np.isnan(metrics.speed_gap_closed(ego, other, plan))


def test_aside_share_does_without_a_human_that_was_out_of_sight_too_soon() -> None:
    ambulance = car("ambulance", 25.0 * TIME)
    ego, human = car("ego", 100.0 + 20.0 * TIME), car("human", 150.0 + 20.0 * TIME)
    ego["d"], human["d"] = 0.1 * TIME, 0.2 * TIME
    gone = car("gone", 300.0 + 20.0 * TIME)[:3]
    others = pd.concat([ambulance[5:], human, gone])
    assert metrics.aside_share(RESCUE, ego, others) == pytest.approx(0.5)


def test_fleet_metrics_by_hand() -> None:
    ego = car("ego", 20.0 * TIME[:5]).assign(planned=True)
    always = car("a", 10.0 + 20.0 * TIME[:5]).assign(planned=True, visible=True)
    half = car("b", 20.0 + 20.0 * TIME[:5]).assign(
        planned=[True, True, False, False, False], visible=[True, True, True, False, False]
    )
    special = car("s", 30.0 + 20.0 * TIME[:5]).assign(visible=True)
    hidden = car("h", 40.0 + 20.0 * TIME[:5]).assign(visible=False)
    fleet = {"touched": {"b": ["h"]}, "interventions": 3, "failures": 2}
    info = {"special": ["s"], "hidden": ["h"], "fleet": fleet}
    result = metrics.fleet_metrics(info, ego, pd.concat([always, half, special, hidden]))
    # Four steps: 3/3, 3/3, 2/3 and, with b out of sight, 2/2; none follows the last row.
    assert result == {
        "penetration": pytest.approx((1.0 + 1.0 + 2 / 3 + 1.0) / 4),
        "fleet_size": 2,
        "fleet_collisions": 1,
        "fleet_interventions": 3,
        "fleet_failures": 2,
    }
    alone = metrics.fleet_metrics(info, ego, pd.concat([hidden]))
    assert alone["penetration"] == 1.0
    # In a step without anybody in sight a SUMO-driven ego is nobody's.
    none = metrics.fleet_metrics(info, ego.assign(planned=False), pd.concat([hidden]))
    assert none["penetration"] == 0.0
