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
from sumo_cohesion.experiments.columns import describe_tables
from sumo_cohesion.experiments.scenario import Scenario
from tests.conftest import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def test_readme_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first, planner = blocks(README, "python")
    exec(compile(first, "README.md", "exec"), {"__name__": "readme"})
    (tmp_path / "straight.py").write_text(planner)


def test_readme_commands_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "straight.py").write_text(blocks(README, "python")[1])
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


def test_readme_links_exist() -> None:
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        for target in re.findall(r"\]\((?!http)([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), target


def test_tables_page_matches_the_code() -> None:
    page = (ROOT / "docs" / "tables.md").read_text(encoding="utf-8")
    assert page == describe_tables(), "run: make docs"


def test_scenario_page_shows_every_key_and_a_valid_file() -> None:
    (example,) = blocks((ROOT / "docs" / "scenarios.md").read_text(encoding="utf-8"), "toml")
    data = tomllib.loads(example)
    Scenario.model_validate(data)
    fields = Scenario.model_fields
    assert set(data) == set(fields)
    for name in ("ego", "sensing", "randomize"):
        kind = fields[name].annotation
        assert kind is not None
        assert set(data[name]) == set(kind.model_fields)
    bundled = tomllib.loads((ROOT / "scenarios" / "stalled.toml").read_text())
    shared = {k: v for k, v in data.items() if k in bundled and not isinstance(v, dict)}
    assert shared == {k: bundled[k] for k in shared}


def test_the_evidence_holds_the_tables_that_were_measured() -> None:
    text = markdown.EVIDENCE.read_text(encoding="utf-8")
    assert markdown.with_tables(text) == text, "run: python -m analysis.markdown"
