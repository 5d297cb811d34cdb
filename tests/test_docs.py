"""The README and the docs say what is true: their commands and code run, their tables match."""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from analysis import markdown
from sumo_cohesion import cli
from sumo_cohesion.batches.experiment import Experiment, RunLimits, load_experiment, spell_out
from sumo_cohesion.cli import learning
from sumo_cohesion.simulation.scenario import Scenario
from sumo_cohesion.tables.columns import describe_tables
from tests.conftest import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
LOCK = (ROOT / "requirements.lock").read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


@pytest.mark.slow
def test_readme_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "readme"}
    for block in blocks(README, "python"):  # one after the other, as in a notebook
        exec(compile(block, "README.md", "exec"), names)
    assert names["episode"].outcome == "collision"  # type: ignore[attr-defined]


@pytest.mark.slow
def test_readme_commands_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "straight.py").write_text(blocks(README, "python")[1])
    (experiment,) = blocks(README, "toml")
    short = experiment.replace("[grid]", "[set]\nduration = 2.0\n[grid]").replace("0:20", "0:2")
    (tmp_path / "humans.toml").write_text(short)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    commands = [line for block in blocks(README, "sh") for line in block.splitlines() if line]
    assert len(commands) >= 8
    for command in commands:
        words = shlex.split(command, comments=True)
        assert words[0] == "sumo-cohesion"
        # The same commands, on fewer and shorter runs.
        words = ["7:9" if word == "0:20" else word for word in words]
        if words[1] in ("run", "compare"):
            words += ["--set", "duration=3.0"]
        monkeypatch.setattr(sys, "argv", words)
        cli.main()
    assert (tmp_path / "stalled" / "paths.png").stat().st_size > 10_000
    assert (tmp_path / "plain" / "scenario.sumocfg").is_file()
    assert "scenario,planner,seed,success" in capsys.readouterr().out


def test_links_exist() -> None:
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\((?!http)([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), target


def test_what_an_index_shows_has_no_links_into_the_repository() -> None:
    about = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    page = (ROOT / about["readme"]).read_text(encoding="utf-8")
    assert not re.findall(r"\]\((?!http)", page)
    assert about["authors"]
    assert "pip install sumo-cohesion" not in README  # before there is one to install


def test_the_lock_keeps_what_is_declared() -> None:
    about = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    locked = dict(re.findall(r"^([\w.-]+)==([\w.]+)", LOCK, flags=re.MULTILINE))
    for name, least in re.findall(r"([\w-]+)>=([\d.]+)", " ".join(about["dependencies"])):
        assert numbers(locked[name]) >= numbers(least), name


def numbers(version: str) -> list[int]:
    return [int(part) for part in version.split(".") if part.isdigit()]


def test_no_shell_reads_brackets_that_are_not_quoted() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    for text in (page.read_text(encoding="utf-8") for page in pages):
        spans = re.findall(r"`([^`\n]+)`", text)
        lines = [line for block in blocks(text, "sh") for line in block.splitlines()]
        for command in (*spans, *lines):
            if command.startswith(("sumo-cohesion ", "pip ", "--")):
                bare = re.sub(r"'[^']*'|\"[^\"]*\"|#.*", "", command)
                assert not set("[](){}*?") & set(bare), command


def test_tables_page_matches_the_code() -> None:
    page = (ROOT / "docs" / "tables.md").read_text(encoding="utf-8")
    assert page == describe_tables(), "run: make docs"


def test_scenario_page_shows_every_key_and_a_valid_file() -> None:
    (example,) = blocks((ROOT / "docs" / "scenarios.md").read_text(encoding="utf-8"), "toml")
    data = tomllib.loads(example)
    Scenario.model_validate(data)
    fields = Scenario.model_fields
    assert set(data) == set(fields)
    for name in ("ego", "sensing", "fleet", "randomize"):
        kind = fields[name].annotation
        assert kind is not None
        assert set(data[name]) == set(kind.model_fields)
    bundled = tomllib.loads((ROOT / "scenarios" / "stalled.toml").read_text())
    shared = {k: v for k, v in data.items() if k in bundled and not isinstance(v, dict)}
    assert shared == {k: bundled[k] for k in shared}


@pytest.mark.slow
def test_batches_page_shows_every_key_and_its_code_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs" / "batches.md").read_text(encoding="utf-8")
    (example,) = blocks(page, "toml")
    data = tomllib.loads(example)
    experiment = load_experiment(data)
    assert set(data) == set(Experiment.model_fields)
    assert set(data["limits"]) == set(RunLimits.model_fields)
    assert len(spell_out(experiment).plan) == 2 * 3 * 2 * 50
    # The same experiment, on fewer and shorter runs.
    monkeypatch.chdir(tmp_path)
    short = example.replace('"0:50"', '"0:2"').replace("30.0", "3.0")
    short = short.replace("[0.03, 0.09, 0.27]", "[0.03, 0.09]")
    (tmp_path / "beta.toml").write_text(short)
    commands = [line for block in blocks(page, "sh") for line in block.splitlines()]
    assert len(commands) == 6
    for command in commands:
        monkeypatch.setattr(sys, "argv", shlex.split(command, comments=True))
        cli.main()
    said = capsys.readouterr().out
    assert "12 of 12 runs are left" in said
    assert (tmp_path / "beta.csv").read_text().startswith("run,status,reason")
    assert (tmp_path / "beta" / "success.png").stat().st_size > 10_000
    (code,) = blocks(page, "python")
    exec(compile(code, "batches.md", "exec"), {"__name__": "batches"})
    assert "p_adjusted" in capsys.readouterr().out


@pytest.mark.slow
def test_the_learning_pages_commands_and_code_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs" / "learning.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    (experiment,) = blocks(page, "toml")
    assert len(spell_out(load_experiment(tomllib.loads(experiment))).plan) == 4 * 4
    # The same runs, fewer and shorter ones, and all that can be told of as few.
    short = experiment.replace(', "exit", "ambulance"', "").replace("1000:1004", "1000:1002")
    (tmp_path / "demos.toml").write_text(short + "[set]\nduration = 4.0\n")
    few = {
        "learn": ["--bootstrap", "2"],
        "tune": ["--seeds", "1000:1001", "--set", "duration=16.0"],
        "compare": ["--seeds", "7:8", "--set", "duration=2.0"],
    }
    (commands,) = [block.splitlines() for block in blocks(page, "sh")]
    assert len(commands) == 4
    for command in commands:
        words = shlex.split(command, comments=True)
        monkeypatch.setattr(sys, "argv", words + few.get(words[1], []))
        cli.main()
    theta = tomllib.loads((tmp_path / "theta.toml").read_text())
    assert theta["planner"]["reward"]["lane"] == 1.0
    assert theta["learned"]["runs"] == 4
    assert theta["cohesion"]["beta"] > 0.0
    assert (tmp_path / "learned" / "weights.png").stat().st_size > 10_000
    capsys.readouterr()
    (code,) = blocks(page, "python")
    names: dict[str, object] = {"__name__": "learning"}
    exec(compile(code, "learning.md", "exec"), names)
    assert "kept_default" in capsys.readouterr().out
    weights = names["rollout"].info["settings"]["reward"]  # type: ignore[attr-defined]
    assert weights == names["learned"].reward.model_dump()  # type: ignore[attr-defined]


def test_the_learning_page_names_every_option() -> None:
    page = (ROOT / "docs" / "learning.md").read_text(encoding="utf-8")
    (options,) = re.findall(r"## Options\n(.*?)\n#", page, flags=re.DOTALL)
    told = set(re.findall(r"^\| (.*?) \|", options, flags=re.MULTILINE))
    named = {name for cell in told for name in re.findall(r"`(--[\w-]+)`", cell)}
    assert named == {o for p in learning.learn.params for o in p.opts if o.startswith("--")}


def test_the_examples_are_valid() -> None:
    for path in (ROOT / "docs" / "examples").glob("*.toml"):
        assert len(spell_out(load_experiment(path)).plan) > 100


def test_the_evidence_holds_the_tables_that_were_measured() -> None:
    for page, tables in markdown.pages().items():
        text = page.read_text(encoding="utf-8")
        assert markdown.with_tables(page, tables) == text, "run: python -m analysis.markdown"
