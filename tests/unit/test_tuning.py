"""Finding beta: the search on functions that are known, and the file that beta is written into."""

from __future__ import annotations

import stat
import tomllib
from collections.abc import Callable
from math import exp, log
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sumo_cohesion.batches.tuning import LEAST, MOST, TOLERANCE, NotReachedError, find_beta, tune
from sumo_cohesion.batches.weights_file import WeightsFile
from sumo_cohesion.errors import UserError
from sumo_cohesion.tables.intervals import median_interval


def share(half: float, steep: float = 1.0) -> Callable[[float], float]:
    """Share that is closed: half of it at ``half``, growing from 0 to 1 with beta."""
    return lambda beta: 1.0 / (1.0 + exp(-steep * (log(beta) - log(half))))


class Counted:
    """A measure that remembers what it was asked."""

    def __init__(self, measure: Callable[[float], float]) -> None:
        self.measure, self.asked = measure, list[float]()

    def __call__(self, beta: float) -> float:
        self.asked.append(beta)
        return self.measure(beta)


@given(half=st.floats(1e-3, 1e3), steep=st.floats(0.5, 5.0), target=st.floats(0.3, 0.7))
def test_the_target_is_met_in_few_measurements(half: float, steep: float, target: float) -> None:
    measure = Counted(share(half, steep))
    beta = find_beta(measure, target, 0.09)
    assert measure.asked.count(beta) == 1
    # Within the tolerance, or as near as betas that are 5 % apart come.
    apart = abs(log(beta) - log(half) - log(target / (1 - target)) / steep)
    assert abs(measure.measure(beta) - target) <= TOLERANCE or apart <= log(1.05) + 0.006
    assert len(set(measure.asked)) == len(measure.asked) <= 16
    assert all(LEAST <= asked <= MOST for asked in measure.asked)
    assert all(asked == float(f"{asked:.3g}") for asked in measure.asked)


def test_where_it_starts_may_be_near_enough() -> None:
    measure = Counted(share(0.06))
    assert find_beta(measure, 0.6, 0.09) == 0.09
    assert measure.asked == [0.09]


@pytest.mark.parametrize("edge", [0.3, 0.002])
def test_a_jump_over_the_target_is_met_at_its_nearer_side(edge: float) -> None:
    measure = Counted(lambda beta: 0.65 if beta > edge else 0.1)
    beta = find_beta(measure, 0.6, 0.09)
    assert edge < beta
    assert min(asked for asked in measure.asked if asked > edge) == pytest.approx(edge, rel=0.06)
    assert max(asked for asked in measure.asked if asked <= edge) == pytest.approx(edge, rel=0.06)


@pytest.mark.parametrize(
    ("constant", "said"),
    [(0.41, r"does not come to 0\.6 .* nearest is 0\.410"), (0.9, r"nearest is 0\.900")],
)
def test_what_cannot_be_reached_is_told(constant: float, said: str) -> None:
    measure = Counted(lambda _: constant)
    with pytest.raises(NotReachedError, match=said):
        find_beta(measure, 0.6, 0.09)
    assert measure.asked[-1] == (MOST if constant < 0.6 else LEAST)


def test_the_interval_of_a_median_by_hand() -> None:
    assert median_interval([3.0]) == (3.0, 3.0, 3.0)
    median, low, high = median_interval([1.0, 2.0, 3.0, 4.0, 100.0])
    assert (median, low, high) == (3.0, 1.0, 100.0)
    assert median_interval([1.0, 2.0, 9.0]) == median_interval([1.0, 2.0, 9.0])


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"metric": "speed_gap_closd"}, "no metric 'speed_gap_closd'; did you mean 'speed_gap_clo"),
        ({"metric": "outcome"}, "'outcome' is no number"),
        ({"metric": "success"}, "'success' is no number"),
        ({"target": float("nan")}, "target nan"),
        ({"planner": "nominal"}, "'nominal' has no beta; tune cohesive or paper"),
        ({"planner": "mine:Planner"}, "'mine:Planner' has no beta"),
        ({"overrides": {"cohesion.beta": 1.0}}, "cohesion.beta is what is looked for"),
        ({"overrides": {"planner.reward": {}}}, "planner.reward comes from .*theta.toml; leave"),
        ({"overrides": {"cohesion.bta": 1.0}}, "did you mean 'beta'"),
        ({"seeds": ""}, "0:20"),
        ({"seeds": []}, "at least one planner and one seed"),
        ({"scenario": "speding"}, "did you mean 'speeding'"),
    ],
)
def test_what_is_asked_wrongly_is_told_and_the_file_is_left(
    asked: dict[str, object], said: str, tmp_path: Path
) -> None:
    path = tmp_path / "theta.toml"
    path.write_text("[planner.reward]\nlane = 1.0\n")
    with pytest.raises(UserError, match=said):
        tune(path, **asked)  # type: ignore[arg-type]
    assert path.read_text() == "[planner.reward]\nlane = 1.0\n"


WEIGHTS = (
    "# Learned\n[planner.reward]\nlane = 1.0  # one\n\n[learned]\nse = nan\nday = 2026-01-01\n"
)
BETA = "beta = 0.36  # by tune: well"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (WEIGHTS, f"{WEIGHTS}\n[cohesion]\n{BETA}\n"),
        (WEIGHTS.rstrip(), f"{WEIGHTS.rstrip()}\n\n[cohesion]\n{BETA}\n"),
        ("", f"\n[cohesion]\n{BETA}\n"),
        (f"\ufeff{WEIGHTS}", f"\ufeff{WEIGHTS}\n[cohesion]\n{BETA}\n"),
        ("a = 1\r\n", f"a = 1\r\n\r\n[cohesion]\r\n{BETA}\r\n"),
        ("[cohesion]", f"[cohesion]\n{BETA}"),
        (
            "[ cohesion ]  # mine\r\nmemory = 9.0\r\n[x]\r\n",
            f"[ cohesion ]  # mine\r\n{BETA}\r\nmemory = 9.0\r\n[x]\r\n",
        ),
        (
            "[cohesion]\nmemory = 9.0\n beta  =  0.225  # by tune: speed 1\n# end\n",
            f"[cohesion]\nmemory = 9.0\n{BETA}\n# end\n",
        ),
        (f"[cohesion]\n{BETA} once\r\n[x]\n", f"[cohesion]\n{BETA}\r\n[x]\n"),
    ],
)
def test_beta_is_written_and_nothing_else_is_touched(
    tmp_path: Path, before: str, after: str
) -> None:
    path = tmp_path / "theta.toml"
    path.write_bytes(before.encode())
    path.chmod(0o640)
    WeightsFile.read(path).write_beta(0.36, "well")
    assert path.read_bytes().decode() == after
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert tomllib.loads(after.removeprefix("\ufeff"))["cohesion"]["beta"] == 0.36
    assert [p.name for p in tmp_path.iterdir()] == ["theta.toml"]
    WeightsFile.read(path).write_beta(0.5, "in a\n\udcff.toml")  # its own it replaces
    text = path.read_bytes().decode()
    assert text == after.replace(BETA, "beta = 0.5  # by tune: in a  .toml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[cohesion]\nbeta = 0.1\n", r"theta\.toml: has a cohesion\.beta that is not of tune"),
        ("[cohesion]\nbeta = 0.1  # tuned\n", "not of tune"),
        ("cohesion.beta = 0.1\n", "not of tune"),
        ("cohesion.memory = 9.0\n", r"as a table: \[cohesion\]"),
        ("cohesion = {memory = 9.0}\n", r"as a table: \[cohesion\]"),
        ("cohesion = 1\n", r"as a table: \[cohesion\]"),
        ('a = """\n[cohesion]\n"""\n', r"as a table: \[cohesion\]"),
        ("[other]\nbeta = 1  # by tune: x\n[cohesion]\nbeta = 0.1\n", r"as a table: \[cohesion\]"),
        ("[cohesion\n", "not valid TOML"),
    ],
)
def test_what_is_the_users_stays(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "theta.toml"
    path.write_text(text)
    with pytest.raises(UserError, match=said):
        WeightsFile.read(path)
    assert path.read_text() == text


def test_weights_that_change_while_they_are_tuned_get_no_beta(tmp_path: Path) -> None:
    path = tmp_path / "theta.toml"
    path.write_text("[planner.reward]\nlane = 1.0\n")
    file = WeightsFile.read(path)
    path.write_text("[planner.reward]\nlane = 2.0\n")
    with pytest.raises(UserError, match=r"has changed while it was tuned; before: beta = 0\.36"):
        file.write_beta(0.36, "well")
    assert path.read_text() == "[planner.reward]\nlane = 2.0\n"
    path.unlink()
    with pytest.raises(UserError, match=r"cannot be written \(No such.*found: beta = 0\.36"):
        file.write_beta(0.36, "well")


def test_a_link_to_the_file_stays_one(tmp_path: Path) -> None:
    real, link = tmp_path / "real.toml", tmp_path / "link.toml"
    real.write_text(WEIGHTS)
    link.symlink_to(real)
    WeightsFile.read(link).write_beta(0.36, "well")
    assert link.is_symlink()
    assert BETA in real.read_text()
