"""Learn theta from files and folders: one call."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any, get_args

from sumo_cohesion.demonstrations.folders import Run, runs_in
from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.learn import Options, Progress, learn_from
from sumo_cohesion.learning.learned import Learned
from sumo_cohesion.learning.recording import Recording
from sumo_cohesion.learning.source import Kind, Tracks
from sumo_cohesion.learning.tracks import Cutting
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.simulation.overrides import settings_from
from sumo_cohesion.user_input import closest, validated

KINDS = get_args(Kind)
_DID = {"plans": "planned", "driven": "drove", "humans": ""}
KEEP = {"plans": 0.85, "driven": 0.85, "humans": 0.95}
"""Share of the segments that the fit is made of, unless told otherwise."""
SMOOTH = {"plans": (0.0, 0.0), "driven": (0.0, 0.0), "humans": (1.0, 2.0)}
"""Seconds along and across the road, unless told otherwise: planners drive without noise."""
_REWARD = "planner.reward"
_OF_THE_SOLVER = {"reward", "solver", "max_iterations", "last_resort", "constraint"}
"""Settings that runs which are learned from together may differ in."""


def learn(
    demos: str | Path | Sequence[str | Path],
    *,
    source: Kind = "plans",
    network: str | Path | None = None,
    demand: Sequence[str | Path] = (),
    steps: int | None = None,
    smooth: tuple[float, float] | None = None,
    desired: str = "limit",
    also: Sequence[str] = (),
    fix: Mapping[str, float] | None = None,
    keep: float | None = None,
    hold_out: float = 0.25,
    draws: int = 100,
    overrides: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Learned:
    """Learn the planner's reward weights from driving.

    Continuous inverse optimal control with locally optimal examples (Levine and Koltun 2012), as
    the paper does (section "Feature Map & Reward Parameters"); docs/learning.md.

    Parameters
    ----------
    demos : folders of runs, comparisons or batches; or files of driving (SUMO's FCD output, tables
        with time, vehicle, x, y, CommonRoad XML).
    source : whose driving of a run: a planner's "plans", what it has "driven", or the "humans"
        around it. Files hold humans.
    network : SUMO network that a file's vehicles drove in; CommonRoad brings its own.
    demand : route and additional files that have the types of SUMO's vehicles: their sizes.
    steps : of 0.1 s per segment. Default: the plans' horizon; else 10.
    smooth : seconds along and across the road; faster oscillations are noise. Default: 1, 2 for
        humans, nothing for planners.
    desired : "limit", or "own": each driver's own speed is what it would like to drive.
    also : terms to learn that are off by default.
    fix : weights to keep, by name, in units of lane = 1.
    keep : share of the segments that the fit is made of; those that fit worst are trimmed. Default:
        0.85 of a planner's, 0.95 of humans'.
    hold_out : share of the runs that are held out for the comparison with other models.
    draws : of the bootstrap over runs; 0: no intervals.
    overrides : settings of the planner by dotted name, for files; runs bring their own.
    progress : called with (what is being done, done, total).

    Raises
    ------
    UserError
        If a source is wrong or holds nothing to learn from.
    """
    _check(source, steps, smooth, desired, fix or {}, keep, hold_out, draws)
    _check_overrides(overrides or {})
    paths = _paths(demos)
    runs = _distinct([run for path in paths if path.is_dir() for run in runs_in(path)])
    files = [path for path in paths if not path.is_dir()]
    if files and (source == "driven" or (runs and source == "plans")):
        raise UserError(f"files hold humans, not what a planner {_DID[source]}: --from humans")
    kind: Kind = source if runs else "humans"
    recordings = _recordings(files, network, demand)
    sources = [*[run.source(kind) for run in runs], *map(Tracks, recordings)]
    settings = _with_terms(also, _common_settings(runs, overrides or {}))
    how = Cutting(
        steps=steps or (settings.horizon if kind == "plans" else 10),
        smooth=SMOOTH[kind] if smooth is None else smooth,
        own_speed=desired == "own",
        friction=settings.friction,
        by_vehicle=kind == "humans",
        bounded=kind == "driven",
    )
    options = Options(
        keep=KEEP[kind] if keep is None else keep,
        fixed=dict(fix or {}),
        hold_out=hold_out,
        draws=draws,
        exact=kind == "plans",
    )
    about = {
        "demonstrations": [str(path) for path in paths],
        "source": kind,
        "smooth": list(how.smooth),
        "desired": desired,
        "notes": [note for recording in recordings for note in recording.notes],
    }
    return learn_from(sources, how, settings, options, about, progress)


def _paths(demos: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return what is to be learned from: there, and nothing twice."""
    paths = [Path(p) for p in ([demos] if isinstance(demos, str | Path) else demos)]
    if not paths:
        raise UserError("nothing to learn from: give folders of runs, or files of driving")
    for i, path in enumerate(paths):
        if not path.exists():
            raise UserError(f"{path}: there is no such file or folder to learn from")
        if path.resolve() in [earlier.resolve() for earlier in paths[:i]]:
            raise UserError(f"{path}: is given twice, and would count twice; give it once")
    return paths


def _distinct(runs: Sequence[Run]) -> list[Run]:
    """Refuse what would count twice; tell runs of the same name apart."""
    seen: set[Path] = set()
    named: Counter[str] = Counter()
    found = []
    for run in runs:
        place = run.place.resolve()
        if place in seen:
            raise UserError(f"{run.place}: is in two of the folders, and would count twice")
        seen.add(place)
        named[run.name] += 1
        count = named[run.name]
        found.append(run if count == 1 else replace(run, name=f"{run.name} ({count})"))
    return found


def _recordings(
    paths: Sequence[Path], network: str | Path | None, demand: Sequence[str | Path]
) -> list[Recording]:
    """Read files of driving."""
    from sumo_cohesion.demonstrations.reading import read
    from sumo_cohesion.traffic.network import Network

    on = Network(Path(network)) if network is not None and paths else None
    return [read(path, on, [Path(file) for file in demand]) for path in paths]


def _check(
    source: str,
    steps: int | None,
    smooth: tuple[float, float] | None,
    desired: str,
    fix: Mapping[str, float],
    keep: float | None,
    hold_out: float,
    draws: int,
) -> None:
    """Raise UserError if an option makes no sense."""
    if source not in KINDS:
        raise UserError(f"source {source!r}: choose plans, driven or humans")
    if desired not in ("limit", "own"):
        raise UserError(f"desired {desired!r}: choose limit or own")
    if steps is not None and not 2 <= steps <= 100:
        raise UserError(f"steps {steps}: a segment has 2 to 100 steps of 0.1 s")
    if smooth is not None and not (len(smooth) == 2 and all(0.0 <= s <= 60.0 for s in smooth)):
        raise UserError("smooth: give two times in seconds, along and across the road, e.g. 1,2")
    for name, weight in fix.items():
        if not 0.0 <= weight < inf:
            raise UserError(f"fix {name}={weight:g}: a weight is a number, zero or more")
    if keep is not None and not 0.1 <= keep <= 1.0:
        raise UserError(f"keep {keep:g}: a share of 0.1 to 1")
    if not 0.0 <= hold_out <= 0.9:
        raise UserError(f"hold_out {hold_out:g}: a share of 0 to 0.9")
    if not 0 <= draws <= 100_000:
        raise UserError(f"draws {draws}: 0 to 100000")


def _check_overrides(overrides: Mapping[str, Any]) -> None:
    """Raise UserError unless all are settings of the planner that learning leaves as they are."""
    settings_from(overrides)
    for name in overrides:
        if name.startswith(_REWARD):
            raise UserError(f"{name}: weights are learned here; keep one by --fix edge=500")
        if not name.startswith("planner."):
            raise UserError(f"{name} is not the planner's: learn takes planner.* settings only")


def _with_terms(also: Sequence[str], settings: PlannerSettings) -> PlannerSettings:
    """Return settings with those terms in use that are to be learned."""
    usual, known = RewardWeights().in_use, list(RewardWeights.model_fields)
    for name in also:
        if name not in known:
            raise UserError(f"also: there is no reward term {name!r}{closest(name, known)}")
    terms = {name: 1.0 for name in known if name in usual or name in also}
    return validated(PlannerSettings, settings.model_dump() | {"reward": terms}, "planner settings")


def _common_settings(runs: Sequence[Run], overrides: Mapping[str, Any]) -> PlannerSettings:
    """Return the settings that all runs were made with; the overrides come on top."""
    if not runs:
        return settings_from(overrides)[0]
    first, *others = runs
    plain = first.settings.model_dump()
    for other in others:
        for name, value in other.settings.model_dump().items():
            if value != plain[name] and name not in _OF_THE_SOLVER:
                raise UserError(
                    f"{first.name} and {other.name} differ in planner.{name} ({plain[name]} and "
                    f"{value}): learn from them one at a time"
                )
    changed = settings_from({f"planner.{n}": v for n, v in plain.items()} | dict(overrides))
    return changed[0]
