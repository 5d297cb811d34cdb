"""What can be learned of theta, and from whom; and what the paper's claims are worth with it.

    python -m analysis.learn [--workers 2] [--real DIR] [--only recovery,claims]

Three studies, each with tables in analysis/:

- recovery: nominal's plans in SUMO traffic, whose theta is known: learn_recovery.csv
  (angle to the truth by number of segments), learn_coverage.csv (how often the 90 % interval of
  a bootstrap over runs holds the truth, in repetitions of other runs each), learn_speed.csv (CPU
  seconds).
- learned: theta from plans, from SUMO's humans, from real humans (CommonRoad scenes in DIR):
  learn_weights.csv, learn_fit.csv (held-out runs).
- claims: every claim of the paper with each theta, after tune, beside the hand-set one, on the same
  seeds: learn_claims.csv.

Each goes on from what the one before has left in results/learn.

Demonstrations are driven on seeds from 1000 on, beta is tuned on 1000:1010, claims are of 0:20.
learn.json has command, seeds and versions.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pandas as pd

from analysis.reproduce import CASES, HERE, measure, run_cases
from sumo_cohesion import learn, tune
from sumo_cohesion.batches.batch import batch
from sumo_cohesion.demonstrations.folders import runs_in
from sumo_cohesion.learning.fit import bootstrap, fit
from sumo_cohesion.learning.learn import INTERVAL
from sumo_cohesion.learning.learned import Learned
from sumo_cohesion.learning.likelihood import Quadratics, quadratics
from sumo_cohesion.learning.segments import Segments, free_directions, make_segments
from sumo_cohesion.learning.told import rounded
from sumo_cohesion.learning.tracks import Cutting
from sumo_cohesion.planning import dynamics
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.planning.stage import CONTROL_SCALE, UNLIMITED, StageParameters
from sumo_cohesion.state import STEP, FloatArray
from sumo_cohesion.versions import versions

WORK = HERE.parent / "results" / "learn"
SCENARIOS = ("stalled_swerve", "ambulance", "speeding", "exit", "nothing_to_follow", "same_speed")
SEEDS, LEARN_SEEDS = range(1000, 1040), range(1000, 1008)
CLAIM_SEEDS = range(20)
SECONDS = 20.0
TEMPERATURE = 1e-3
"""Of noisy demonstrations, in units of the lane's weight."""
PLANNERS = ("nominal", "cohesive")
THETAS = ("plans", "SUMO's humans", "real humans, smooth")
"""What is learned and drives."""
COUNTS, SUBSETS = (25, 50, 100, 200, 400), 20
REPETITIONS, DRAWS = 20, 100
NAMES, TRUTH = RewardWeights().in_use, np.array(RewardWeights().theta)


def demonstrations(planner: str, seeds: range, workers: int | None) -> Path:
    """Drive every scenario; what is done is not done again."""
    folder = WORK / f"{planner}-{len(seeds)}"
    experiment = {
        "scenarios": list(SCENARIOS),
        "planners": [planner],
        "seeds": list(seeds),
        "set": {"duration": SECONDS},
        "keep": ["trajectory", "plan", "horizon"],
    }
    batch(experiment, folder, workers=workers)
    return folder


def recovery(workers: int | None) -> dict[str, pd.DataFrame]:
    """Learn from plans, exact and noisy, and from what was driven: theta is known."""
    runs = runs_in(demonstrations("nominal", SEEDS, workers))
    settings = PlannerSettings()
    settings = settings.model_copy(update={"reward": settings.reward.shape})
    rng = np.random.default_rng(0)
    before = process_time()
    examples = [e for run in runs for e in run.source("plans").examples(Cutting(10))]
    cut = process_time() - before
    plans = make_segments(examples, settings)
    plans = plans.where(plans.dropped == "")
    exact = quadratics(plans, settings)
    noisy = with_noise(plans, exact, TRUTH / TEMPERATURE, settings, rng)
    driven = make_segments(
        [e for r in runs for e in r.source("driven").examples(Cutting(10, bounded=True))], settings
    )
    driven = driven.where(driven.dropped == "")
    kinds = {
        "plans": (plans, exact),
        "plans with Boltzmann noise": (noisy, quadratics(noisy, settings)),
        "driven": (driven, quadratics(driven, settings)),
    }
    rows = []
    for kind, (segments, data) in kinds.items():
        some = data.where(data.penalty <= 0.0)
        for count in (n for n in COUNTS if n <= len(some.free)):
            angles, weights = [], []
            for _ in range(SUBSETS):
                chosen = np.zeros(len(some.free), dtype=bool)
                chosen[rng.permutation(len(chosen))[:count]] = True
                angle, weight = learned_from(some.where(chosen))
                angles.append(angle)
                weights.append(weight)
            rows.append(
                {
                    "demonstrations": kind,
                    "segments": count,
                    "repetitions": SUBSETS,
                    "found": int(np.isfinite(angles).sum()),
                    "angle_median": np.nanmedian(angles),
                    "angle_90": np.nanquantile(angles, 0.9),
                    **pd.DataFrame(weights, columns=list(NAMES)).median().to_dict(),
                }
            )
        del segments
    covered = [coverage(kind, *kinds[kind]) for kind in list(kinds)[:2]]
    return {
        "recovery": pd.DataFrame(rows).round(4),
        "coverage": pd.concat(covered, ignore_index=True).round(4),
        "speed": speed(examples[:500], settings, cut * 500 / len(examples)),
    }


def learned_from(data: Quadratics) -> tuple[float, FloatArray]:
    """Angle (degrees) between learned and true weights, of those that are identified; and w."""
    found = fit(data, NAMES, TRUTH, {}, 0.85)
    known = np.array([name not in found.kept_default for name in NAMES])
    ratio = found.weights / TRUTH
    own = ratio[known]
    if len(own) < 2:
        return np.nan, np.full(len(NAMES), np.nan)
    cosine = own.sum() / np.linalg.norm(own) / np.sqrt(len(own))
    return float(np.degrees(np.arccos(min(cosine, 1.0)))), np.where(known, ratio, np.nan)


def with_noise(
    segments: Segments,
    data: Quadratics,
    theta: FloatArray,
    settings: PlannerSettings,
    rng: np.random.Generator,
) -> Segments:
    """Draw controls around the plans from the Boltzmann distribution of their reward."""
    precision = np.einsum("k,nkij->nij", theta, data.curvature)
    size = precision.shape[1]
    precision[:, np.arange(size), np.arange(size)] += data.fixed
    root = np.linalg.cholesky(np.linalg.inv(precision))
    drawn = (root @ rng.standard_normal((len(root), size, 1)))[:, :, 0] * ~data.fixed
    basis, _ = free_directions(segments)
    controls = segments.controls + (basis @ drawn[:, :, None])[:, :, 0].reshape(
        segments.controls.shape
    )
    lanes = (segments.stages.shape[2] - StageParameters(settings, 0).size) // 2
    bend = StageParameters(settings, lanes).columns("road_curvature").start
    state, states = tuple(segments.start[:, :4].T), []
    for t in range(controls.shape[1]):
        control = tuple((controls[:, t] * CONTROL_SCALE).T)
        bends = segments.stages[:, t, bend]
        state = dynamics.step(state, control, STEP, settings.friction, bends)
        states.append(np.stack(state, axis=1))
    # Who is not optimal is not held by bounds.
    free = {name: np.full_like(segments.low, UNLIMITED) for name in ("high", "change")}
    low = np.full_like(segments.low, -UNLIMITED)
    return replace(segments, controls=controls, states=np.stack(states, axis=1), low=low, **free)


def coverage(kind: str, segments: Segments, data: Quadratics) -> pd.DataFrame:
    """Count the repetitions, of other runs each, whose interval holds the truth."""
    sound = data.penalty <= 0.0
    segments, data = segments.where(sound), data.where(sound)
    seed = np.array([int(name.rsplit("/", 1)[1]) for name in segments.run])
    share = len(SEEDS) // REPETITIONS
    rows = []
    for repetition in range(REPETITIONS):
        first = SEEDS[0] + share * repetition
        mine = (first <= seed) & (seed < first + share)
        own = data.where(mine)
        found = fit(own, NAMES, TRUTH, {}, 0.85)
        samples = bootstrap(own, segments.run[mine], found, DRAWS)
        low, high = np.quantile(samples, INTERVAL, axis=0)
        low, high = rounded(low, np.floor), rounded(high, np.ceil)
        for i, name in enumerate(NAMES):
            if name not in found.kept_default and name != found.anchor:
                held = low[i] <= TRUTH[i] <= high[i]
                rows.append((kind, name, held, found.weights[i] / TRUTH[i], mine.sum()))
    table = pd.DataFrame(rows, columns=["demonstrations", "term", "held", "ratio", "segments"])
    return table.groupby(["demonstrations", "term"], sort=False, as_index=False).agg(
        repetitions=("held", "size"),
        held=("held", "sum"),
        median_ratio=("ratio", "median"),
        median_segments=("segments", "median"),
    )


def speed(examples: Sequence[Any], settings: PlannerSettings, cut: float) -> pd.DataFrame:
    """CPU seconds of every part of the work, for some segments."""
    seconds = {"cut from tables": cut}

    def timed(what: str, work: Callable[[], Any]) -> Any:
        before = process_time()
        result = work()
        seconds[what] = process_time() - before
        return result

    segments = timed("written as instances", lambda: make_segments(examples, settings))
    data = timed("weighed", lambda: quadratics(segments, settings))
    timed("fitted and trimmed", lambda: fit(data, NAMES, TRUTH, {}, 0.85))
    rows = [{"work": what, "segments": len(examples), "seconds": s} for what, s in seconds.items()]
    rows.append({"work": "all", "segments": len(examples), "seconds": sum(seconds.values())})
    return pd.DataFrame(rows).round(2)


def learned(workers: int | None, real: Path | None) -> dict[str, Learned]:
    """Learn theta from a planner's plans, from SUMO's humans, from real ones if there are any."""
    humans: dict[str, Any] = {"source": "humans", "desired": "own"}
    found = {
        "plans": learn(demonstrations("nominal", LEARN_SEEDS, workers)),
        "SUMO's humans": learn(demonstrations("sumo", LEARN_SEEDS, workers), draws=50, **humans),
    }
    if real is not None:
        scenes = sorted(real.glob("*.xml"))
        smooth, smoother = (2.0, 3.0), ["curvature_change", "acceleration_change"]
        found["real humans"] = learn(scenes, smooth=smooth, hold_out=0.5, **humans)
        found["real humans, smooth"] = learn(
            scenes, smooth=smooth, also=smoother, hold_out=0.5, **humans
        )
    for name, one in found.items():
        one.write(theta_file(name))
    return found


def theta_file(name: str) -> Path:
    """File of what was learned."""
    return WORK / "theta" / f"{name.replace(', ', '_').replace(' ', '_')}.toml"


def claims(names: Sequence[str], workers: int | None) -> pd.DataFrame:
    """Every claim with each theta, after tune, beside the hand-set weights."""
    tables = []
    known = pd.read_parquet(HERE / "runs.parquet")  # of make reproduce: the same seeds
    known = known[known["seed"].isin(CLAIM_SEEDS) & known["planner"].isin(PLANNERS)]
    runs = {case: known[known["case"] == case] for case in CASES}
    tables.append(measured(runs).assign(theta="hand-set", beta=np.nan))
    for name in names:
        file = theta_file(name)
        beta = tune(file, workers=workers).beta
        changed = {"planner.reward": f"@{file}", "cohesion.beta": f"@{file}"}
        cases = {case: (scenario, {**o, **changed}) for case, (scenario, o) in CASES.items()}
        folder = WORK / "claims" / file.stem
        runs = run_cases(cases, PLANNERS, list(CLAIM_SEEDS), workers, folder)
        tables.append(measured(runs).assign(theta=name, beta=beta))
    return pd.concat(tables, ignore_index=True)


def measured(runs: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Count every claim in every case."""
    return pd.DataFrame([row for case, found in runs.items() for row in measure(case, found)])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--real", type=Path, default=None, help="folder of CommonRoad scenes")
    parser.add_argument("--only", default="recovery,learned,claims")
    given = parser.parse_args(arguments)
    parts = given.only.split(",")
    tables: dict[str, pd.DataFrame] = {}
    if "recovery" in parts:
        tables |= recovery(given.workers)
    if "learned" in parts:
        found = learned(given.workers, given.real)
        for table in ("weights", "fit"):
            rows = [getattr(one, table).assign(theta=name) for name, one in found.items()]
            tables[table] = pd.concat(rows, ignore_index=True)
    if "claims" in parts:
        driven = [name for name in THETAS if theta_file(name).is_file()]
        tables["claims"] = claims(driven, given.workers)
    for name, table in tables.items():
        table.to_csv(HERE / f"learn_{name}.csv", index=False, float_format="%.5g")
        print(table.to_string(index=False))
    about = {
        "command": f"python -m analysis.learn --only {given.only}"
        + (" --real DIR" if given.real else ""),
        "recovery": f"demonstrations of seeds {SEEDS[0]}:{SEEDS[-1] + 1}",
        "learned": f"demonstrations of seeds {LEARN_SEEDS[0]}:{LEARN_SEEDS[-1] + 1}",
        "tuned_on": "seeds 1000:1010",
        "claims": f"seeds {CLAIM_SEEDS[0]}:{CLAIM_SEEDS[-1] + 1}",
        "versions": versions(),
    }
    (HERE / "learn.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
