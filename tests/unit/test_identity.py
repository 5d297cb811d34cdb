"""Which run is which: whatever decides a result gives it another key, and nothing else does."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sumo_cohesion
from sumo_cohesion.batches import identity
from sumo_cohesion.batches.identity import code_digest, planner_digest, point_digest, run_key
from sumo_cohesion.simulation.request import RunRequest
from sumo_cohesion.simulation.setup import resolve
from tests.conftest import ROOT

FILES = ("networks/highway.net.xml", "routes/stalled.rou.xml", "more.add.xml", "most.add.xml")


@pytest.fixture
def digest(tmp_path: Path) -> Callable[..., str]:
    """Digest of a scenario with files of its own: by planner, and by overrides."""
    text = (ROOT / "scenarios" / "stalled.toml").read_text()
    additional = 'additional = ["more.add.xml", "most.add.xml"]\n'
    (tmp_path / "mine.toml").write_text(additional + text)
    for name in FILES[:2]:
        shutil.copy(ROOT / name, tmp_path)
    for name in FILES[2:]:
        (tmp_path / name).write_text(f"<additional/><!-- {name} -->")

    def of(planner: str = "nominal", **overrides: Any) -> str:
        dotted = {name.replace("__", "."): value for name, value in overrides.items()}
        return point_digest(resolve(RunRequest(tmp_path / "mine.toml", planner, 0, dotted)))

    return of


@pytest.mark.parametrize("name", FILES)
def test_the_content_of_every_file_counts(
    digest: Callable[..., str], tmp_path: Path, name: str
) -> None:
    before = digest()
    assert digest() == before
    path = tmp_path / Path(name).name
    old = path.read_bytes()
    path.write_bytes(old + b" ")
    assert digest() != before
    path.write_bytes(old)
    assert digest() == before


def test_the_order_of_additional_files_counts(digest: Callable[..., str], tmp_path: Path) -> None:
    before = digest()
    first, second = (tmp_path / name for name in FILES[2:])
    texts = first.read_text(), second.read_text()
    first.write_text(texts[1])
    second.write_text(texts[0])
    assert digest() != before


def test_settings_count_where_they_are_used(digest: Callable[..., str]) -> None:
    other = {"cohesion__beta": 0.5}
    assert digest(**other) == digest()  # nominal has no cohesion
    assert digest("sumo", **other) == digest("sumo")
    assert digest("cohesive", **other) != digest("cohesive")
    assert digest("paper", **other) != digest("paper")
    assert len({digest(name) for name in ("nominal", "cohesive", "paper", "sumo")}) == 4
    for changed in ({"planner__horizon": 5}, {"duration": 7.0}, {"ego__speed": 20.0}):
        assert digest(**changed) != digest(), changed
    assert digest(summary="said otherwise") == digest()
    assert digest(planner__horizon=10) == digest()  # the default, spelt out


def test_what_a_settings_file_says_counts_and_nothing_else_of_it(
    digest: Callable[..., str], tmp_path: Path
) -> None:
    theta, copy = tmp_path / "theta.toml", tmp_path / "copy.toml"
    theta.write_text("[planner.reward]\nspeed = 0.01\n")
    copy.write_text("# the same\n[learned]\nn = 5\n[planner.reward]\nspeed = 0.010\n")
    before = digest(planner__reward=f"@{theta}")
    assert digest(planner__reward=f"@{copy}") == before
    assert digest(planner__reward={"speed": 0.01}) == digest(planner__reward__speed=0.01) == before
    assert digest() != before
    theta.write_text("[planner.reward]\nspeed = 0.02\n")
    assert digest(planner__reward=f"@{theta}") != before


def test_a_key_is_of_a_point_and_a_seed() -> None:
    keys = {run_key(point, seed) for point in ("a", "b") for seed in range(50)}
    assert len(keys) == 100
    assert all(len(key) == 16 and int(key, 16) >= 0 for key in keys)
    assert run_key("a", 11) != run_key("a1", 1)
    assert run_key("a", 3) == run_key("a", 3)


@pytest.fixture(scope="module")
def loaded_by_a_run() -> list[str]:
    """Files of the package that a run loads, whatever its solver: its code."""
    code = (
        "import sys, pkgutil, importlib, sumo_cohesion.simulation.run\n"
        "import sumo_cohesion.planning as planning\n"
        "for m in pkgutil.walk_packages(planning.__path__, planning.__name__ + '.'):\n"
        "    importlib.import_module(m.name)\n"
        "print(*(m.__file__ for n, m in sys.modules.items() if n.startswith('sumo_cohesion')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    package = ROOT / "sumo_cohesion"
    return [str(Path(path).relative_to(package)) for path in done.stdout.split()]


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a copy of the package, whose code is digested instead."""
    package = tmp_path / "sumo_cohesion"
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "sumo_cohesion", package, ignore=ignore)
    monkeypatch.setattr(sumo_cohesion, "__file__", str(package / "__init__.py"))
    return package


def digest_of_code() -> str:
    return code_digest.__wrapped__()


CANNOT_CHANGE_A_ROW = ("planning/landscape.py", "tables/rollout.py", "tables/folders.py")
"""Loaded, but pictures are drawn by the first, and the others say how a record is kept."""


@pytest.mark.slow
def test_every_file_that_a_run_loads_counts(copied: Path, loaded_by_a_run: list[str]) -> None:
    assert len(loaded_by_a_run) > 50
    before = digest_of_code()
    rooms = set()
    for name in loaded_by_a_run:
        path = copied / name
        old = path.read_bytes()
        path.write_bytes(old + b"\nchanged = 1\n")
        counts = name not in CANNOT_CHANGE_A_ROW and "import" in old.decode()
        if path.name != "__init__.py":  # which hold a line of documentation
            assert (digest_of_code() != before) == counts, name
        path.write_bytes(old)
        rooms.add(path.parent.name)
    assert rooms >= {"social", "perception", "traffic", "planning", "solvers", "simulation"}
    assert digest_of_code() == before


@pytest.mark.slow
def test_what_code_does_counts_and_what_is_said_of_it_does_not(copied: Path) -> None:
    before = digest_of_code()
    path = copied / "social" / "election.py"
    old = path.read_text()
    said = old.replace("Who steers", "Who is to steer").replace("\n\n\n", "\n\n\n# Aside.\n\n")
    assert len(said) > len(old) + 20
    path.write_text(said)
    assert digest_of_code() == before
    for change in ((" 1.0", " 1.5"), ("max(", "min("), (" > ", " >= ")):
        assert change[0] in old, change
        path.write_text(old.replace(*change, 1))
        assert digest_of_code() != before, change


@pytest.mark.slow
def test_what_only_looks_at_results_does_not_count(copied: Path) -> None:
    before = digest_of_code()
    for name in ("cli/running.py", "__main__.py", "report/paper.py", "batches/store.py"):
        (copied / name).write_text("# rewritten\n")
        assert digest_of_code() == before, name


@pytest.mark.slow
def test_a_files_name_counts(copied: Path) -> None:
    before = digest_of_code()
    (copied / "road.py").rename(copied / "roads.py")
    assert digest_of_code() != before


@pytest.mark.slow
def test_versions_count(monkeypatch: pytest.MonkeyPatch) -> None:
    before = digest_of_code()
    monkeypatch.setattr(identity, "versions", lambda: {"libsumo": "0.0"})
    assert digest_of_code() != before


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder for planners, on the way along which modules are looked for."""
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def changes(path: Path, planner: str) -> bool:
    """Tell whether a planner is another one once a file is."""
    before = planner_digest(planner)
    assert planner_digest(planner) == before
    path.write_text(path.read_text() + "\nmore = 1\n")
    return planner_digest(planner) != before


def test_a_module_counts_with_all_it_imports_from_its_own_folder(own: Path) -> None:
    sources = {
        "alone_planner.py": "import json, beside_one, beside_folder.y\nfrom beside_two import x",
        "beside_one.py": "import beside_three as three",
        "beside_two.py": "import alone_planner",  # a circle
        "beside_three.py": "x = 1",
        "stranger.py": "x = 1",
        "beside_folder/__init__.py": "",
        "beside_folder/y.py": "x = 1",
    }
    for name, text in sources.items():
        (own / name).parent.mkdir(exist_ok=True)
        (own / name).write_text(text)
    for name in sources:
        assert changes(own / name, "alone_planner:Mine") is (name != "stranger.py"), name


def test_a_planners_code_is_part_of_its_runs(own: Path, digest: Callable[..., str]) -> None:
    path = own / "lone_planner.py"
    path.write_text("x = 1")
    before = digest("lone_planner:Mine")
    path.write_text("x = 21")
    assert digest("lone_planner:Mine") != before
    assert digest("lone_planner:Mine(gain=2)") != digest("lone_planner:Mine")


def test_a_package_counts_as_a_whole(own: Path) -> None:
    for name in ("whole_package/__init__.py", "whole_package/deep/er.py", "stranger.py"):
        (own / name).parent.mkdir(parents=True, exist_ok=True)
        (own / name).write_text("x = 1")
    assert changes(own / "whole_package" / "__init__.py", "whole_package.deep.er:Mine")
    assert changes(own / "whole_package" / "deep" / "er.py", "whole_package:Mine")
    assert not changes(own / "stranger.py", "whole_package:Mine")


def test_the_files_that_arguments_name_count_however_deep(own: Path) -> None:
    (own / "fed_planner.py").write_text("x = 1")
    weights = own / "weights.txt"
    for given in (f"'{weights}'", f"['{weights}']", f"{{'a': ('b', '{weights}')}}"):
        weights.write_text("0.5")
        assert changes(weights, f"fed_planner:Mine(given={given})"), given
    assert not changes(weights, "fed_planner:Mine(given=['no\\0file', 1.5, 'nowhere.txt'])")
    assert not changes(weights, f"fed_planner:Mine(given='{own}')")  # a folder


def test_what_is_built_in_or_cannot_be_found_has_no_code_of_its_own() -> None:
    assert planner_digest("cohesive") == ""
    assert planner_digest("there_is_no_such_module:Mine") == ""
