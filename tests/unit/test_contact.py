"""Every constructed contact is found, every constructed miss is none."""

from __future__ import annotations

from math import cos, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sumo_cohesion.state import CartesianState
from sumo_cohesion.traffic.contact import contacts

CAR = (5.0, 1.8)


def touch(x: float, y: float, heading: float = 0.0, ego_heading: float = 0.0) -> bool:
    ego = CartesianState(100.0, 50.0, ego_heading, 20.0)
    other = np.array([[100.0 + x, 50.0 + y, heading, 10.0]])
    return bool(contacts(ego, CAR, other, np.array([CAR])).size)


@pytest.mark.parametrize(
    ("x", "y", "heading", "expected"),
    [
        (4.9, 0.0, 0.0, True),  # rear-end in the same lane
        (5.1, 0.0, 0.0, False),
        (0.0, 1.79, 0.0, True),  # side-swipe across the line
        (0.0, 1.81, 0.0, False),
        (4.9, 1.7, 0.0, True),  # corner to corner
        (5.1, 1.7, 0.0, False),
        (3.3, 0.0, pi / 2, True),  # across the ego's nose: 2.5 + 0.9
        (3.5, 0.0, pi / 2, False),
        (0.0, 3.3, pi / 2, True),
        (0.0, 3.5, pi / 2, False),
        (0.0, 0.0, 1.0, True),  # one inside the other
        (0.0, 0.0, pi, True),
    ],
)
def test_constructed_contacts(x: float, y: float, heading: float, expected: bool) -> None:
    assert touch(x, y, heading) is expected


def test_a_rotated_corner_reaches_where_the_straight_box_does_not() -> None:
    # At 45° the corner lies (2.5 + 0.9) / sqrt(2) = 2.404 m to the side.
    reach = (2.5 + 0.9) / 2**0.5
    assert touch(0.0, 0.9 + reach - 0.01, pi / 4)
    assert not touch(0.0, 0.9 + reach + 0.01, pi / 4)


def polygon(x: float, y: float, heading: float) -> list[tuple[float, float]]:
    return [
        (x + a * cos(heading) - b * sin(heading), y + a * sin(heading) + b * cos(heading))
        for a, b in ((2.5, 0.9), (-2.5, 0.9), (-2.5, -0.9), (2.5, -0.9))
    ]


def clipped_area(subject: list[tuple[float, float]], clip: list[tuple[float, float]]) -> float:
    """Area of the intersection of two convex polygons (Sutherland-Hodgman): an oracle."""
    for i in range(4):
        (ax, ay), (bx, by) = clip[i], clip[(i + 1) % 4]
        side = [(bx - ax) * (y - ay) - (by - ay) * (x - ax) for x, y in subject]
        kept: list[tuple[float, float]] = []
        for k, (p, sp) in enumerate(zip(subject, side, strict=True)):
            q, sq = subject[k - 1], side[k - 1]
            if (sp > 0) != (sq > 0):
                t = sp / (sp - sq)
                kept.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
            if sp > 0:
                kept.append(p)
        subject = kept
        if not subject:
            return 0.0
    return 0.5 * abs(
        sum(
            subject[k - 1][0] * subject[k][1] - subject[k][0] * subject[k - 1][1]
            for k in range(len(subject))
        )
    )


@settings(max_examples=settings().max_examples * 5)
@given(
    x=st.floats(-6, 6),
    y=st.floats(-6, 6),
    heading=st.floats(-pi, pi),
    ego_heading=st.floats(-pi, pi),
)
def test_agrees_with_polygon_clipping(
    x: float, y: float, heading: float, ego_heading: float
) -> None:
    area = clipped_area(polygon(x, y, heading), polygon(0.0, 0.0, ego_heading))
    if area > 1e-6:
        assert touch(x, y, heading, ego_heading)
    elif hypot(x, y) > 0 and area == 0.0:
        grown = clipped_area(polygon(x * 0.999, y * 0.999, heading), polygon(0, 0, ego_heading))
        if grown == 0.0:
            assert not touch(x, y, heading, ego_heading)


def test_only_those_in_contact_are_named_in_order() -> None:
    ego = CartesianState(0.0, 0.0, 0.0, 0.0)
    states = np.array([[50.0, 0, 0, 0], [1.0, 0, 0, 0], [0.0, 1.0, 0, 0], [0.0, 9.0, 0, 0]])
    assert contacts(ego, CAR, states, np.tile(CAR, (4, 1))).tolist() == [1, 2]
    assert contacts(ego, CAR, np.zeros((0, 4)), np.zeros((0, 2))).size == 0
