"""The evidence is made by a script that goes on where it stopped."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from analysis import reproduce


@pytest.mark.slow
def test_a_case_is_run_once_and_its_claims_counted(tmp_path: Path) -> None:
    command = ["--cases", "speeding", "--seeds", "1000:1002", "--workers", "2"]
    folders = ["--out", str(tmp_path / "out"), "--work", str(tmp_path / "work")]
    reproduce.main(command + folders)
    claims = pd.read_csv(tmp_path / "out" / "claims.csv").set_index(["claim", "planner"])
    limit = "holds the limit within 0.5 m/s"
    assert claims.loc[(limit, "nominal"), "count"] == 2
    assert claims.loc[(limit, "cohesive"), "count"] == 0
    assert bool(claims.loc[(limit, "nominal"), "met"])
    assert (claims["n"] == 2).all()
    about = json.loads((tmp_path / "out" / "reproduce.json").read_text())
    assert about["cases"] == {"speeding": {"scenario": "speeding"}}
    assert len(pd.read_parquet(tmp_path / "out" / "runs.parquet")) == 2 * len(reproduce.PLANNERS)
    deviation = pd.read_parquet(tmp_path / "out" / "runs.parquet").set_index("planner")[
        "nominal_speed_deviation"
    ]
    assert (deviation["nominal"] == 0.0).all()
    assert (deviation["cohesive"] > 1.0).all()
    before = (tmp_path / "out" / "claims.csv").read_bytes()
    reproduce.main(command + folders)
    assert len(list((tmp_path / "work" / "speeding" / "runs").glob("*.parquet"))) == 1
    assert (tmp_path / "out" / "claims.csv").read_bytes() == before


def test_an_unknown_case_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no case 'stahled'"):
        reproduce.main(["--cases", "stahled", "--out", str(tmp_path)])


def test_a_part_of_the_cases_does_not_replace_the_evidence() -> None:
    with pytest.raises(SystemExit, match="another --out"):
        reproduce.main(["--cases", "speeding"])


def test_a_rate_meets_its_target_or_does_not() -> None:
    assert reproduce._met(0.95, ">= 0.95") == "True"
    assert reproduce._met(0.04, "<= 0.03") == "False"
    assert reproduce._met(0.04, "") == ""
