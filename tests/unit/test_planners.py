"""What a user's planner returns, or raises: one line that says what to mend."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sumo_cohesion import UserError
from sumo_cohesion.planning.planners import UnusablePlanError, accepted, described, start
from sumo_cohesion.state import Control, Plan

GOOD = (Control(0.0, 1.0),)
STATES = np.empty((0, 4))


def plan_of(controls: Any, status: Any = "straight on", **more: Any) -> Plan:
    return Plan(controls=controls, states=STATES, status=status, **more)


@pytest.mark.parametrize(
    ("plan", "needles"),
    [
        (GOOD, ["returned a tuple", "return Plan(controls=(Control(curvature, acceleration),)"]),
        (Control(0.0, 1.0), ["returned a Control", "return Plan("]),
        (None, ["returned nothing", "return Plan("]),
        ("left", ["returned the text 'left'", "return Plan("]),
        (np.zeros(2), ["returned a ndarray", "return Plan("]),
        (plan_of("left"), ["the text 'left' as controls", "Control(0.0, 1.0)"]),
        (plan_of("ab"), ["the text 'ab' as controls"]),
        (plan_of(None), ["nothing as controls"]),
        (plan_of(Control(0.0, 1.0)), ["a Control as controls", "tuple"]),
        (plan_of((Control("a", "b"),)), ["as controls"]),  # type: ignore[arg-type]
        (plan_of(((0.0, 1.0, 2.0),)), ["as controls"]),
        (plan_of(()), ["no controls", "status='sumo'"]),
        (plan_of([]), ["no controls"]),
        (plan_of(np.empty((0, 2))), ["no controls"]),
        (plan_of(GOOD, status=None), ["nothing as status"]),
        (plan_of(GOOD, reward=[1.0]), ["a list as reward"]),
        (plan_of((Control(0.0, float("nan")),)), ["not finite"]),
        (plan_of((Control(2.0, 0.0),)), ["not that of a car"]),
        (plan_of((Control(0.0, -1e300),)), ["not that of a car"]),
    ],
    ids=str,
)
def test_what_cannot_be_driven_says_what_to_return(plan: object, needles: list[str]) -> None:
    with pytest.raises(UnusablePlanError) as raised:
        accepted(plan)
    for needle in needles:
        assert needle in described(raised.value)
    assert "\n" not in described(raised.value)


@pytest.mark.parametrize(
    "controls",
    [GOOD, list(GOOD), [(0, 1)], np.array([[0.0, 1.0]]), ((np.float64(0.0), np.float32(1.0)),)],
    ids=str,
)
def test_controls_in_any_shape_of_pairs_become_controls(controls: Any) -> None:
    plan = accepted(plan_of(controls))
    assert plan.controls == GOOD
    assert all(type(value) is float for value in plan.controls[0])


def test_only_who_says_so_leaves_the_car_to_sumo() -> None:
    assert accepted(plan_of((), status="sumo")).controls == ()


def test_later_controls_need_not_be_possible() -> None:
    far = (*GOOD, Control(0.0, 1e9))
    assert accepted(plan_of(far)).controls == far


class Careless:
    """Reads what no road has, in a helper of its own module."""

    def reset(self, road: Any) -> None:
        self._count(road)

    def _count(self, road: Any) -> None:
        self.lanes = road.lanes  # the line

    def plan(self, observation: Any, history: Any) -> Plan:
        return plan_of(GOOD)


def line_of(marker: str) -> int:
    lines = open(__file__).read().splitlines()  # noqa: PTH123, SIM115
    return 1 + next(i for i, line in enumerate(lines) if line.endswith(marker))


def test_a_reset_that_raises_is_one_line_with_its_place_and_keeps_its_cause() -> None:
    with pytest.raises(UserError) as raised:
        start(Careless(), object())  # type: ignore[arg-type]
    said = str(raised.value)
    assert said.startswith("planner Careless: reset() raised AttributeError")
    assert f"(test_planners.py:{line_of('# the line')})" in said
    assert isinstance(raised.value.__cause__, AttributeError)


def test_a_reset_with_other_arguments_is_one_line() -> None:
    class Other:
        def reset(self) -> None: ...

        def plan(self, observation: Any, history: Any) -> Plan: ...  # type: ignore[empty-body]

    with pytest.raises(UserError, match=r"planner Other: reset\(\) raised TypeError"):
        start(Other(), object())  # type: ignore[arg-type]


def test_lack_of_memory_is_not_the_users_mistake() -> None:
    class Hungry(Careless):
        def reset(self, road: Any) -> None:
            raise MemoryError

    with pytest.raises(MemoryError):
        start(Hungry(), object())  # type: ignore[arg-type]


def test_a_message_that_is_no_text_can_be_printed() -> None:
    class Odd(Careless):
        def reset(self, road: Any) -> None:
            raise ValueError("bad file \udc80")

    with pytest.raises(UserError) as raised:
        start(Odd(), object())  # type: ignore[arg-type]
    str(raised.value).encode()
