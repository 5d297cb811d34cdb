"""Learn theta from files and folders: one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from sumo_cohesion.user_input import closest

KINDS = get_args(Kind)
_DID = {"plans": "planned", "driven": "drove", "humans": ""}
KEEP = {"plans": 0.85, "driven": 0.85, "humans": 0.95}
"""Share of the segments that the fit is made of, unless told otherwise."""
SMOOTH = {"plans": (0.0, 0.0), "driven": (0.0, 0.0), "humans": (1.0, 2.0)}
"""Seconds along and across the road, unless told otherwise: planners drive without noise."""
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
    _check(source, steps, smooth, desired, keep, hold_out, draws)
    settings, _, of_scenario = settings_from(overrides or {})
    for name in of_scenario:
        raise UserError(f"{name} is a scenario's: learn takes planner.* settings only")
    paths = [Path(p) for p in ([demos] if isinstance(demos, str | Path) else demos)]
    if not paths:
        raise UserError("nothing to learn from: give folders of runs, or files of driving")
    runs = [run for path in paths if path.is_dir() for run in runs_in(path)]
    if runs:
        settings = _common_settings(runs, overrides or {})
    if runs and source != "humans" and not all(path.is_dir() for path in paths):
        raise UserError(f"files hold humans, not what a planner {_DID[source]}: --from humans")
    files = _recordings([path for path in paths if not path.is_dir()], network, demand)
    sources = [*[run.source(source) for run in runs], *map(Tracks, files)]
    settings = settings.model_copy(update={"reward": _reward(also)})
    length = steps or (settings.horizon if source == "plans" and runs else 10)
    how = Cutting(
        steps=length,
        smooth=smooth or SMOOTH[source if runs else "humans"],
        own_speed=desired == "own",
        friction=settings.friction,
        by_vehicle=source == "humans" or not runs,
        bounded=source == "driven",
    )
    exact = source == "plans" and not files
    shown = source if runs else "humans"
    options = Options(
        KEEP[shown] if keep is None else keep, dict(fix or {}), hold_out, draws, exact
    )
    about = {
        "demonstrations": [str(path) for path in paths],
        "source": shown,
        "smooth": list(how.smooth),
        "desired": desired,
        "notes": [note for recording in files for note in recording.notes],
    }
    return learn_from(sources, how, settings, options, about, progress)


def _recordings(
    paths: Sequence[Path], network: str | Path | None, demand: Sequence[str | Path]
) -> list[Recording]:
    """Read files of driving."""
    from sumo_cohesion.demonstrations.reading import read
    from sumo_cohesion.traffic.network import Network

    on = Network(Path(network)) if network is not None and paths else None
    found = []
    for path in paths:
        if not path.exists():
            raise UserError(f"{path}: there is no such file or folder to learn from")
        found.append(read(path, on, [Path(file) for file in demand]))
    return found


def _check(
    source: str,
    steps: int | None,
    smooth: tuple[float, float] | None,
    desired: str,
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
    if keep is not None and not 0.1 <= keep <= 1.0:
        raise UserError(f"keep {keep:g}: a share of 0.1 to 1")
    if not 0.0 <= hold_out <= 0.9:
        raise UserError(f"hold_out {hold_out:g}: a share of 0 to 0.9")
    if not 0 <= draws <= 100_000:
        raise UserError(f"draws {draws}: 0 to 100000")


def _reward(also: Sequence[str]) -> RewardWeights:
    """Return weights that have the terms in use that are to be learned."""
    usual, known = RewardWeights().in_use, list(RewardWeights.model_fields)
    for name in also:
        if name not in known:
            raise UserError(f"also: there is no reward term {name!r}{closest(name, known)}")
    return RewardWeights(**{name: 1.0 for name in known if name in usual or name in also})


def _common_settings(runs: Sequence[Run], overrides: Mapping[str, Any]) -> PlannerSettings:
    """Return the settings that all runs were made with; the overrides come on top."""
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
