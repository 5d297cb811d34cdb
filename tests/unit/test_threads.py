"""Planners in several threads of one process do not disturb each other."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.solvers import compiled
from sumo_cohesion.planning.solvers.mpc import Mpc, shared_solver
from tests.conftest import ROOT
from tests.unit.test_solvers import SETTINGS, problem

TWO_PLANNERS = """
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from tests.unit.test_solvers import SETTINGS, problem
from sumo_cohesion.planning.solvers.mpc import Mpc

def plans(first, ready, mpc=None):
    ready.wait()  # without a controller both build one at once
    mpc = mpc or Mpc(SETTINGS, 3)
    found = []
    for seed in range(first, first + 150):
        solution = mpc.solve(problem(seed))
        found.append((solution.status, solution.controls.tobytes(), solution.states.tobytes()))
    return found

sys.setswitchinterval(1e-6)  # as if the threads had a processor each
starts, both = (0, 1000), Barrier(2)
with ThreadPoolExecutor(2) as threads:
    together = list(threads.map(plans, starts, [both, both]))
    made_here = [Mpc(SETTINGS, 3), Mpc(SETTINGS, 3)]
    elsewhere = list(threads.map(plans, starts, [both, both], made_here))
alone = [plans(first, Barrier(1)) for first in starts]
wrong = [
    a != b for found in (together, elsewhere) for x, y in zip(alone, found) for a, b in zip(x, y)
]
print(len(wrong), sum(wrong))
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", ["compiled", "0"])
def test_two_planners_in_two_threads_plan_as_each_would_alone(how: str) -> None:
    if how == "compiled" and compiled.find_compiler() is None:
        pytest.skip("no C compiler here")
    done = subprocess.run(
        [sys.executable, "-c", TWO_PLANNERS],
        cwd=ROOT,
        env={**os.environ, "SUMO_COHESION_COMPILE": "0" if how == "0" else "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["600", "0"]


def test_other_reward_weights_need_no_other_solver() -> None:
    """Theta is part of the problem: what is built serves all weights of the same terms."""
    other = SETTINGS.model_copy(update={"reward": RewardWeights(curvature=8000.0)})
    assert shared_solver("ilqr", other, 3) is shared_solver("ilqr", SETTINGS, 3)
    longer = PlannerSettings(horizon=12)
    assert shared_solver("ilqr", longer, 3) is not shared_solver("ilqr", SETTINGS, 3)
    changes = SETTINGS.model_copy(update={"reward": RewardWeights(curvature_change=1.0)})
    stiffer = SETTINGS.model_copy(update={"reward": RewardWeights(curvature_change=9.0)})
    assert shared_solver("fatrop", changes, 3) is shared_solver("fatrop", stiffer, 3)
    assert shared_solver("fatrop", changes, 3) is not shared_solver("fatrop", SETTINGS, 3)
    mpc, asked = Mpc(SETTINGS, 3), problem(3, cohesion=0.0)
    usual = mpc.solve(asked)
    mpc.reset()
    stiff = mpc.solve(asked._replace(theta=other.reward.theta))
    assert abs(stiff.controls[:, 0]).max() < 0.5 * abs(usual.controls[:, 0]).max()
    mpc.reset()
    assert mpc.solve(asked).controls.tobytes() == usual.controls.tobytes()
