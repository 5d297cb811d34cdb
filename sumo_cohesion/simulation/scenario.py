"""A scenario is data: a TOML file, validated, with errors that say what and how to mend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, model_validator

from sumo_cohesion.errors import UserError
from sumo_cohesion.tables.metrics import METRICS, OF_REFERENCE
from sumo_cohesion.traffic.drivers import Event
from sumo_cohesion.traffic.settings import EgoDemand, Randomization
from sumo_cohesion.user_input import (
    closest,
    merge,
    parse_override,
    read_toml,
    refuse_other_kind,
    refuse_sumo_file,
    text_settings,
    validated,
)

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Data(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Sensing(_Data):
    """What the ego perceives.

    ``range`` (m) between centres; ``hidden`` vehicles exist but are never seen; ``special``
    vehicles are seen and avoided, but nobody follows them.
    """

    range: Positive = 150.0
    hidden: tuple[str, ...] = ()
    special: tuple[str, ...] = ()


class FleetSettings(_Data):
    """Which other cars the run's planner drives, too.

    ``penetration``: the share of other cars that are equipped with the planner. They are driven
    by it, each on its own, while they are within the ego's sensing range; elsewhere SUMO drives
    them. The sets are nested: who is equipped at 0.2 is equipped at 0.5.
    """

    penetration: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.0


class Bounds(_Data):
    """A metric lies between ``min`` and ``max``, both included."""

    min: Annotated[float, Field(allow_inf_nan=False)] | None = None
    max: Annotated[float, Field(allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _not_empty(self) -> Bounds:
        if self.min is None and self.max is None:
            raise ValueError("give min, max or both")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is more than max {self.max:g}")
        return self


class Scenario(_Data):
    """Network, demand, ego, perception and what counts as success.

    Attributes
    ----------
    network, routes, additional : file names, looked up beside the scenario, then among the
        bundled ones.
    duration : seconds after the ego's departure.
    lateral_resolution : width (m) of SUMO's sublanes.
    human_type : SUMO vType attributes, set on the types of all humans.
    fleet : which other cars the run's planner drives, too.
    events : what humans are told, and when, where SUMO has no such rule.
    reference : also drive a nominal twin beside the ego, for the metrics that compare with it
        (simulation.twin); it costs two more plans per step.
    success : each key a metric, each value what it must be: a value or {min, max}.
    """

    name: str
    summary: str
    network: str
    routes: Annotated[tuple[str, ...], Field(min_length=1)]
    additional: tuple[str, ...] = ()
    duration: Annotated[float, Field(ge=1, le=86_400)]
    lateral_resolution: Annotated[float, Field(ge=0.01, le=10)] = 0.8
    ego: EgoDemand
    sensing: Sensing = Sensing()
    fleet: FleetSettings = FleetSettings()
    randomize: Randomization = Randomization()
    human_type: dict[str, float | str] = {}
    events: tuple[Event, ...] = ()
    reference: bool = False
    success: dict[str, bool | float | Bounds]
    _folder: Path = PrivateAttr(default=Path())

    @model_validator(mode="after")
    def _known_metrics(self) -> Scenario:
        kinds = {c.name: c.dtype for c in METRICS}
        for name, wanted in self.success.items():
            if name not in kinds:
                raise ValueError(f"success: there is no metric {name!r}{closest(name, [*kinds])}")
            if name == "success":
                raise ValueError("success cannot be a condition of itself; name another metric")
            if name.startswith("nominal_"):
                raise ValueError(
                    f"success: {name} is known only beside nominal's own run, by compare; use "
                    f"{name.replace('nominal', 'twin')}"
                )
            if name in OF_REFERENCE and not self.reference:
                raise ValueError(f"success: {name} needs reference = true")
            if isinstance(wanted, Bounds) and kinds[name] in ("string", "bool"):
                raise ValueError(f"success: {name} is no number and has no min and max")
        return self

    def file(self, name: str, kind: str) -> Path:
        """Path of a network or route file, beside the scenario or bundled (kind: folder)."""
        for path in (self._folder / name, bundled(kind) / name):
            with suppress(OSError):  # no file can have such a name
                if path.is_file():
                    return path
        raise UserError(
            f"scenario {self.name!r}: no file {name!r} beside it ({self._folder}) nor among the "
            f"bundled {kind}"
        )


def bundled(kind: str) -> Path:
    """Folder of the bundled scenarios, networks or routes: in the wheel, or in the checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "data" / kind
    return inside if inside.is_dir() else package.parent / kind


def scenario_files() -> list[Path]:
    """All bundled scenarios, by name."""
    return sorted(bundled("scenarios").glob("*.toml"))


def load_scenario(source: str | Path, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Load a bundled scenario by name or any scenario by its TOML file.

    Parameters
    ----------
    source : a name such as "stalled", or a path ending in .toml.
    overrides : values by dotted name, such as {"randomize.lead_spacing": [40, 40]}.

    Raises
    ------
    UserError
        If there is no such scenario or something in it is wrong.
    """
    path = Path(source)
    if path.suffix != ".toml":
        refuse_sumo_file(str(source))
        names = [p.stem for p in scenario_files()]
        if str(source) not in names:
            raise UserError(
                f"no scenario {str(source)!r}{closest(str(source), names)}; choose one of "
                f"{', '.join(names)}, or give the path of a .toml file"
            )
        path = bundled("scenarios") / f"{source}.toml"
    data = read_toml(path)
    refuse_other_kind(data, path, "scenario")
    scenario = validated(Scenario, merge(data, overrides or {}), str(path))
    scenario._folder = path.parent.resolve()
    return scenario


def parse_overrides(changes: Sequence[str]) -> dict[str, Any]:
    """Return settings by dotted name, of what is written as NAME=VALUE."""
    texts = text_settings(Scenario)
    return dict(parse_override(text, texts) for text in changes)
