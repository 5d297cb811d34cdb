"""An experiment is data: scenarios x planners x grid x seeds, in a TOML file."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    StrictInt,
    field_validator,
    model_validator,
)

from sumo_cohesion.batches.identity import point_digest, run_key
from sumo_cohesion.batches.store import Value, as_cell
from sumo_cohesion.errors import UserError
from sumo_cohesion.planning.registry import check_planner
from sumo_cohesion.simulation.overrides import read_files
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.setup import resolve
from sumo_cohesion.traffic.outputs import Output
from sumo_cohesion.user_input import (
    read_toml,
    refuse_other_kind,
    refuse_repeats,
    refuse_sumo_file,
    seeds_of,
    split_names,
    validated,
)

Kept = Literal["ego", "trajectory", "plan", "horizon", "agreement", "timing", "reference"]
"""Tables that can be kept per run; ``ego`` is the ego's part of the trajectory."""
MOST_POINTS, MOST_RUNS = 20_000, 5_000_000
"""Largest experiment: a mistake in a grid should be a line, not a night of silence."""


Settings = dict[str, list[tuple[Any, Any]]]
"""Values of settings by dotted name, each as it is written and as it is used."""


class RunLimits(BaseModel):
    """What one run may take.

    ``run_time`` (s of wall time), ``memory`` (GB; Linux only) and how often a run that crashed,
    hung or ran out of memory is tried again (``retries``).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    run_time: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 600.0
    memory: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 4.0
    retries: Annotated[int, Field(ge=0, le=10)] = 0


class Experiment(BaseModel):
    """What to run and what to keep.

    Attributes
    ----------
    scenarios : bundled names, or TOML files looked up beside the experiment's file.
    planners : built-in names, or ``module:Class(...)``.
    seeds : "0:20" (half-open), or a list.
    keep : tables to keep of every run, besides its metrics.
    sumo_outputs : SUMO's own outputs to keep of every run.
    set : settings by dotted name, the same in all runs.
    grid : lists of values by dotted name; every combination is run.
    limits : see RunLimits.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = "experiment"
    summary: str = ""
    scenarios: Annotated[tuple[str, ...], Field(min_length=1)]
    planners: Annotated[tuple[str, ...], Field(min_length=1)] = ("nominal", "cohesive")
    seeds: Annotated[tuple[StrictInt, ...], Field(min_length=1)]
    keep: tuple[Kept, ...] = ()
    sumo_outputs: tuple[Output, ...] = ()
    set: dict[str, Any] = {}
    grid: dict[str, Annotated[list[Value], Field(min_length=1)]] = {}
    limits: RunLimits = RunLimits()
    _folder: Path = PrivateAttr(default=Path())
    _source: str = PrivateAttr(default="")

    @field_validator("set", "grid", mode="before")
    @classmethod
    def _by_dotted_name(cls, value: Any) -> Any:
        return flatten(value) if isinstance(value, Mapping) else value

    @field_validator("scenarios", "planners", "keep", "sumo_outputs", mode="before")
    @classmethod
    def _one_is_a_list(cls, value: Any) -> Any:
        return split_names(value) if isinstance(value, str) else value

    @field_validator("seeds", mode="before")
    @classmethod
    def _as_list(cls, value: Any) -> Any:
        return seeds_of(value)

    @field_validator("planners", mode="before")
    @classmethod
    def _by_name(cls, value: Any) -> Any:
        for planner in value if isinstance(value, list | tuple) else ():
            if not isinstance(planner, str):
                raise ValueError(
                    f"{planner!r} cannot leave this process, and a batch runs in others; put the "
                    "planner into a file and name it as file.py:Class"
                )
        return value

    @field_validator("scenarios", "planners", "seeds", "keep", "sumo_outputs")
    @classmethod
    def _no_repeats(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        refuse_repeats(value)
        return value

    @field_validator("grid")
    @classmethod
    def _no_repeated_values(cls, value: dict[str, list[Value]]) -> dict[str, list[Value]]:
        for values in value.values():
            refuse_repeats([json.dumps(v, default=str) for v in values])
        return value

    @model_validator(mode="after")
    def _not_too_many(self) -> Experiment:
        points = len(self.scenarios) * len(self.planners) * prod(map(len, self.grid.values()))
        if points > MOST_POINTS or points * len(self.seeds) > MOST_RUNS:
            raise ValueError(
                f"{points} points and {points * len(self.seeds)} runs are too many for one "
                f"experiment (at most {MOST_POINTS} and {MOST_RUNS}); make several files"
            )
        return self

    @property
    def folder(self) -> Path:
        """Where its scenarios' files are looked up."""
        return self._folder.resolve()

    def settings(self) -> Settings:
        """Values of every setting in [set] and [grid], files read."""
        both = set(self.set) & set(self.grid)
        if both:
            raise UserError(f"{min(both)} is both in [set] and in [grid]; take one of them out")
        axes = {name: [value] for name, value in self.set.items()} | self.grid
        return {
            name: [(value, read_files({name: value}, self._folder)[name]) for value in values]
            for name, values in axes.items()
        }

    def points(self, settings: Settings) -> Iterator[Point]:
        """Every scenario, planner and grid point, in the order of the file."""
        for scenario, planner in itertools.product(self.scenarios, self.planners):
            for values in itertools.product(*settings.values()):
                named = dict(zip(settings, values, strict=True))
                yield Point(
                    scenario=self._scenario_path(scenario),
                    planner=planner,
                    grid={name: named[name][0] for name in self.grid},
                    overrides={name: used for name, (_, used) in named.items()},
                )

    def _scenario_path(self, scenario: str) -> str:
        return str(self._folder / scenario) if scenario.endswith(".toml") else scenario


@dataclass(frozen=True)
class Point:
    """One scenario, planner and combination of the grid's values: all runs but for the seed.

    ``grid`` holds values as they are written, ``overrides`` all settings as they are used.
    """

    scenario: str
    planner: str
    grid: Mapping[str, Value]
    overrides: Mapping[str, Any]

    def request(self, seed: int = 0) -> RunRequest:
        """Return one of its runs."""
        return RunRequest(self.scenario, self.planner, seed, self.overrides)


@dataclass(frozen=True)
class Work:
    """An experiment spelt out.

    Attributes
    ----------
    plan : one row per wanted run: ``run`` (its key), scenario, planner, a column per grid name,
        seed. Rows whose settings come to the same share a run: nominal has no beta.
    points : the point that each distinct run belongs to.
    files : what was read for settings that name a file: by setting, and by what is written.
    """

    plan: pd.DataFrame
    points: Mapping[str, Point]
    files: Mapping[str, Mapping[str, Any]]


def load_experiment(source: str | Path | Mapping[str, Any]) -> Experiment:
    """Load and validate an experiment from a TOML file, or from a mapping of the same shape.

    Raises
    ------
    UserError
        If the file cannot be read or something in it is wrong.
    """
    if isinstance(source, Mapping):
        return validated(Experiment, dict(source), "experiment")
    path = Path(source)
    refuse_sumo_file(str(path))
    data = read_toml(path)
    refuse_other_kind(data, path, "experiment")
    experiment = validated(Experiment, data, str(path))
    experiment._folder = path.parent.resolve()
    experiment._source = str(path)
    return experiment


def stored_points(about: Mapping[str, Any]) -> tuple[list[Point], list[int]]:
    """Return the points and the seeds of the experiment that a batch's manifest holds.

    What was read from files then counts, not what they say now.
    """
    experiment = validated(Experiment, dict(about["experiment"]), "experiment")
    experiment._folder = Path(about["folder"])
    axes = {name: [value] for name, value in experiment.set.items()} | experiment.grid
    read = about["files"]
    settings = {
        name: [(v, read[name][v] if name in read and v in read[name] else v) for v in values]
        for name, values in axes.items()
    }
    return list(experiment.points(settings)), list(experiment.seeds)


def spell_out(experiment: Experiment) -> Work:
    """List every run that an experiment wants, by the key of what decides its result.

    Raises
    ------
    UserError
        If a scenario, planner or setting is wrong; all points are looked at.
    """
    try:
        return _spelt_out(experiment)
    except UserError as error:
        if not experiment._source:
            raise
        raise UserError(f"{experiment._source}: {error}") from error


def _spelt_out(experiment: Experiment) -> Work:
    blocks: list[dict[str, Any]] = []
    points: dict[str, Point] = {}
    sources: dict[str, str] = {}
    settings = experiment.settings()
    for point in experiment.points(settings):
        inputs = resolve(point.request())
        check_planner(point.planner)
        name = inputs.scenario.name
        if sources.setdefault(name, point.scenario) != point.scenario:
            raise UserError(
                f"{point.scenario}: its name {name!r} is also that of {sources[name]}; "
                "tables tell scenarios apart by name, rename one"
            )
        digest = point_digest(inputs)
        keys = [run_key(digest, seed) for seed in experiment.seeds]
        points |= dict.fromkeys(keys, point)
        columns = {key: as_cell(value) for key, value in point.grid.items()}
        head = {"scenario": name, "planner": point.planner, **columns}
        blocks.append({"run": keys, **head, "seed": list(experiment.seeds)})
    plan = pd.concat([pd.DataFrame(block) for block in blocks], ignore_index=True)
    for name in experiment.grid:
        kinds = {isinstance(value, str) for value in plan[name]}
        if len(kinds) > 1:  # numbers and texts: a column of a table holds one or the other
            plan[name] = plan[name].map(str)
    if plan.duplicated(["scenario", "planner", *experiment.grid, "seed"]).any():
        raise UserError("[grid] lists a value twice, written in two ways, such as 1 and 1.0")
    for text in ("run", "scenario", "planner"):
        plan[text] = plan[text].astype("string")
    return Work(plan, points, _files_of(settings))


def _files_of(settings: Settings) -> dict[str, dict[str, Any]]:
    read = {
        name: {str(written): used for written, used in values if used is not written}
        for name, values in settings.items()
    }
    return {name: files for name, files in read.items() if files}


def flatten(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as dotted names, however they were written.

    >>> flatten({"cohesion": {"beta": [0.1]}, "ego.speed": [20]})
    {'cohesion.beta': [0.1], 'ego.speed': [20]}
    """
    flat: dict[str, Any] = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        flat |= flatten(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat
