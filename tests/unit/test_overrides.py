"""Settings by dotted name: whose each is, and those whose value stands in a file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from sumo_cohesion.errors import UserError
from sumo_cohesion.planning.reward import RewardWeights
from sumo_cohesion.simulation.overrides import read_files, settings_from

THETA = """# Learned by somebody
[planner.reward]
lane = 1.0
speed = 0.012
curvature = 1.1e6
[learned]
n = 50
standard_error = { lane = nan }
[cohesion]
beta = 0.36
"""


@pytest.fixture(autouse=True)
def theta(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "theta.toml"
    path.write_text(THETA)
    return path


def test_a_file_has_the_value_under_the_settings_own_name() -> None:
    given = {"planner.reward": "@theta.toml", "cohesion.beta": "@theta.toml"}
    planner, cohesion, rest = settings_from(given)
    # What the file does not name keeps its default.
    assert planner.reward == RewardWeights(lane=1.0, speed=0.012, curvature=1.1e6)
    assert cohesion.beta == 0.36
    assert rest == {}
    assert given["planner.reward"] == "@theta.toml"
    assert settings_from({"planner.reward.speed": "@theta.toml"})[0].reward.speed == 0.012
    assert settings_from({"planner.reward": {"speed": "@theta.toml"}})[0].reward.speed == 0.012


@pytest.mark.parametrize("group", ["@theta.toml", {"lane": 2.0, "speed": 0.012}])
def test_one_of_a_group_counts_more_than_the_group_in_any_order(group: object) -> None:
    both = {"planner.reward": group, "planner.reward.lane": 7.0}
    for given in (both, dict(reversed(both.items()))):
        reward = settings_from(given)[0].reward
        assert (reward.lane, reward.speed) == (7.0, 0.012)


def test_relative_names_are_those_of_a_folder(tmp_path: Path, theta: Path) -> None:
    (tmp_path / "below").mkdir()
    theta.rename(tmp_path / "below" / "a, b.toml")
    assert read_files({"cohesion.beta": "@below/a, b.toml"}) == {"cohesion.beta": 0.36}
    (read,) = read_files({"cohesion.beta": "@a, b.toml"}, tmp_path / "below").values()
    assert read == 0.36
    absolute = f"@{tmp_path / 'below' / 'a, b.toml'}"
    assert read_files({"cohesion.beta": absolute}, Path("/nowhere")) == {"cohesion.beta": 0.36}


def test_texts_of_the_scenario_may_begin_alike() -> None:
    given = {"ego.origin": "@theta.toml", "human_type": {"id": "@x"}}
    assert read_files(given) == given
    assert settings_from(given)[2] == given


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[planner.reward]\nlane = -1", r"^theta\.toml: planner\.reward\.lane: .*\(got -1\)$"),
        ("[planner.reward]\nlane = nan", r"theta\.toml: planner\.reward\.lane: .*finite"),
        ("[planner.reward]\nlane = inf", r"theta\.toml: planner\.reward\.lane: .*finite"),
        ("[planner.reward]\nlane = 'x'", r"theta\.toml: planner\.reward\.lane: .*number"),
        ("[planner.reward]\nlane = [1]", r"theta\.toml: planner\.reward\.lane: .*number"),
        ("[planner.reward]\nspede = 1", r"theta\.toml: unknown key 'planner\.reward\.spede'; did"),
        ("[planner]\nreward = 1", r"theta\.toml: planner\.reward: should be a table"),
        ("[planner]\nreward = '@theta.toml'", r"theta\.toml: planner\.reward: should be a table"),
        ("[planner.rewards]\nlane = 1", r"has no planner\.reward; it has planner\.rewards$"),
        ("[learned]\nn = 1\n[a.b]\nc = 1", r"has no planner\.reward; it has learned, a\.b$"),
        ("planner = 3", r"has no planner\.reward; it has planner$"),
        ("", r"has no planner\.reward; it has nothing$"),
        ("[planner.reward\n", r"^theta\.toml: not valid TOML"),
        ("\0", r"^theta\.toml: not valid TOML"),
    ],
)
def test_a_bad_file_is_named(theta: Path, text: str, said: str) -> None:
    theta.write_text(text)
    with pytest.raises(UserError, match=said) as error:
        settings_from({"planner.reward": "@theta.toml"})
    assert "\n" not in str(error.value)


def test_a_value_that_is_there_may_be_wrong_itself(theta: Path) -> None:
    theta.write_text("[cohesion]\nbeta = -1")
    with pytest.raises(UserError, match=r"theta\.toml: cohesion\.beta: .*greater than"):
        settings_from({"cohesion.beta": "@theta.toml"})
    theta.write_text("[cohesion]\nbta = 1")
    with pytest.raises(UserError, match=r"theta\.toml: unknown key 'cohesion\.bta'; did you mean"):
        settings_from({"cohesion.bta": "@theta.toml"})


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere.toml", r"^nowhere\.toml: cannot be read \(No such file"),
        (".", r"^\.: cannot be read \(Is a directory"),
        ("a\0b", "not a file's name"),
        ("", r"^planner\.reward=@: name a TOML file"),
    ],
)
def test_what_is_no_file_is_told(name: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        settings_from({"planner.reward": f"@{name}"})
