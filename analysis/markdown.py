"""The tables of docs/evidence.md, made of analysis/*.csv.

    python -m analysis.markdown

Each table stands between two comments that name it; a test holds that they are up to date.
"""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd

HERE = Path(__file__).resolve().parent
EVIDENCE = HERE.parent / "docs" / "evidence.md"
CONTACT = "touches a car that it can see"
PLANNERS = ("nominal", "cohesive", "paper", "sumo")


def claims_table(claims: pd.DataFrame) -> str:
    """One row per claim and case: counts with Wilson intervals, bold where a target is missed."""
    lines = [
        "| case | claim | " + " | ".join(f"`{p}`" for p in PLANNERS) + " |",
        "|---|---|" + "---|" * len(PLANNERS),
    ]
    told = claims[claims["claim"] != CONTACT]  # hardly ever; the text says when
    for (claim, case), rows in told.groupby(["claim", "case"], sort=False):
        cells = [_rate(rows[rows["planner"] == planner].iloc[0]) for planner in PLANNERS]
        lines.append(f"| {case} | {claim} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _rate(row: pd.Series) -> str:
    text = f"{row['count']} ({100 * row['low']:.0f}-{100 * row['high']:.0f} %)"
    if not isinstance(row["target"], str) or not row["target"]:
        return text
    side, bound = row["target"].split()
    text += f", wanted {'≥' if side == '>=' else '≤'} {100 * float(bound):.0f} %"
    return text if str(row["met"]) == "True" else f"**{text}**"


def ablation_table(ablation: pd.DataFrame) -> str:
    """One row per piece taken out, one column per scenario: successes."""
    scenarios = list(dict.fromkeys(ablation["scenario"]))
    lines = [
        "| changed | " + " | ".join(f"`{s}`" for s in scenarios) + " |",
        "|---|" + "---|" * len(scenarios),
    ]
    for piece, rows in ablation.groupby("changed", sort=False):
        by_scenario = rows.set_index("scenario")["success"]
        cells = [str(by_scenario[s]) for s in scenarios]
        lines.append(f"| {piece} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def with_tables(text: str) -> str:
    """Return the document with its tables renewed."""
    tables = {
        "claims": claims_table(pd.read_csv(HERE / "claims.csv")),
        "ablation": ablation_table(pd.read_csv(HERE / "ablation.csv")),
    }
    for name, table in tables.items():
        pattern = rf"(<!-- {name} -->\n).*?(\n<!-- end -->)"
        text, found = re.subn(
            pattern, lambda m, new=table: m[1] + new + m[2], text, flags=re.DOTALL
        )
        if found != 1:
            raise SystemExit(f"{EVIDENCE}: no place for the table {name!r}")
    return text


if __name__ == "__main__":
    EVIDENCE.write_text(with_tables(EVIDENCE.read_text(encoding="utf-8")), encoding="utf-8")
