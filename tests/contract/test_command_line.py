"""The command line as a new user meets it: hints, notes, and what to do instead."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

from sumo_cohesion.cli.running import SUMO_OUTPUTS
from sumo_cohesion.traffic.outputs import Output
from sumo_cohesion.user_input import seeds_of
from tests.conftest import ROOT
from tests.contract import test_wrong_input
from tests.contract.test_wrong_input import Invoke, assert_one_line

invoke = test_wrong_input.invoke

SHORT = ("--set", "duration=1.0")
EXPERIMENT = "scenarios = ['stalled']\nseeds = '0:2'\nplanners = ['sumo']\n"
CARELESS = """
class Careless:
    def reset(self, road):
        self.lanes = road.lanes
    def plan(self, observation, history): ...
"""


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("x.sumocfg", "SUMO configuration"),
        ("x.net.xml", "SUMO network"),
        ("x.net.xml.gz", "SUMO network"),
        ("x.rou.xml", "SUMO route file"),
        ("x.xml", "SUMO file"),
    ],
)
@pytest.mark.parametrize("command", ["run", "compare", "batch"])
def test_sumos_own_files_are_told(invoke: Invoke, command: str, name: str, kind: str) -> None:
    assert_one_line(invoke(command, name), f"is a {kind}, not a scenario", ".toml")


def test_a_scenario_is_not_an_experiment(invoke: Invoke) -> None:
    Path("mine.toml").write_text((ROOT / "scenarios" / "stalled.toml").read_text())
    Path("beta.toml").write_text(EXPERIMENT)
    assert_one_line(invoke("batch", "mine.toml"), "is a scenario", "sumo-cohesion run mine.toml")
    for command in ("run", "compare"):
        result = invoke(command, "beta.toml")
        assert_one_line(result, "is an experiment", "sumo-cohesion batch beta.toml")


@pytest.mark.slow
def test_a_figure_of_what_is_no_run_says_what_is_there(invoke: Invoke) -> None:
    assert_one_line(invoke("figure", "nothere"), "nothere: no such folder")
    assert_one_line(invoke("figure", "."), "no run there")
    assert_one_line(invoke("metrics", "nothere"), "nothere: no such folder")
    for seed in ("0", "1"):
        out = ("--seed", seed, "--out", f"runs/{seed}")
        assert invoke("run", "stalled", "--planner", "sumo", *SHORT, *out)[0] == 0
    assert_one_line(invoke("figure", "runs"), "2 runs lie below", "name one, e.g. runs/0")
    assert invoke("figure", "runs/0")[0] == 0


def test_the_help_that_is_named_is_the_commands_own(invoke: Invoke) -> None:
    assert_one_line(invoke("run"), "'SCENARIO'", "(sumo-cohesion run --help)")
    assert_one_line(
        invoke("scenario", "export", "stalled"), "(sumo-cohesion scenario export --help)"
    )
    assert_one_line(invoke("flyy"), "(sumo-cohesion --help)")


@pytest.mark.slow
@pytest.mark.parametrize("command", [["run"], ["compare", "--seeds", "0:2"]])
def test_a_planner_that_raises_in_reset_is_one_line_or_all_of_it(
    invoke: Invoke,
    command: list[str],
) -> None:
    module = f"careless_{command[0]}"
    Path(f"{module}.py").write_text(CARELESS)
    name = "--planner" if command == ["run"] else "--planners"
    asked = (*command, "stalled", name, f"{module}.py:Careless", *SHORT)
    line = "reset() raised AttributeError", f"({module}.py:4)"
    assert_one_line(invoke(*asked), *line, "--traceback shows all of it")
    status, out, err = invoke(*asked, "--traceback")
    assert (status, out) == (2, "")
    assert "in reset\n    self.lanes = road.lanes\n" in err
    assert err.splitlines()[-1].startswith("error: planner Careless")


def test_a_mistake_of_ours_has_nothing_to_trace(invoke: Invoke) -> None:
    for more in ((), ("--traceback",)):
        result = invoke("run", "staled", *more)
        assert_one_line(result, "did you mean 'stalled'")
        assert "--traceback" not in result[2]


@pytest.mark.slow
def test_one_number_of_seeds_is_told_to_be_one_seed(invoke: Invoke) -> None:
    asked = ("compare", "stalled", "--planners", "sumo", *SHORT, "--seeds")
    status, _, err = invoke(*asked, "3")
    assert status == 0
    assert "note: --seeds 3 is the one seed 3; 0:3 is 3 seeds" in err
    assert "note" not in invoke(*asked, "0:2")[2]


def test_what_is_said_where_there_is_no_terminal_is_said_in_lines(invoke: Invoke) -> None:
    result = invoke("compare", "stalled", "--planners", "nominal,wrong")
    assert_one_line(result)  # no bar, no empty line before it


@pytest.mark.slow
def test_a_dry_run_counts_and_an_estimate_measures(invoke: Invoke) -> None:
    Path("e.toml").write_text(EXPERIMENT + "[set]\nduration = 1.0\n")
    status, out, _ = invoke("batch", "e.toml", "--dry-run")
    assert status == 0
    assert "2 of 2 runs are left for results/e; --estimate says how long" in out
    plan = json.loads(invoke("batch", "e.toml", "--dry-run", "--json")[1])
    assert plan["hours"] is None
    assert "2 runs are left for results/e: about" in invoke("batch", "e.toml", "--estimate")[1]
    assert not Path("results").exists()


@pytest.mark.slow
def test_sumos_own_outputs_of_one_run(invoke: Invoke) -> None:
    assert get_args(Output) == SUMO_OUTPUTS
    assert_one_line(invoke("run", "stalled", "--sumo-outputs", "fdc"), "did you mean 'fcd'")
    assert_one_line(invoke("run", "stalled", "--sumo-outputs", "fcd"), "--out")
    asked = ("--sumo-outputs", "fcd,tripinfo", "--out", "r")
    assert invoke("run", "stalled", "--planner", "sumo", *SHORT, *asked)[0] == 0
    assert sorted(p.name for p in Path("r").glob("sumo_*")) == [
        "sumo_fcd.parquet",
        "sumo_tripinfo.parquet",
    ]


def test_info_says_what_this_stands_on(invoke: Invoke) -> None:
    status, out, _ = invoke("info")
    assert status == 0
    told = dict(line.split(maxsplit=1) for line in out.splitlines() if len(line.split()) == 2)
    assert {"sumo-cohesion", "casadi", "python"} <= set(told)
    for name in ("SUMO (libsumo)", "C compiler", "compiled planners"):
        assert name in out
    folder = out.splitlines()[-1].removeprefix("bundled scenarios").strip()
    assert (Path(folder) / "stalled.toml").is_file()


@pytest.mark.parametrize(
    ("change", "needles"),
    [
        ("seeds = 5", ["seeds", "is one number; write [5]", "0:5"]),
        ("seeds = [0.0]", ["seeds", "0.0 is no valid integer"]),
        ("seeds = '5:5'", ["seeds", "empty"]),
        ("seeds = ['a']", ["seeds", "'a' is no valid integer"]),
        ("seeds = [1]\nscenarios = 5", ["scenarios", "should be a list"]),
        ("seeds = [1]\ngrid = [1]", ["grid", "should be a table"]),
        ("seeds = [1]\nlimits = 5", ["limits", "should be a table"]),
        ("seeds = [1]\nkeep = ['x']\n[limits]\nrun_time = -1.0", ["keep", "look at limits, too"]),
        ("seeds = [1]\n[set]\nduration = 1.0\n[grid]\nduration = [1.0]", ["both in [set] and"]),
        ("seeds = [1]\n[grid]\ncohesion.bta = [1.0]", ["did you mean 'beta'"]),
        ("seeds = [1]\nplanners = 'nominl'", ["did you mean 'nominal'"]),
    ],
)
def test_mistakes_in_an_experiment_name_its_file(
    invoke: Invoke,
    change: str,
    needles: list[str],
) -> None:
    scenarios = "" if "scenarios" in change else "scenarios = 'stalled'\n"
    Path("mine.toml").write_text(scenarios + change)
    assert_one_line(invoke("batch", "mine.toml"), "mine.toml: ", *needles)


def test_listing_scenarios_is_light() -> None:
    assert not heavy_after("scenarios")


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["run", "--help"], ["batch", "--help"], ["tune", "-h"], ["learn", "-h"]],
)
def test_help_is_light(arguments: list[str]) -> None:
    assert not heavy_after(*arguments)


def heavy_after(*arguments: str) -> list[str]:
    """Return which of the large libraries a command has loaded."""
    code = (
        "import sys, atexit\n"
        "heavy = {'pandas', 'scipy', 'casadi', 'libsumo', 'matplotlib'}\n"
        "atexit.register(lambda: print(*sorted(heavy & set(sys.modules)), file=sys.stderr))\n"
        "from sumo_cohesion.cli import main\n"
        "main()\n"
    )
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout
    return done.stderr.split()


def test_python_m_is_the_command_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sumo_cohesion", "run"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: Missing argument 'SCENARIO'")


def test_seeds_however_given() -> None:
    assert seeds_of("0:3") == seeds_of(range(3)) == seeds_of([0, 1, 2]) == seeds_of("0,1,2")
    for wrong in ("", "3:1", "a", "1:2:3", 5, True, 5.0, None, [True], [0.5], range(10**9)):
        with pytest.raises(ValueError, match=r"write|empty|integer|million"):
            seeds_of(wrong)
