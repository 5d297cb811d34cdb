"""Tables of docs/evidence.md, planner.md and learning.md, made of analysis/ and benchmarks/.

    python -m analysis.markdown

Each table stands between two comments that name it; a test holds that they are up to date.
"""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd

HERE = Path(__file__).resolve().parent
DOCS = HERE.parent / "docs"
EVIDENCE, PLANNER = DOCS / "evidence.md", DOCS / "planner.md"
LEARNING = DOCS / "learning.md"
BENCHMARKS = HERE.parent / "benchmarks"
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


def horizon_table(horizon: pd.DataFrame) -> str:
    """One row per horizon and place of cohesion: successes, and what it costs."""
    # Success in `exit` is to stay; what the paper expects of the cohesive car is to be tricked.
    counted = horizon.assign(
        count=horizon["success"].where(horizon["scenario"] != "exit", horizon["exited"])
    )
    scenarios = list(dict.fromkeys(horizon["scenario"]))
    names = ["`exit` (tricked)" if s == "exit" else f"`{s}`" for s in scenarios]
    names += ["off the road", "interventions", "ms per plan"]
    lines = ["| planned, cohesive on | " + " | ".join(names) + " |", "|---|" + "---|" * len(names)]
    for change, rows in counted.groupby("changed", sort=False):
        by_scenario = rows.set_index("scenario")["count"]
        cells = [str(by_scenario[s]) for s in scenarios]
        cells += [str(rows["off_road"].sum()), str(rows["interventions"].sum())]
        cells.append(f"{rows['median_plan_ms'].median():.1f}")
        lines.append(f"| {change} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def solvers_table(planner: pd.DataFrame, horizon: int) -> str:
    """One row per method: times of cold and warm solves, beside ours."""
    rows = planner[planner["horizon"] == horizon].set_index(["start", "method"])
    warm, cold = rows.loc["warm"], rows.loc["cold"]
    lines = [
        "| method | warm, ms | 99 % | cold, ms | 99 % | times ours (warm) | gap | failed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in warm["median_ms"].sort_values().index:
        w, c = warm.loc[name], cold.loc[name]
        numbers = [w["median_ms"], w["p99_ms"], c["median_ms"], c["p99_ms"]]
        cells = [f"{v:.2f}" for v in numbers] + [f"{w['times_ours']:.1f}"]
        cells += [f"{int(w[k] + c[k])} of {int(w['n'] + c['n'])}" for k in ("gap", "failed")]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def rooms_sentence(report: str) -> str:
    """Say what benchmarks/rooms.txt says of the cost of perception and social."""
    (few,) = re.findall(r"median ratio of 5 seeds (\S+)", report)
    stream = sorted(re.findall(r"^stream.*ratio (\S+)$", report, re.MULTILINE))
    return (
        f"In `stalled` (3 to 7 humans) they take {few} times as long as SUMO's step (median of five"
        f" seeds),\nin a stream of traffic {stream[0]} to {stream[-1]} times."
    )


def _rows(heads: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def recovery_table(recovery: pd.DataFrame, coverage: pd.DataFrame) -> str:
    """Angles to the true weights by number of segments; how often intervals hold the truth."""
    counts = sorted(recovery["segments"].unique())
    rows = []
    for kind, found in recovery.groupby("demonstrations", sort=False):
        by_count = found.set_index("segments")
        cells = [
            f"{by_count['angle_median'][n]:.2g}° ({by_count['angle_90'][n]:.2g}°)"
            if n in by_count.index
            else "-"
            for n in counts
        ]
        rows.append([str(kind), *cells])
    angles = _rows(["learned from", *[f"{n} segments" for n in counts]], rows)
    terms = list(dict.fromkeys(coverage["term"]))
    rows = []
    for kind, found in coverage.groupby("demonstrations", sort=False):
        by_term = found.set_index("term")
        cells = [
            f"{by_term['held'][t]} of {by_term['repetitions'][t]}" if t in by_term.index else "-"
            for t in terms
        ]
        rows.append([str(kind), *cells])
    return angles + "\n\n" + _rows(["interval holds the truth", *terms], rows)


def speed_table(speed: pd.DataFrame) -> str:
    """CPU seconds of each part of the work."""
    n = int(speed["segments"].iloc[0])
    rows = [[str(r.work), f"{r.seconds:.1f}"] for r in speed.itertuples()]
    return _rows([f"{n} segments of 10 steps", "CPU seconds"], rows)


def learned_weights_table(weights: pd.DataFrame) -> str:
    """One row per term, a column per theta: the weight, in brackets where it is the default."""
    thetas = list(dict.fromkeys(weights["theta"]))
    rows = []
    for term, found in weights.groupby("term", sort=False):
        by_theta = found.set_index("theta")
        cells = []
        for theta in thetas:
            if theta not in by_theta.index:
                cells.append("-")
                continue
            row = by_theta.loc[theta]
            cells.append(f"{row['learned']:.3g}" if row["identified"] else f"({row['learned']:g})")
        rows.append([f"`{term}`", f"{found['default'].iloc[0]:g}", *cells])
    return _rows(["term", "hand-set", *thetas], rows)


def learned_claims_table(claims: pd.DataFrame) -> str:
    """One row per claim and case; of every theta nominal's and cohesive's counts."""
    thetas = list(dict.fromkeys(claims["theta"]))
    betas = claims.groupby("theta")["beta"].first()
    heads = [t if pd.isna(betas[t]) else f"{t}, β = {betas[t]:.3g}" for t in thetas]
    n = int(claims["n"].iloc[0])
    rows = []
    told = claims[claims["claim"] != CONTACT]
    for (claim, case), found in told.groupby(["claim", "case"], sort=False):
        cells = []
        for theta in thetas:
            counts = found[found["theta"] == theta].set_index("planner")
            shown = [_count(counts.loc[planner]) for planner in ("nominal", "cohesive")]
            cells.append(" / ".join(shown))
        rows.append([str(case), str(claim), *cells])
    touched = []
    for theta in thetas:
        found = claims[(claims["claim"] == CONTACT) & (claims["theta"] == theta)]
        sums = found.groupby("planner")["count"].sum()
        touched.append(f"{sums['nominal']} / {sums['cohesive']}")
    rows.append(["all", CONTACT, *touched])
    head = f"claim, nominal / cohesive of {n}"
    return _rows(["case", head, *heads], rows)


def _count(row: pd.Series) -> str:
    missed = isinstance(row["target"], str) and row["target"] and str(row["met"]) != "True"
    return f"**{row['count']}**" if missed else str(row["count"])


def held_out_table(fit: pd.DataFrame) -> str:
    """One row per theta and model: log-likelihood and displacements on runs held out."""
    rows = []
    for r in fit.itertuples():
        numbers = (r.log_likelihood, r.off_1s, r.off_2s, r.off_3s)
        cells = ["-" if pd.isna(n) else f"{n:.3g}" for n in numbers]
        rows.append([str(r.theta), str(r.model), *cells, str(r.windows)])
    heads = ["driving", "model", "nats per s", "m off, 1 s", "2 s", "3 s", "windows"]
    return _rows(heads, rows)


def pages() -> dict[Path, dict[str, str]]:
    """Tables of each page, by name."""
    solvers = pd.read_csv(BENCHMARKS / "planner.csv")
    learned = {
        name: pd.read_csv(HERE / f"learn_{name}.csv")
        for name in ("recovery", "coverage", "speed", "weights", "claims", "fit")
    }
    return {
        EVIDENCE: {
            "claims": claims_table(pd.read_csv(HERE / "claims.csv")),
            "ablation": ablation_table(pd.read_csv(HERE / "ablation.csv")),
            "rooms": rooms_sentence((BENCHMARKS / "rooms.txt").read_text(encoding="utf-8")),
        },
        PLANNER: {
            "horizon": horizon_table(pd.read_csv(HERE / "horizon.csv")),
            "solvers 10": solvers_table(solvers, 10),
            "solvers 40": solvers_table(solvers, 40),
        },
        LEARNING: {
            "learn:recovery": recovery_table(learned["recovery"], learned["coverage"]),
            "learn:speed": speed_table(learned["speed"]),
            "learn:weights": learned_weights_table(learned["weights"]),
            "learn:closed loop": learned_claims_table(learned["claims"]),
            "learn:held-out": held_out_table(learned["fit"]),
        },
    }


def with_tables(page: Path, tables: dict[str, str]) -> str:
    """Return the page with its tables renewed."""
    text = page.read_text(encoding="utf-8")
    for name, table in tables.items():
        pattern = rf"(<!-- {name} -->\n).*?(\n<!-- end -->)"
        text, found = re.subn(
            pattern, lambda m, new=table: m[1] + new + m[2], text, flags=re.DOTALL
        )
        if found != 1:
            raise SystemExit(f"{page}: no place for the table {name!r}")
    return text


if __name__ == "__main__":
    for page, tables in pages().items():
        page.write_text(with_tables(page, tables), encoding="utf-8")
