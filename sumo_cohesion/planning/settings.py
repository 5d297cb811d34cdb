"""Settings of the planner: one set for every scenario. SI units."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.solvers import SOLVERS
from sumo_cohesion.state import STEP

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def _known(solver: str) -> str:
    if solver not in SOLVERS:
        raise ValueError(f"there is no such solver; choose {', '.join(SOLVERS)}")
    return solver


class PlannerSettings(BaseModel):
    """The model predictive controller.

    Attributes
    ----------
    horizon : steps of 0.1 s.
    friction : linear friction (1/s) of the point mass.
    max_curvature : bound (1/m) on the driven path's curvature.
    max_lateral_acceleration : bound (m/s²) on speed² · curvature.
    max_curvature_rate : bound (1/m/s) on how fast the curvature changes.
    max_braking, max_acceleration : bounds (m/s²) on the change of speed.
    max_jerk : bound (m/s³) on how fast the commanded acceleration changes.
    constraint : cost per metre too close to a visible car or beyond the road's edge
        (planning.constraints), in units of what cohesion could win by it.
    cars : how many of the nearest vehicles are avoided.
    solver : ilqr (solvers.ilqr), the fast one; fatrop and ipopt, CasADi's interior point methods;
        lbfgs, the paper's own.
    last_resort : check every plan before it is driven (planning.safety).
    max_iterations : after which a solve has failed. Not a time limit, which would make two
        runs of the same seed differ.
    reward : weights of the ego's own reward (planning.reward).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    horizon: Annotated[int, Field(ge=1, le=100)] = 10
    friction: NonNegative = 0.1
    max_curvature: Positive = 0.01
    max_lateral_acceleration: Positive = 8.0
    max_curvature_rate: Positive = 0.05
    max_braking: Positive = 8.0
    max_acceleration: Positive = 4.8
    max_jerk: Positive = 100.0
    constraint: NonNegative = 20.0
    cars: Annotated[int, Field(ge=1, le=100)] = 8
    solver: Annotated[str, AfterValidator(_known)] = "ilqr"
    max_iterations: Annotated[int, Field(ge=1)] = 100
    last_resort: bool = True
    reward: RewardWeights = RewardWeights()

    @model_validator(mode="after")
    def _speed_says_acceleration(self) -> PlannerSettings:
        if self.reward.net_acceleration > 0.0 and self.friction * STEP >= 1.0:
            raise ValueError(
                f"reward.net_acceleration needs a friction below {1.0 / STEP:g} 1/s, "
                f"not {self.friction:g}"
            )
        return self

    def sharpest(self, speed: float) -> float:
        """Largest curvature (1/m) at a speed (m/s): the car's, or its tyres'."""
        return min(self.max_curvature, self.max_lateral_acceleration / max(speed, 1e-3) ** 2)
