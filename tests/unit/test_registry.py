"""Planners by name: what a name may do, and what is said of one that is none."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sumo_cohesion import UserError
from sumo_cohesion.batches.experiment import load_experiment, spell_out
from sumo_cohesion.batches.identity import planner_digest
from sumo_cohesion.planning.registry import check_planner, make_planner
from sumo_cohesion.planning.settings import PlannerSettings
from sumo_cohesion.social.settings import CohesionSettings

OWN = """
class Helper:
    def __init__(self):
        open("called", "w")

class Straight:
    def __init__(self, gain=1.0):
        self.gain = gain
    def reset(self, road): ...
    def plan(self, observation, history): ...

def straight():
    open("called", "w")
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Work in an empty folder, whose modules are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "straight", raising=False)  # README's, of another test
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.mark.parametrize(
    "name",
    [
        "subprocess:Popen(args='touch called', shell=True)",
        "subprocess:run(args='touch called', shell=True)",
        "os:system",
        "pathlib:Path",
        "straight:straight",
        "straight.py:straight",
        "straight:Helper",
    ],
)
def test_nothing_but_a_planners_class_is_called(name: str, here: Path) -> None:
    (here / "straight.py").write_text(OWN)
    experiment = load_experiment({"scenarios": ["stalled"], "planners": [name], "seeds": [0]})
    with pytest.raises(UserError, match=r"needs the methods reset\(road\) and plan"):
        spell_out(experiment)
    assert not (here / "called").exists()


@pytest.mark.parametrize("name", ["straight.py:Straight", "deep/straight.py:Straight(gain=2.5)"])
@pytest.mark.parametrize("absolute", [False, True])
def test_a_planner_by_its_file(name: str, absolute: bool, here: Path) -> None:
    (here / name.partition(":")[0]).parent.mkdir(exist_ok=True)
    (here / name.partition(":")[0]).write_text(OWN)
    name = str(here / name) if absolute else name
    planner = make_planner(name, PlannerSettings(), CohesionSettings())
    assert planner.gain == (2.5 if "gain" in name else 1.0)  # type: ignore[attr-defined]
    before = planner_digest(name)
    with (here / name.partition(":")[0]).open("a") as file:
        file.write("# changed\n")
    assert planner_digest(name) != before


def test_a_file_with_the_name_of_another_module_is_told(here: Path) -> None:
    (here / "json.py").write_text(OWN)
    with pytest.raises(UserError, match=r"another module is called 'json'; rename json\.py"):
        check_planner("json.py:Straight")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("cohesiv", "did you mean 'cohesive'"),
        ("Nominal", "did you mean 'nominal'"),
        ("straight", "did you mean straight:Straight?"),
        ("straight.py", "did you mean straight.py:Straight?"),
        ("straight:Strait", "'straight' has no 'Strait'; did you mean 'Straight'?"),
        ("straight.py:S", "did you mean 'Straight'?"),
        ("broken", "choose nominal, cohesive"),
        ("nominal cohesive", "separated by commas"),
        ("nominal;straight:Straight", "separated by commas"),
        ("nominal,cohesive", "separated by commas"),
        ("gone.py:Straight", "there is no file"),
        ("\0.py:Straight", "choose nominal"),
        ("fast", "choose nominal, cohesive, paper, sumo"),
    ],
)
def test_names_that_are_none_are_helped(name: str, said: str, here: Path) -> None:
    (here / "straight.py").write_text(OWN)
    (here / "broken.py").write_text("class :")
    with pytest.raises(UserError) as raised:
        check_planner(name)
    assert said in str(raised.value)


def test_what_a_module_raises_is_kept_as_the_cause(here: Path) -> None:
    (here / "faulty.py").write_text("1 / 0")
    with pytest.raises(UserError, match="ZeroDivisionError") as raised:
        check_planner("faulty:Straight")
    assert isinstance(raised.value.__cause__, ZeroDivisionError)
