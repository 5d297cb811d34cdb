"""How far ahead to plan, and on which transitions to be cohesive, by what happens then.

    python -m analysis.horizon [--seeds 2010:2020] [--workers 2]

Writes analysis/horizon.csv and analysis/horizon.json. The default, 10 steps and the paper's first
transition, was not chosen on these seeds.
"""

from __future__ import annotations

from analysis.study import Changes, study

STEPS = (5, 10, 20, 40)
CHANGES: Changes = {
    f"{steps} steps, {on}": {"planner.horizon": steps, "cohesion.transitions": on}
    for on in ("first", "all")
    for steps in STEPS
}
SCENARIOS = (
    "stalled",
    "stalled_swerve",
    "stalled_dense",
    "ambulance",
    "speeding",
    "exit",
    "nothing_to_follow",
)

if __name__ == "__main__":
    study("horizon", CHANGES, SCENARIOS, "2010:2020")
