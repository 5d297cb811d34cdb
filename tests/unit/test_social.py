"""Who, what and when: closed-form answers."""

from __future__ import annotations

from dataclasses import replace
from math import atan2, hypot

import casadi as ca
import numpy as np
import pytest

from sumo_cohesion.perception.habit import Habit
from sumo_cohesion.perception.history import History, State
from sumo_cohesion.road import Road
from sumo_cohesion.social.agreement import Agreement, agree, combine, estimate
from sumo_cohesion.social.election import Election, surprise_of
from sumo_cohesion.social.features import DECLARED, FEATURES, social_features
from sumo_cohesion.social.groups import Vote, group_votes
from sumo_cohesion.social.memory import new_history
from sumo_cohesion.social.place import NOWHERE, Place, agree_on_place
from sumo_cohesion.social.settings import CohesionSettings, as_printed
from sumo_cohesion.state import Observation, RoadState

SETTINGS = CohesionSettings(habit=0.0, speed_weight=1.0, place_weight=1.0)
"""The paper's plain mean and variance."""
UNKNOWN = (0.0,) * 5


def observe(
    time: float,
    cars: dict[str, tuple[float, float, float]],
    special: str = "",
    ego: tuple[float, float] = (0.0, 0.0),
) -> Observation:
    """Cars by name: s, d, speed; the ego: s, d."""
    states = np.array([[s, d, 0.0, v] for s, d, v in cars.values()]).reshape(-1, 4)
    return Observation(
        time=time,
        ego=RoadState(*ego, 0.0, 25.0),
        ego_size=(5.0, 1.8),
        ids=tuple(cars),
        states=states,
        sizes=np.tile([5.0, 1.8], (len(cars), 1)),
        curvature=np.zeros(len(cars)),
        voter=tuple(name != special for name in cars),
    )


def history(memory: float = 20.0) -> History:
    return new_history(SETTINGS.model_copy(update={"memory": memory}), 0.1)


def drive(h: History, steps: int, cars: dict[str, tuple[float, float, float, float]]) -> None:
    """Cars by name: s, d, speed along, speed across."""
    for k in range(steps):
        t = 0.1 * k
        h.push(
            observe(t, {n: (s + v * t, d + w * t, hypot(v, w)) for n, (s, d, v, w) in cars.items()})
        )


def test_features_by_hand() -> None:
    psi = dict(zip(FEATURES, social_features((0, 0, 0, 20), (3, 4, 0.3, 20), 1.0), strict=True))
    scale = {feature.name: feature.scale for feature in DECLARED}
    assert psi["lateral"] * scale["lateral"] == pytest.approx(4.0)
    assert psi["longitudinal"] * scale["longitudinal"] == pytest.approx(3.0)
    assert psi["heading"] * scale["heading"] == pytest.approx(0.3)
    assert psi["distance"] * scale["distance"] == pytest.approx(5.0, rel=1e-3)
    assert psi["direction"] * scale["direction"] == pytest.approx(0.8, rel=1e-3)


def test_features_are_the_same_in_casadi_and_for_arrays() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(4, 7)), rng.normal(size=(4, 7))
    arrays = np.array(social_features(before, after, 0.5, 0.01))
    x, y = ca.SX.sym("x", 4), ca.SX.sym("y", 4)
    psi = ca.vertcat(*social_features(ca.vertsplit(x), ca.vertsplit(y), 0.5, 0.01))
    symbolic = ca.Function("psi", [x, y], [psi])
    for k in range(7):
        assert np.asarray(symbolic(before[:, k], after[:, k])).ravel() == pytest.approx(
            arrays[:, k]
        )
        one = social_features(tuple(before[:, k]), tuple(after[:, k]), 0.5, 0.01)
        assert one == pytest.approx(arrays[:, k].tolist())


def test_a_car_that_stands_has_no_direction_and_a_finite_gradient() -> None:
    state = (10.0, 1.0, 0.0, 0.0)
    assert social_features(state, state, 0.5)[4] == 0.0
    y = ca.SX.sym("y", 4)
    psi = ca.vertcat(*social_features(state, ca.vertsplit(y), 0.5))
    jacobian = ca.Function("j", [y], [ca.jacobian(psi, y)])
    assert np.isfinite(np.asarray(jacobian(state))).all()


def test_on_a_curve_equal_speeds_in_two_lanes_are_equal_features() -> None:
    # Both drive 10 m; the outer car's s advances less (radius 100 m, left curve).
    for d in (0.0, -3.5):
        along = 10.0 / (1.0 - 0.01 * d)
        psi = social_features((0, d, 0, 20), (along, d, 0, 20), 0.5, 0.01)
        assert psi[1] * DECLARED[1].scale == pytest.approx(20.0)


def test_history_transitions_span_half_a_second_and_headings_are_of_displacement() -> None:
    h = history()
    drive(h, 20, {"a": (100.0, 0.0, 20.0, 1.0)})
    (track,) = h.in_sight()
    assert track.state[2] == pytest.approx(atan2(1.0, 20.0))
    psi = track.newest()
    assert psi is not None
    assert psi[0] * DECLARED[0].scale == pytest.approx(1.0)
    assert psi[1] * DECLARED[1].scale == pytest.approx(20.0)
    assert psi[2] == pytest.approx(0.0, abs=1e-9)
    assert track.middle_s[-1] == pytest.approx(100.0 + 20.0 * (1.9 - 0.25))
    assert len(track.steps) == 20 - 5


def test_history_bridges_no_gap() -> None:
    h = history()
    for k in range(20):
        seen = {"a": (10.0 * k, 0.0, 20.0)} if k != 10 else {}
        h.push(observe(0.1 * k, seen))
    (track,) = h.in_sight()
    # Steps 5 to 9, and again from 16 on, five steps after it came back.
    assert track.steps == [5, 6, 7, 8, 9, 16, 17, 18, 19]


def test_history_memory_is_bounded() -> None:
    h = history(memory=2.0)
    for k in range(2000):
        # A new car every 10 steps, each seen for 50 steps.
        names = {
            f"car_{c}": (5.0 * (k - 10 * c), 0.0, 50.0) for c in range(k // 10 - 4, k // 10 + 1)
        }
        h.push(observe(0.1 * k, {n: v for n, v in names.items() if v[0] >= 0}))
        assert sum(len(t.steps) for t in h._tracks.values()) <= 5 * 50
        assert len(h._tracks.values()) <= 5 + 4


def test_groups_who_votes_where(highway: Road) -> None:
    h = history()
    # Two cars drove through the ego's place (s = 300) and are now beyond both reaches; one
    # follows in the ego's lane; one is beside it; one comes the other way.
    drive(
        h,
        60,
        {
            "past_1": (270.0, 0.0, 25.0, 0.0),
            "past_2": (250.0, 0.5, 25.0, 0.0),
            "follower": (150.0, 0.0, 25.0, 0.0),
            "beside": (150.0, 3.5, 25.0, 0.0),
        },
    )
    ego = RoadState(300.0, 0.0, 0.0, 25.0)
    votes = group_votes(ego, h, highway, SETTINGS)
    assert len(votes["position"]) == 2
    # follower and beside are at 297.5: 2.5 m behind the ego.
    assert len(votes["lane"]) == 1
    assert len(votes["road"]) == 2
    wide = SETTINGS.model_copy(update={"road_reach": 200.0, "lane_ahead": 200.0})
    votes = group_votes(ego, h, highway, wide)
    assert len(votes["lane"]) == 3
    assert len(votes["road"]) == 4


def told(before: State, after: State, seconds: float, curvature: float) -> tuple[float, ...]:
    """Describe a transition by where it began and ended."""
    return before[0], after[0]


def remembered(cars: dict[str, list[tuple[float, float, float]]]) -> History:
    """Remember cars by name: s, d, heading in each of the last steps; transitions of one step."""
    h = History(0.1, 0.1, 20.0, told, lambda: Habit((0.0,) * 2, 0, 0))
    steps = max(map(len, cars.values()))
    for k in range(steps):
        now = {n: rows[k - steps] for n, rows in cars.items() if steps - k <= len(rows)}
        seen = observe(0.1 * k, {n: (s, d, 20.0) for n, (s, d, _) in now.items()})
        states = seen.states.copy()
        states[:, 2] = [heading for *_, heading in now.values()]
        h.push(replace(seen, states=states))
    return h


def voters(votes: dict[str, list[Vote]], group: str) -> list[float]:
    """Tell who votes, by where it is now."""
    return [vote.features[1] for vote in votes[group]]


REACH = CohesionSettings(
    lane_ahead=30.0, lane_behind=10.0, road_reach=20.0, position_length=5.0, position_width=2.0
)
HERE = RoadState(300.0, 0.0, 0.0, 25.0)


@pytest.mark.parametrize(
    ("reaches", "s", "lane", "road"),
    [
        ((30.0, 10.0, 20.0), (289.9, 290.0, 320.0, 320.1, 330.0, 330.1), (290, 320, 320.1, 330),
         (289.9, 290, 320)),
        ((30.0, 10.0, 40.0), (259.9, 260.0, 340.0, 340.1), (), (260, 340)),
        ((30.0, 50.0, 20.0), (249.9, 250.0, 279.9, 280.0), (250, 279.9, 280), (280,)),
    ],
)  # fmt: skip
def test_reaches_are_to_the_metre_and_whichever_is_farthest(
    highway: Road,
    reaches: tuple[float, float, float],
    s: tuple[float, ...],
    lane: tuple[float, ...],
    road: tuple[float, ...],
) -> None:
    ahead, behind, around = reaches
    update = {"lane_ahead": ahead, "lane_behind": behind, "road_reach": around}
    # Standing still, so that a car is where it was: headings are as reported.
    h = remembered({f"car_{x}": [(x, 0.0, 0.0)] * 2 for x in s})
    votes = group_votes(HERE, h, highway, REACH.model_copy(update=update))
    assert voters(votes, "lane") == list(lane)
    assert voters(votes, "road") == list(road)


def test_who_comes_the_other_way_has_no_vote_and_who_drives_aslant_has(highway: Road) -> None:
    headings = {"aslant": 1.5, "back": 1.6, "oncoming": np.pi, "right": -1.5, "across": np.pi / 2}
    h = remembered({n: [(300.0 + i, 0.0, x)] * 2 for i, (n, x) in enumerate(headings.items())})
    votes = group_votes(HERE, h, highway, REACH)
    for group in ("position", "lane", "road"):
        assert voters(votes, group) == [300.0, 303.0, 304.0], group


def test_who_is_new_has_no_vote_yet_and_keeps_nobody_from_voting(highway: Road) -> None:
    h = remembered({"new": [(301.0, 0.0, 0.0)], "old": [(302.0, 0.0, 0.0)] * 2})
    votes = group_votes(HERE, h, highway, REACH)
    for group in ("position", "lane", "road"):
        assert voters(votes, group) == [302.0], group


def test_a_vote_is_the_newest_transition_with_the_newest_habit(highway: Road) -> None:
    h = remembered({"a": [(296.0, 0.0, 0.0), (298.0, 0.0, 0.0), (301.0, 0.0, 0.0)]})
    (track,) = h.in_sight()
    track.habits[:] = [(1.0, 1.0), (2.0, 3.0)]
    votes = group_votes(HERE, h, highway, REACH)
    assert votes["lane"] == votes["road"] == [Vote((298.0, 301.0), (2.0, 3.0))]


def test_the_vote_of_a_place_is_the_mean_of_what_was_done_there(highway: Road) -> None:
    # Middles at 297 (d 0), 299 (d 4.1), 301 (d 7.5), 303 (d 6.9): near d = 6.1 are the last three.
    way = [(296.0, -0.9), (298.0, 0.9), (300.0, 7.3), (302.0, 7.7), (304.0, 6.1)]
    h = remembered({"a": [(s, d, 0.0) for s, d in way]})
    (track,) = h.in_sight()
    track.habits[:] = [(float(i), 0.0) for i in range(4)]
    for d, expected in ((6.1, (300.0, 302.0, 1.0)), (-2.0, (296.0, 298.0, 0.0))):
        (vote,) = group_votes(HERE._replace(d=d), h, highway, REACH)["position"]
        assert (*vote.features, vote.habit[0]) == pytest.approx(expected), d
    assert group_votes(HERE._replace(d=-2.1), h, highway, REACH)["position"] == []


def test_special_and_oncoming_vehicles_do_not_vote(highway: Road) -> None:
    h = history()
    for k in range(10):
        cars = {"ambulance": (300 + 3.0 * k, 0.0, 30.0), "oncoming": (315 - 3.0 * k, 2.0, 30.0)}
        observation = observe(0.1 * k, cars, special="ambulance")
        states = observation.states.copy()
        states[1, 2] = np.pi
        h.push(replace(observation, states=states))
    votes = group_votes(RoadState(300.0, 0.0, 0.0, 25.0), h, highway, SETTINGS)
    assert votes == {"position": [], "lane": [], "road": []}


def test_agreement_is_mean_and_unbiased_variance() -> None:
    rng = np.random.default_rng(3)
    rows = [tuple(row) for row in rng.normal(size=(6, 5)).tolist()]
    votes = [Vote(row, UNKNOWN) for row in rows]
    group, lonely = agree({"road": votes, "lane": votes[:1]}, SETTINGS)
    assert (group.group, group.n, lonely.group) == ("road", 6, "lane")
    assert group.mean == pytest.approx(np.mean(rows, axis=0))
    assert group.variance == pytest.approx(np.var(rows, axis=0, ddof=1))
    assert group.weight == pytest.approx(1 / (np.var(rows, axis=0, ddof=1) + 2.5e-3))
    assert lonely == Agreement("lane", 1, (0.0,) * 5, (0.0,) * 5, (0.0,) * 5)


def test_few_enough_cars_are_as_many_as_the_setting_says() -> None:
    votes = [Vote((0.1,) * 5, UNKNOWN)] * 3
    for least, heard in ((2, True), (3, True), (4, False)):
        (group,) = agree({"road": votes}, SETTINGS.model_copy(update={"min_cars": least}))
        assert (group.weight[0] > 0.0) is heard


def test_perfect_agreement_has_the_floors_weight() -> None:
    (group,) = agree({"road": [Vote((0.1, 2.0, 0.0, 2.0, 0.3), UNKNOWN)] * 3}, SETTINGS)
    assert group.variance == pytest.approx([0.0] * 5, abs=1e-12)
    assert group.weight == pytest.approx([400.0] * 5)


def test_a_driver_counts_by_its_habits_and_the_group_is_no_surer_than_its_members() -> None:
    # q = 1 / (floor + habit) = 10 and 2: mean 2/12; two drivers' unbiased variance is half their
    # squared distance, whatever they weigh; n / sum q = 1/6.
    mean, variance = estimate([0.0, 1.0], [0.09, 0.49], floor=0.01)
    assert mean == pytest.approx(1 / 6)
    assert variance == pytest.approx(0.5 + 2 / 12 - 0.01)
    # However well they agree, drivers with a habit of 0.09 weigh 1 / (0.09 + floor) at most.
    votes = [Vote((0.5,) * 5, (0.09,) * 5)] * 3
    (group,) = agree({"road": votes}, SETTINGS)
    assert group.weight == pytest.approx([1 / 0.0925] * 5)


def test_speed_features_weigh_less_by_their_setting() -> None:
    settings = SETTINGS.model_copy(update={"speed_weight": 0.25})
    (group,) = agree({"road": [Vote((0.1,) * 5, UNKNOWN)] * 2}, settings)
    assert group.weight == pytest.approx([400.0, 100.0, 400.0, 100.0, 400.0])


def test_habits_are_the_variance_of_a_drivers_older_past() -> None:
    rng = np.random.default_rng(7)
    values = rng.normal(scale=0.5, size=200)
    habit = Habit((0.09,), window=1000, delay=4)
    for i, value in enumerate(values):
        assert habit.variance == (0.09,) or i > 4  # the newest four do not count yet
        habit.see((float(value),))
    old = values[:-4]
    # The prior counts as one value beside the sample's own.
    expected = (0.09 + len(old) * old.var()) / (len(old) + 1)
    assert habit.variance[0] == pytest.approx(expected, rel=0.05)
    # A driver who stops weaving is trusted again, after the window.
    habit = Habit((0.09,), window=20, delay=4)
    for value in [*values, *[0.0] * 100]:
        habit.see((float(value),))
    assert habit.variance[0] < 0.05 * old.var()


def test_without_habits_nobody_has_any() -> None:
    h = history()
    drive(h, 100, {"a": (0.0, 0.0, 25.0, 1.0)})
    (track,) = h.in_sight()
    assert track.habits[-1] == UNKNOWN
    known = new_history(CohesionSettings(), 0.1)
    drive(known, 100, {"a": (0.0, 0.0, 25.0, 0.0)})
    (track,) = known.in_sight()
    assert track.habits[0] == pytest.approx((0.09, 0.0225, 0.09, 0.0225, 0.09))
    assert max(track.habits[-1]) < 0.02


def test_a_habit_is_of_so_many_seconds_and_begins_after_its_delay() -> None:
    """Ten seconds are twenty values of half a second each, of which the newest four wait."""
    h = new_history(CohesionSettings(), 0.1)
    for k in range(60):
        h.push(observe(0.1 * k, {"a": (2.0 * k, 0.5 * (k // 5 % 2), 20.0)}))
    (track,) = h.in_sight()
    changed = [i for i in range(1, 55) if track.habits[i] is not track.habits[i - 1]]
    # The first transition that counts ends in step 5; the fourth after it makes it an old one.
    assert track.steps[changed[0]] == 5 + 4 * 5
    assert h._habit()._window == 20


TURN = Agreement("position", 3, (1.0, 2.5, 0.5, 2.5, 1.0), (0.0,) * 5, (400.0,) * 5)
STRAIGHT = Agreement("road", 4, (0.0, 2.5, 0.0, 2.5, 0.0), (0.0,) * 5, (400.0,) * 5)
SPEED_ONLY = (0.0, 400.0, 0.0, 400.0, 0.0)


def test_only_the_most_surprising_group_steers_but_all_set_the_speed() -> None:
    elected, _ = Election(SETTINGS).elect((TURN, STRAIGHT), NOWHERE, 0.0)
    assert [g.weight for g in elected] == [TURN.weight, SPEED_ONLY]
    # Driving straight is what lane keeping does anyway: it must not freeze an ego in between.
    elected, _ = Election(SETTINGS).elect((STRAIGHT, STRAIGHT), NOWHERE, 0.0)
    assert [g.weight for g in elected] == [SPEED_ONLY, SPEED_ONLY]


def test_a_surprise_keeps_attention_for_a_while() -> None:
    slight = TURN._replace(weight=(1.5, 400.0, 0.0, 400.0, 0.5))  # surprise 2: below 5, above 1
    election = Election(SETTINGS)

    def steers(group: Agreement, time: float) -> bool:
        (elected,), _ = election.elect((group,), NOWHERE, time)
        return elected.weight == group.weight

    assert not steers(slight, 0.0)
    assert steers(TURN, 0.1)
    assert steers(slight, 2.0)
    assert not steers(slight, 2.2)
    assert steers(TURN, 3.0)
    election.reset()
    assert not steers(slight, 3.1)
    assert not steers(slight, 0.0)  # nor in a next run, which begins anew


def test_what_is_no_news_is_none_while_a_surprise_is_remembered_either() -> None:
    """Above 1 is news then, and up to 1 is not."""
    election = Election(SETTINGS)
    election.elect((TURN,), NOWHERE, 0.0)
    for surprise, news in ((1.01, True), (1.0, False), (0.5, False)):
        group = TURN._replace(weight=(surprise, 400.0, 0.0, 400.0, 0.0))
        assert surprise_of(group, NOWHERE) == surprise
        (elected,), _ = election.elect((group,), NOWHERE, 1.0)
        assert (elected.weight == group.weight) is news, surprise


def test_the_threshold_is_the_setting_where_that_is_lower() -> None:
    election = Election(SETTINGS.model_copy(update={"surprise": 0.5}))
    for time in (0.0, 1.0):  # at first, and while it is attentive
        for surprise, news in ((0.51, True), (0.5, False)):
            group = TURN._replace(weight=(surprise, 400.0, 0.0, 400.0, 0.0))
            (elected,), _ = election.elect((group,), NOWHERE, time)
            assert (elected.weight == group.weight) is news, (time, surprise)


def test_what_is_as_much_as_the_threshold_is_no_surprise_yet() -> None:
    just = TURN._replace(weight=(5.0, 400.0, 0.0, 400.0, 0.0))
    election = Election(SETTINGS)
    for time in (0.0, 0.1):  # nor is it remembered as one
        (elected,), _ = election.elect((just,), NOWHERE, time)
        assert elected.weight == SPEED_ONLY


def test_only_a_surprise_prolongs_the_attention() -> None:
    slight = TURN._replace(weight=(1.5, 400.0, 0.0, 400.0, 0.5))
    election = Election(SETTINGS)
    election.elect((TURN,), NOWHERE, 0.0)
    election.elect((slight,), NOWHERE, 1.5)
    (elected,), _ = election.elect((slight,), NOWHERE, 2.0)  # held for less than 2 s
    assert elected.weight == (0.0, 400.0, 0.0, 400.0, 0.0)


def test_surprise_is_of_what_steers_and_of_the_position_groups_place() -> None:
    place = Place(2, (1.0,), (0.0,), (400.0,), 3.0)
    mean, weight = (0.5, 9.0, -2.0, 9.0, 1.0), (4.0, 9.0, 1.0, 9.0, 3.0)
    group = Agreement("position", 3, mean, (0.0,) * 5, weight)
    own = 4.0 * 0.25 + 1.0 * 4.0 + 3.0 * 1.0
    assert surprise_of(group, place) == own + 3.0
    assert surprise_of(group._replace(group="road"), place) == own


def test_only_the_position_group_brings_its_place() -> None:
    place = Place(2, (1.0, 1.0), (0.0, 0.0), (400.0, 300.0), 0.0)
    other = STRAIGHT._replace(group="position")
    turn = TURN._replace(group="road")
    elected, left = Election(SETTINGS).elect((other, turn), place, 0.0)
    assert [g.weight for g in elected] == [SPEED_ONLY, turn.weight]
    assert left == place._replace(weight=(0.0, 0.0))
    elected, left = Election(SETTINGS).elect((TURN, STRAIGHT), place, 0.0)
    assert left == place
    for before, after in zip((TURN, STRAIGHT), elected, strict=True):
        assert after[:4] == before[:4]  # what is silenced is still told


def come_along(
    d: float, cars: dict[str, tuple[float, float, float, float]], steps: int = 60
) -> History:
    """Drive an ego at 25 m/s from s = 150 at d among cars: s, d, speed along, speed across."""
    h = history()
    for k in range(steps):
        t = 0.1 * k
        seen = {n: (s + v * t, c + w * t, hypot(v, w)) for n, (s, c, v, w) in cars.items()}
        h.push(observe(t, seen, ego=(150.0 + 25.0 * t, d)))
    return h


def test_a_place_off_the_lane_centre_is_news_and_one_on_it_is_not(highway: Road) -> None:
    for d, expected in ((1.6, 400.0 * (1.6 / 3.5) ** 2), (0.0, 0.0)):
        h = come_along(1.0, {c: (s, d, 25.0, 0.0) for c, s in (("a", 270.0), ("b", 250.0))})
        ego = RoadState(297.5, d, 0.0, 25.0)
        place = agree_on_place(ego, h, highway, [0.1, 0.5, 1.0], SETTINGS)
        assert place.n == 2
        assert place.surprise == pytest.approx(expected)
        straight = Agreement("position", 2, (0.0, 2.5, 0.0, 2.5, 0.0), (0.0,) * 5, (400.0,) * 5)
        (group,), elected = Election(SETTINGS).elect((straight,), place, 0.0)
        assert (group.weight == straight.weight) is (d > 0)
        assert elected.weight == (place.weight if d > 0 else (0.0,) * 3)


def test_a_lagging_ego_is_told_where_the_others_were(highway: Road) -> None:
    h = come_along(0.0, {c: (s, 1.6, 25.0, 0.0) for c, s in (("a", 270.0), ("b", 250.0))})
    place = agree_on_place(RoadState(297.5, 0.2, 0.0, 25.0), h, highway, [0.1, 0.5], SETTINGS)
    assert place.mean == pytest.approx((1.6, 1.6))
    assert place.weight == pytest.approx((400.0, 400.0))


def test_who_did_not_come_along_has_no_say_on_the_place(highway: Road) -> None:
    h = come_along(0.0, {c: (s, 7.0, 25.0, 0.0) for c, s in (("a", 270.0), ("b", 250.0))})
    place = agree_on_place(RoadState(297.5, 0.0, 0.0, 25.0), h, highway, [0.1], SETTINGS)
    assert place == NOWHERE


def test_who_was_first_seen_ahead_may_have_come_from_anywhere(highway: Road) -> None:
    h = come_along(0.0, {c: (s, 1.6, 25.0, 0.0) for c, s in (("a", 310.0), ("b", 320.0))})
    place = agree_on_place(RoadState(297.5, 0.0, 0.0, 25.0), h, highway, [0.1], SETTINGS)
    assert place == NOWHERE


def test_beyond_where_the_others_are_now_their_place_is_unknown(highway: Road) -> None:
    # They are at 317.5 and 307.5, and both are known to just behind 305.
    h = come_along(0.0, {c: (s, 1.6, 25.0, 0.0) for c, s in (("a", 180.0), ("b", 170.0))}, 56)
    ego = RoadState(297.5, 0.2, 0.0, 25.0)
    place = agree_on_place(ego, h, highway, [0.1, 0.5], SETTINGS)
    assert place.weight == pytest.approx((400.0, 0.0))
    assert place.mean[0] == pytest.approx(1.6)


def test_a_feature_on_which_nobody_has_a_vote_asks_for_nothing() -> None:
    mean, weight = (1.0, 2.0, 3.0, 4.0, 5.0), (0.0, 0.5, 0.0, 4.0, 0.0)
    quiet = Agreement("road", 1, mean, (0.0,) * 5, (0.0,) * 5)
    term = combine([quiet, quiet._replace(weight=weight)])
    assert term.weight == weight
    assert term.target == (0.0, 2.0, 0.0, 4.0, 0.0)


def test_the_formula_as_printed() -> None:
    own = CohesionSettings(beta=0.3, variance_floor=0.1, lane_ahead=30.0, road_reach=40.0)
    printed = as_printed(own)
    changed = {k: v for k, v in printed.model_dump().items() if v != getattr(own, k)}
    assert changed == {
        "lateral_votes": "all",
        "place_weight": 0.0,
        "habit": 0.0,
        "speed_weight": 1.0,
        "interval": 0.1,
        "position_length": 3.0,
        "position_width": 1.85,
    }
    assert as_printed(own.model_copy(update={"transitions": "all"})).transitions == "first"


def test_who_hardly_moves_has_hardly_a_direction() -> None:
    # 5 cm on the way and 5 cm of standstill: the sine is 0.04 over sqrt(2) times 0.05.
    psi = social_features((0, 0, 0, 0), (0.03, 0.04, 0, 0), 0.5)
    assert psi[4] * DECLARED[4].scale == pytest.approx(0.04 / (0.05 * 2**0.5))
    assert psi[3] * DECLARED[3].scale == pytest.approx(0.05 * 2**0.5 / 0.5)


def test_where_too_few_were_seen_nothing_is_asked_and_farther_on_again(highway: Road) -> None:
    # In 5 s the ego is where neither is known to have been.
    h = come_along(0.0, {"a": (250.0, 3.6, 25.0, 0.0), "b": (245.0, 3.4, 25.0, 0.0)}, 40)
    ego = RoadState(262.0, 0.5, 0.0, 25.0)
    settings = SETTINGS.model_copy(update={"position_width": 4.0})
    place = agree_on_place(ego, h, highway, [0.1, 5.0, 0.2], settings)
    assert place.n == 2
    mean, spread = 3.5, 0.02 / 3.5**2
    assert place.mean == pytest.approx((mean, 0.5, mean))
    assert place.variance == pytest.approx((spread, 0.0, spread))
    weight = 1.0 / (spread + 2.5e-3)
    assert place.weight == pytest.approx((weight, 0.0, weight))
    assert place.surprise == pytest.approx(weight * (3.0 / 3.5) ** 2)  # 3 m from the ego


def test_a_place_between_lanes_surprises_by_its_way_to_the_nearest(highway: Road) -> None:
    h = come_along(5.0, {c: (s, 5.0, 25.0, 0.0) for c, s in (("a", 270.0), ("b", 250.0))})
    place = agree_on_place(RoadState(297.5, 5.0, 0.0, 25.0), h, highway, [0.1], SETTINGS)
    assert place.surprise == pytest.approx(400.0 * (1.5 / 3.5) ** 2)  # lanes are at 3.5 and 7


def test_combined_term_differs_from_the_groups_sum_by_a_constant() -> None:
    rng = np.random.default_rng(5)
    groups = [
        Agreement(g, 3, *(tuple(row) for row in rng.uniform(0.1, 2, size=(3, 5)).tolist()))
        for g in ("position", "lane", "road")
    ]
    term = combine(groups)

    def by_group(psi: np.ndarray) -> float:
        return sum(float(np.dot(g.weight, (np.array(g.mean) - psi) ** 2)) for g in groups)

    def combined(psi: np.ndarray) -> float:
        return float(np.dot(term.weight, (np.array(term.target) - psi) ** 2))

    gaps = [by_group(psi) - combined(psi) for psi in rng.normal(size=(10, 5))]
    assert np.ptp(gaps) == pytest.approx(0.0, abs=1e-9)
