"""The paper's claims, measured: every scenario, every planner, paired seeds.

    python -m analysis.reproduce [--seeds 0:50] [--workers 2] [--cases "stalled; exit" --out DIR]

Writes into analysis/: claims.csv (each claim's rate with its 95 % Wilson interval), outcomes.csv
(what happened per case and planner), runs.parquet (all metrics of all runs) and reproduce.json
(command, seeds, versions). Each case is a batch in results/reproduce: run it again after a stop and
it goes on from there. What was measured with other code or scenarios is not taken up.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from sumo_cohesion.batches.batch import Progress, batch
from sumo_cohesion.batches.results import with_nominal_deviation
from sumo_cohesion.errors import SimulationError, UserError
from sumo_cohesion.tables.columns import as_table
from sumo_cohesion.tables.intervals import wilson
from sumo_cohesion.tables.metrics import METRICS
from sumo_cohesion.user_input import parse_seeds
from sumo_cohesion.versions import versions

HERE = Path(__file__).resolve().parent
PLANNERS = ("nominal", "cohesive", "paper", "sumo")
OURS = PLANNERS[:3]

Case = tuple[str, Mapping[str, Any]]
CASES: dict[str, Case] = {
    "stalled": ("stalled", {}),
    "stalled_swerve": ("stalled_swerve", {}),
    "ambulance": ("ambulance", {}),
    "ambulance_rescue_lane": ("ambulance_rescue_lane", {}),
    "speeding": ("speeding", {}),
    "exit": ("exit", {}),
    "nothing_to_follow": ("nothing_to_follow", {}),
    "same_speed": ("same_speed", {}),
    "stalled_noise, 0.1": ("stalled_noise", {"human_type.lcSigma": 0.1}),
    "stalled_noise, 0.3": ("stalled_noise", {"human_type.lcSigma": 0.3}),
    "stalled_noise, 1.0": ("stalled_noise", {"human_type.lcSigma": 1.0}),
    "stalled, leads 40 m apart": ("stalled", {"randomize.lead_spacing": [40.0, 40.0]}),
    "stalled_dense": ("stalled_dense", {}),
}


@dataclass(frozen=True)
class Claim:
    """One statement about runs, counted for every planner.

    ``targets`` say, by planner, the least or the largest rate that the claim needs.
    """

    text: str
    cases: Sequence[str]
    holds: Callable[[pd.DataFrame], pd.Series]
    targets: Mapping[str, str]


def _success(runs: pd.DataFrame) -> pd.Series:
    return runs["success"]


def _hits_hidden(runs: pd.DataFrame) -> pd.Series:
    return runs["collision"] & ~runs["collision_visible"]


CLEAN = ["stalled", "stalled_swerve", "stalled, leads 40 m apart"]
HARDER = [case for case in CASES if case.startswith("stalled") and case not in CLEAN]
CLAIMS = (
    Claim(
        "collides with the stalled car",
        CLEAN,
        _hits_hidden,
        {"nominal": ">= 0.95", "cohesive": "<= 0.03"},
    ),
    Claim("collides with the stalled car", HARDER, _hits_hidden, {}),
    Claim(
        "holds the ambulance up by 2.5 s or more",
        ["ambulance"],
        lambda r: r["emergency_delay"] >= 2.5,
        {"nominal": ">= 0.95"},
    ),
    Claim(
        "half a lane aside within 8 s, and the ambulance loses less than 0.5 s",
        ["ambulance"],
        lambda r: (r["yield_time"] <= 8.0) & (r["emergency_delay"] < 0.5),
        {"cohesive": ">= 0.95"},
    ),
    Claim(
        "stays within 0.3 m of where it was",
        ["ambulance_rescue_lane"],
        lambda r: r["max_lateral_shift"] <= 0.3,
        {"nominal": ">= 0.95"},
    ),
    Claim(
        "moves aside with its lane's humans",
        ["ambulance_rescue_lane"],
        _success,
        {"cohesive": ">= 0.90"},
    ),
    Claim(
        "holds the limit within 0.5 m/s",
        ["speeding"],
        lambda r: r["max_speed_shift"] <= 0.5,
        {"nominal": ">= 0.95"},
    ),
    Claim(
        "closes 50 to 100 % of the speed gap, never above the others' mean speed",
        ["speeding"],
        _success,
        {"cohesive": ">= 0.95"},
    ),
    Claim(
        "takes the wrong exit",
        ["exit"],
        lambda r: r["exited"],
        {"nominal": "<= 0.00", "cohesive": ">= 0.90"},
    ),
    Claim(
        "within 1 m and 1.5 m/s of its nominal twin",
        ["nothing_to_follow"],
        _success,
        {"cohesive": ">= 0.90"},
    ),
    Claim(
        "within 1 m and 1.5 m/s of nominal's own run",
        ["nothing_to_follow"],
        lambda r: (r["nominal_lateral_deviation"] <= 1.0) & (r["nominal_speed_deviation"] <= 1.5),
        {},
    ),
    Claim(
        "matches the speed as in speeding, within 1.2 m sideways",
        ["same_speed"],
        _success,
        {"cohesive": ">= 0.95"},
    ),
    Claim(
        "agrees most on the speed's two features in 95 % of its steps or more",
        ["same_speed"],
        lambda r: r["speed_most_agreed"] >= 0.95,
        {},
    ),
    Claim(
        "touches a car that it can see",
        list(CASES),
        lambda r: r["collision_visible"],
        dict.fromkeys(OURS, "<= 0.00"),
    ),
)


def measure(case: str, runs: pd.DataFrame) -> list[dict[str, object]]:
    """Count every claim about a case, per planner."""
    rows: list[dict[str, object]] = []
    for claim in CLAIMS:
        if case not in claim.cases:
            continue
        for planner, own in runs.groupby("planner", sort=False):
            count, n = int(claim.holds(own).sum()), len(own)
            rate, low, high = wilson(count, n)
            target = claim.targets.get(str(planner), "")
            rows.append(
                {
                    "case": case,
                    "claim": claim.text,
                    "planner": planner,
                    "count": count,
                    "n": n,
                    "rate": round(rate, 3),
                    "low": round(low, 3),
                    "high": round(high, 3),
                    "target": target,
                    "met": _met(rate, target),
                    "seeds_against": _seeds_against(own, claim, target),
                }
            )
    return rows


def _met(rate: float, target: str) -> str:
    if not target:
        return ""
    side, bound = target.split()
    return str(rate >= float(bound) if side == ">=" else rate <= float(bound))


def _seeds_against(runs: pd.DataFrame, claim: Claim, target: str) -> str:
    """Seeds that speak against a claim with a target: the ones to look into."""
    if not target:
        return ""
    holds = claim.holds(runs)
    against = ~holds if target.startswith(">=") else holds
    return " ".join(map(str, runs.loc[against, "seed"]))


def outcomes(case: str, runs: pd.DataFrame) -> list[dict[str, object]]:
    """Count what happened in a case, per planner, with medians of the metrics that matter."""
    medians = (
        "distance",
        "max_lateral_shift",
        "speed_gap_closed",
        "max_excess_speed",
        "speed_most_agreed",
        "plan_lateral_change",
        "plan_speed_change",
        "twin_lateral_deviation",
        "twin_speed_deviation",
        "nominal_lateral_deviation",
        "nominal_speed_deviation",
        "emergency_delay",
        "yield_time",
        "aside_share",
        "passing_lane",
        "max_lateral_acceleration",
        "plan_ms_median",
    )
    rows: list[dict[str, object]] = []
    for planner, own in runs.groupby("planner", sort=False):
        counted = ("success", "collision", "collision_visible", "off_road", "exited")
        row: dict[str, object] = {"case": case, "planner": planner, "n": len(own)}
        row |= {name: int(own[name].sum()) for name in counted}
        row["seen_by_sumo"] = int((own["collision"] & own["sumo_collision"]).sum())
        row["fallback_steps"] = int(own["plan_failures"].sum())
        row |= {f"median_{name}": round(float(own[name].median()), 3) for name in medians}
        rows.append(row)
    return rows


def run_cases(
    cases: Mapping[str, Case],
    planners: Sequence[str],
    seeds: Sequence[int],
    workers: int | None,
    work: Path,
) -> dict[str, pd.DataFrame]:
    """Run each case as a batch of its own; what is done already is not done again."""
    tables = {}
    for i, (case, (scenario, overrides)) in enumerate(cases.items()):
        print(f"[{i + 1}/{len(cases)}] {case}", file=sys.stderr)
        experiment = {
            "scenarios": [scenario],
            "planners": list(planners),
            "seeds": list(seeds),
            "set": dict(overrides),
            "keep": ["ego"] if "nominal" in planners else [],
        }
        folder = work / case.replace(", ", "-").replace(" ", "_")
        with told_every_minute(case) as progress:
            runs = batch(experiment, folder, workers=workers, progress=progress)
        failed = runs[runs["status"] != "done"]
        if len(failed):
            raise SimulationError(
                f"{case}, seed {failed['seed'].iloc[0]}: {failed['reason'].iloc[0]}"
            )
        if "nominal" in planners:
            runs = with_nominal_deviation(runs, folder)
        tables[case] = as_table("metrics", {c.name: runs[c.name] for c in METRICS})
    return tables


@contextmanager
def told_every_minute(case: str) -> Iterator[Callable[[Progress], None]]:
    """Print how far a batch is and how long it will take."""
    start = told = time.monotonic()

    def show(progress: Progress) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told > 60.0:
            told = now
            left = (now - start) / progress.done * (progress.total - progress.done)
            print(
                f"    {case}: {progress.done} of {progress.total}, about {left / 60:.0f} min left",
                file=sys.stderr,
            )

    yield show


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0:50")
    parser.add_argument("--cases", default="", help="names with ';' between them; default: all")
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--work", type=Path, default=HERE.parent / "results" / "reproduce")
    given = parser.parse_args(arguments)
    cases = [case.strip() for case in given.cases.split(";")] if given.cases else list(CASES)
    unknown = [case for case in cases if case not in CASES]
    if unknown:
        sys.exit(f"no case {unknown[0]!r}; choose from: {'; '.join(CASES)}")
    if given.cases and given.out == HERE:
        sys.exit("give another --out: the tables in analysis/ are of all cases")
    try:
        seeds = parse_seeds(given.seeds)
        chosen = {case: CASES[case] for case in cases}
        runs = run_cases(chosen, PLANNERS, seeds, given.workers, given.work)
    except KeyboardInterrupt:
        sys.exit("interrupted; what is done is kept, run it again to go on")
    except (UserError, SimulationError) as error:
        sys.exit(f"{error}; what is done is kept, run it again to go on")
    given.out.mkdir(parents=True, exist_ok=True)
    claims = pd.DataFrame([row for case in cases for row in measure(case, runs[case])])
    claims.to_csv(given.out / "claims.csv", index=False)
    table = pd.DataFrame([row for case in cases for row in outcomes(case, runs[case])])
    table.to_csv(given.out / "outcomes.csv", index=False)
    everything = pd.concat([own.assign(case=case) for case, own in runs.items()])
    everything.to_parquet(given.out / "runs.parquet", index=False)
    about = {
        "command": f"python -m analysis.reproduce --seeds {given.seeds}"
        + (f' --cases "{given.cases}"' if given.cases else ""),
        "seeds": given.seeds,
        "cases": {case: {"scenario": CASES[case][0], **CASES[case][1]} for case in cases},
        "fitted_on": "seeds >= 1000",
        "versions": versions(),
    }
    (given.out / "reproduce.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    wanted = claims[claims["target"] != ""]
    print(wanted.drop(columns=["seeds_against", "low", "high"]).to_string(index=False))


if __name__ == "__main__":
    main()
