"""A scenario is data: a TOML file, validated, with errors that say what and how to mend."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, model_validator

from sumo_cohesion.errors import UserError
from sumo_cohesion.experiments.columns import METRICS, OF_REFERENCE
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.social.settings import CohesionSettings
from sumo_cohesion.traffic.demand import EgoDemand, Randomization
from sumo_cohesion.traffic.drivers import Event

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


Model = TypeVar("Model", bound=BaseModel)


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
        (experiments.reference); it costs two more plans per step.
    success : each key a metric, each value what it must be: a value or {min, max}.
    """

    name: str
    summary: str
    network: str
    routes: Annotated[tuple[str, ...], Field(min_length=1)]
    additional: tuple[str, ...] = ()
    duration: Annotated[float, Field(ge=1, le=86_400)]
    lateral_resolution: Annotated[float, Field(gt=0, le=10)] = 0.8
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
                raise ValueError(f"success: there is no metric {name!r}{_closest(name, [*kinds])}")
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
        names = [p.stem for p in scenario_files()]
        if str(source) not in names:
            raise UserError(
                f"no scenario {str(source)!r}{_closest(str(source), names)}; choose one of "
                f"{', '.join(names)}, or give the path of a .toml file"
            )
        path = bundled("scenarios") / f"{source}.toml"
    data = read_toml(path)
    scenario = validated(Scenario, merge(data, overrides or {}), str(path))
    scenario._folder = path.parent.resolve()
    return scenario


def read_toml(path: Path) -> dict[str, Any]:
    """Read a user's TOML file; raises UserError if it cannot be."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid TOML: {error}") from None
    except ValueError as error:
        raise UserError(f"{str(path)!r}: not a file's name ({error})") from None


def settings_from(
    overrides: Mapping[str, Any],
) -> tuple[PlannerSettings, CohesionSettings, dict[str, Any]]:
    """Split dotted overrides into planner settings, cohesion settings and scenario overrides."""
    parts: dict[str, dict[str, Any]] = {"planner": {}, "cohesion": {}, "": {}}
    for name, value in overrides.items():
        head, _, tail = name.partition(".")
        if tail and head in parts:
            parts[head][tail] = value
        elif head in Scenario.model_fields:
            parts[""][name] = value
        else:
            raise UserError(f"unknown setting {name!r}{_meant(name)}")
    planner = validated(PlannerSettings, merge({}, parts["planner"]), "planner settings")
    cohesion = validated(CohesionSettings, merge({}, parts["cohesion"]), "cohesion settings")
    return planner, cohesion, parts[""]


def _meant(name: str) -> str:
    """Suggest settings that are spelt like an unknown one, or all there is to set."""
    groups = {"planner": PlannerSettings.model_fields, "cohesion": CohesionSettings.model_fields}
    head, dot, tail = name.partition(".")
    if head in groups:
        return (
            f"; it is a group: set one of {', '.join(f'{head}.{key}' for key in groups[head])}; "
            "which planner drives is said by --planner, --planners or an experiment's planners"
        )
    same = [f"{group}.{name}" for group, fields in groups.items() if name in fields]
    close = difflib.get_close_matches(head, [*groups, *Scenario.model_fields], 1)
    meant = same or [close[0] + dot + tail] if same or close else []
    if meant:
        return f"; did you mean {meant[0]!r}?"
    known = ", ".join(Scenario.model_fields)
    return f"; settings are planner.*, cohesion.*, and of the scenario {known}"


def merge(data: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Put values into a nested mapping by dotted name; the input is left alone.

    >>> merge({"ego": {"lane": 0}}, {"ego.speed": 20.0})
    {'ego': {'lane': 0, 'speed': 20.0}}
    """
    result = {k: dict(v) if isinstance(v, Mapping) else v for k, v in data.items()}
    for name, value in overrides.items():
        head, _, tail = name.partition(".")
        if not tail:
            result[head] = value
            continue
        inner = result.get(head, {})
        if not isinstance(inner, Mapping):
            raise UserError(f"{name}: {head!r} is a value and has no key {tail!r}")
        result[head] = merge(inner, {tail: value})
    return result


def parse_override(text: str) -> tuple[str, Any]:
    """Parse ``name=value``, the value as in TOML; a bare word is a string.

    >>> parse_override("cohesion.beta=0.05")
    ('cohesion.beta', 0.05)
    >>> parse_override("planner.solver=ipopt")
    ('planner.solver', 'ipopt')
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise UserError(f"--set {text!r}: write it as name=value, e.g. cohesion.beta=0.05")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    return name.strip(), parsed


def split_planners(names: str) -> list[str]:
    """Split names at commas, but not within brackets or quotes.

    >>> split_planners("nominal, my:Follow(gain=(1, 2), name='a, ('),sumo")
    ['nominal', "my:Follow(gain=(1, 2), name='a, (')", 'sumo']
    """
    parts, depth, quote = [""], 0, ""
    for character in names:
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        else:
            depth += (character in "([{") - (character in ")]}")
        if character == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts if part.strip()]


def parse_seeds(text: str, what: str = "--seeds") -> list[int]:
    """Parse "0:20" (half-open) or "3,7,9".

    >>> parse_seeds("0:3"), parse_seeds("3,7,9")
    ([0, 1, 2], [3, 7, 9])
    """
    try:
        if ":" in text:
            low, high = (int(part) for part in text.split(":"))
            if high - low > 1_000_000:
                raise UserError(f"{what} {text!r}: more than a million seeds; make several parts")
            seeds = list(range(low, high))
        else:
            seeds = [int(part) for part in text.split(",")]
    except ValueError:
        raise UserError(f"{what} {text!r}: write 0:20 for 0 to 19, or a list 3,7,9") from None
    if not seeds:
        raise UserError(f"{what} {text!r} is empty; 0:20 means 0 to 19, the end is not included")
    return seeds


def validated(model: type[Model], data: object, where: str) -> Model:
    """Validate data; turn pydantic's report into one line."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        # A misspelt key is also a missing one; name the misspelling.
        first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = _fields_at(model, first["loc"][:-1])
            name = str(first["loc"][-1])
            hint = _closest(name, known) or f"; known keys are {', '.join(known)}"
            raise UserError(f"{where}: unknown key {key!r}{hint}") from None
        said = first["msg"].removeprefix("Value error, ")
        got = first.get("input")
        shown = f" (got {got!r})" if isinstance(got, str | int | float | bool | list) else ""
        prefix = f"{where}: {key}: " if key else f"{where}: "
        raise UserError(prefix + said[:1].lower() + said[1:] + shown) from None


def _fields_at(model: type[BaseModel], loc: Sequence[int | str]) -> list[str]:
    """Names of the fields of the sub-model that a validation error's location points to."""
    for part in loc:
        inner = model.model_fields.get(str(part))
        kind = inner.annotation if inner is not None else None
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            model = kind
    return list(model.model_fields)


def _closest(name: str, known: Sequence[str]) -> str:
    found = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {found[0]!r}?" if found else ""
