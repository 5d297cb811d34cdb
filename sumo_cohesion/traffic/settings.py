"""What a scenario says of its demand: the ego, and what a seed varies."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class EgoDemand(BaseModel):
    """Where the ego starts and where it goes.

    ``position`` (m) and ``lane`` follow SUMO: front bumper from the start of the edge, lanes
    counted from the right. ``depart`` (s) leaves other traffic time to form.
    """

    # A number is an edge's name, too: OpenStreetMap's are numbers.
    model_config = ConfigDict(frozen=True, extra="forbid", coerce_numbers_to_str=True)

    origin: str
    destination: str
    lane: Annotated[int, Field(ge=0)]
    position: NonNegative
    speed: NonNegative
    depart: Annotated[float, Field(ge=0, le=604_800)] = 0.0  # a week, most of it empty steps
    length: Positive = 5.0
    width: Positive = 1.8


class Randomization(BaseModel):
    """What a seed varies, besides SUMO's own random numbers.

    Attributes
    ----------
    lead_spacing : [low, high] (m) between the fronts of consecutive cars that start with the
        ego, ahead of it in its lane, each gap drawn anew; the first gap is the ego's own.
    position : every other vehicle or trip with a number as its departPos starts up to so many
        metres before or after it.
    speed : every human's desired speed changes by up to this share, on top of the speedDev of
        its type (SUMO itself would ignore speedDev once a vehicle has a speedFactor).
    humans : [fewest, most] human cars; the first so many of the route files are kept.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    lead_spacing: tuple[Positive, Positive] | None = None
    position: NonNegative = 0.0
    speed: Annotated[float, Field(ge=0, lt=1)] = 0.0
    humans: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Randomization:
        for name in ("lead_spacing", "humans"):
            pair = getattr(self, name)
            if pair is not None and pair[0] > pair[1]:
                raise ValueError(f"{name} must be [low, high] with low <= high, not {list(pair)}")
        return self

    @property
    def varies(self) -> bool:
        """Whether a seed varies anything at all besides SUMO's own random numbers."""
        return self != Randomization()
