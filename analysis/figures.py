"""The paper's figures from own runs: seed 0 of each scenario, nominal and cohesive (noise: seed 4).

    python analysis/figures.py [--out docs/figures]

Writes one PNG per figure; less than a minute.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sumo_cohesion import Rollout, run
from sumo_cohesion.planning.landscape import reward_landscape
from sumo_cohesion.report import paper
from sumo_cohesion.report.drawing import save
from sumo_cohesion.road import Road
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.setup import prepare
from sumo_cohesion.state import FloatArray, Observation, RoadState

HERE = Path(__file__).resolve().parent
SEED = 0
PLANNERS = ("nominal", "cohesive")
DRIVING = ("stalled_swerve", "ambulance", "speeding", "exit")
FEATURES_AT = 8.0
"""Seconds into `same_speed`: humans in every lane."""
NOISE_SCENARIO = "stalled_noise"
NOISE_SETTING = "human_type.lcSigma"
NOISE_SEED = 4
"""The first seed at which the cohesive car collides at the highest level: 14 runs of 50."""
NOISE = (0.1, 0.3, 1.0)
"""Metres; SUMO's noise of where across its lane a human drives."""
DPI = 130


def pair(scenario: str, seed: int = SEED, **overrides: float) -> tuple[Rollout, Rollout]:
    nominal, cohesive = (run(scenario, p, seed, overrides=overrides) for p in PLANNERS)
    return nominal, cohesive


def seen(rollout: Rollout, road: Road, time: float) -> Observation:
    """Return what the ego saw at the step nearest to a time, from the trajectory table."""
    table = rollout.trajectory
    step = table["time"].iloc[int((table["time"] - time).abs().argmin())]
    now = table[(table["time"] == step) & table["visible"]]
    ego, others = now[now["vehicle"] == "ego"].iloc[0], now[now["vehicle"] != "ego"]
    columns = ["s", "d", "road_heading", "speed"]
    return Observation(
        time=float(step),
        ego=RoadState(*(float(ego[name]) for name in columns)),
        ego_size=(float(ego["length"]), float(ego["width"])),
        ids=tuple(others["vehicle"]),
        states=others[columns].to_numpy(float),
        sizes=others[["length", "width"]].to_numpy(float),
        curvature=road.curvature_at(others["s"].to_numpy(float)),
        voter=(True,) * len(others),
    )


def features(scenario: str) -> Figure:
    setup = prepare(RunRequest(scenario, "nominal", SEED))
    rollout = run(scenario, "nominal", SEED)
    observation = seen(rollout, setup.road, FEATURES_AT)
    ego = observation.ego
    s: FloatArray = np.linspace(ego.s - 70.0, ego.s + 90.0, 641)
    right, left = setup.road.drivable_at(s, np.full(s.shape, ego.d))
    d: FloatArray = np.linspace(right.min() - 0.4, left.max() + 0.4, 121)
    terms = reward_landscape(observation, setup.road, setup.settings, s, d)
    return paper.draw_features(rollout, FEATURES_AT, s, d, terms)


def noise() -> Figure:
    cases = [
        (f"{NOISE_SETTING} {level} m", rollout)
        for level in NOISE
        for rollout in pair(NOISE_SCENARIO, NOISE_SEED, **{NOISE_SETTING: level})
    ]
    return paper.draw_noise(cases)


def rates(table: Path) -> pd.DataFrame:
    """Rates of analysis/claims.csv, contacts with visible cars aside: there are hardly any."""
    claims = pd.read_csv(table).rename(columns={"case": "scenario"})
    return claims[claims["claim"] != "touches a car that it can see"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE.parent / "docs" / "figures")
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    figures = {
        "features": lambda: features("same_speed"),
        "scenarios": lambda: paper.draw_scenarios([pair(scenario) for scenario in DRIVING]),
        "nothing_to_match": lambda: paper.draw_nothing_to_match(*pair("nothing_to_follow")),
        "common_feature": lambda: paper.draw_common_feature(*pair("same_speed")),
        "noise": noise,
        "rates": lambda: paper.draw_rates(rates(HERE / "claims.csv")),
    }
    for name, draw in figures.items():
        path = save(draw(), out / f"{name}.png", dpi=DPI)
        print(f"{path}: {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
