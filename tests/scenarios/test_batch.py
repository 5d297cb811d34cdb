"""Batches on real SUMO traffic: nothing lost, nothing doubled, whatever happens to them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from sumo_cohesion import Rollout, UserError, batch, load_metrics, load_trajectories, run
from sumo_cohesion.batches.batch import Progress, dry_run
from sumo_cohesion.batches.experiment import load_experiment, spell_out
from sumo_cohesion.batches.store import NOT_REPEATABLE
from sumo_cohesion.batches.workers import CallFailedError, Limits, Workers
from tests.waiting import Gate, end_of, hold, kill, started, wait_for

REPOSITORY = Path(__file__).resolve().parent.parent.parent
FAULTY = "tests.scenarios.faulty_planners:"
SHORT: dict[str, Any] = {
    "scenarios": ["stalled", "speeding"],
    "planners": ["nominal", "cohesive"],
    "seeds": "0:3",
    "set": {"duration": 1.0},
    "grid": {"cohesion.beta": [0.03, 0.09]},
}
"""Of 24 rows 18 are runs of their own: nominal has no beta."""


def toml(experiment: Mapping[str, Any], path: Path) -> Path:
    """Write an experiment's file."""
    tables = {k: v for k, v in experiment.items() if isinstance(v, dict)}
    lines = [f"{k} = {json.dumps(v)}" for k, v in experiment.items() if k not in tables]
    for name, table in tables.items():
        lines += [f"[{name}]", *(f'"{k}" = {json.dumps(v)}' for k, v in table.items())]
    path.write_text("\n".join(lines) + "\n")
    return path


def results(folder: Path) -> pd.DataFrame:
    """Return what must be the same whenever and wherever it was run."""
    return load_metrics(folder).drop(columns=list(NOT_REPEATABLE))


def results_of(experiment: Mapping[str, Any], folder: Path, workers: int) -> pd.DataFrame:
    batch(experiment, folder, workers=workers)
    return results(folder)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    folder = tmp_path_factory.mktemp("batch") / "whole"
    batch(SHORT, folder, workers=2)
    return results(folder)


def command(file: Path, out: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "sumo_cohesion", "batch", str(file), "--out", str(out), *options]


@pytest.mark.slow
def test_every_row_is_there_and_shared_runs_are_done_once(uninterrupted: pd.DataFrame) -> None:
    assert len(uninterrupted) == 24
    assert uninterrupted["run"].nunique() == 18
    assert (uninterrupted["status"] == "done").all()
    told = uninterrupted[["scenario", "planner", "cohesion.beta", "seed"]]
    assert not told.duplicated().any()
    by_beta = uninterrupted.query("planner == 'cohesive'").groupby("cohesion.beta")
    means = by_beta["mean_speed"].mean()
    assert means[0.09] != means[0.03]


STORE = "sumo_cohesion.batches.store:"


@pytest.mark.slow
def test_killed_at_any_moment_and_resumed_it_is_the_same(
    uninterrupted: pd.DataFrame, tmp_path: Path
) -> None:
    """Each time it dies as soon as that function of the store has returned so often."""
    file, out = toml(SHORT, tmp_path / "short.toml"), tmp_path / "out"
    moments = [
        ("_write_parquet", 1, 0),  # the plan is there, the manifest is not
        ("Store.add", 1, 1),
        ("os.fsync", 1, 1),  # the rows of the last time are a part that has no name yet
        ("_write_parquet", 1, 1),  # a part and its journal are both there
        ("Store.add", 7, 8),
        ("joined", 1, 18),  # all is done, and not joined yet
    ]
    for function, number, runs in moments:
        last = [sys.executable, "-m", "tests.dying", STORE + function, str(number)]
        with started(last + command(file, out, "--workers", "2")[3:], cwd=REPOSITORY) as process:
            status, said = end_of(process)
        assert status == -signal.SIGKILL, f"{function}: {said}"
        if runs:
            assert load_metrics(out)["run"].nunique() == runs, function
    counted: list[int] = []
    batch(SHORT, out, workers=2, progress=counting(counted))
    assert counted == []
    pd.testing.assert_frame_equal(results(out), uninterrupted)


HELD: dict[str, Any] = {"scenarios": ["stalled"], "seeds": "0:6", "set": {"duration": 2.0}}


@pytest.fixture(scope="module")
def unheld(tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    """Return what held runs must come to: waiting changes nothing."""
    folder = tmp_path_factory.mktemp("batch") / "unheld"
    whole = results_of(HELD | {"planners": [FAULTY + "Good"]}, folder, workers=2)
    return whole.drop(columns=["run", "planner"])


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_stopped_amid_runs_it_keeps_what_is_done_and_goes_on_later(
    unheld: pd.DataFrame, tmp_path: Path, number: signal.Signals
) -> None:
    gate = Gate(tmp_path / "gate")
    held = HELD | {"planners": [f"{FAULTY}Held(gate='{gate.folder}')"]}
    file, out = toml(held, tmp_path / "held.toml"), tmp_path / "out"
    gate.let_pass(3)
    with started(
        command(file, out, "--workers", "2"),
        cwd=REPOSITORY,
        stdout=subprocess.DEVNULL,
        # Tests that run in the background of a shell inherit that Ctrl-C is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        journal = out / "runs" / "1of1-00001.jsonl"
        wait_for(lambda: journal.exists() and journal.read_text().count("\n") == 3, process)
        wait_for(lambda: len(gate.waiting()) == 2, process)
        if number == signal.SIGKILL:
            kill(process)
        else:
            process.send_signal(number)
            status, said = end_of(process)
            assert (status, said) == (
                1,
                "error: interrupted with 3 of 6 runs left; run it again to go on\n",
            )
    assert len(load_metrics(out)) == 3
    gate.open()
    counted: list[Progress] = []
    batch(held, out, workers=2, progress=counted.append)
    assert counted[-1][:3] == (3, 3, 0)
    pd.testing.assert_frame_equal(results(out).drop(columns=["run", "planner"]), unheld)


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_what_was_done_stays(
    uninterrupted: pd.DataFrame, tmp_path: Path
) -> None:
    # No file may grow beyond 6 kB: the journal, after a few rows, as on a disk that fills up.
    file, out = toml(SHORT, tmp_path / "short.toml"), tmp_path / "out"
    code = (
        "import resource, sys; from sumo_cohesion.cli import main;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000)); sys.argv[0] = 'x'; main()"
    )
    arguments = command(file, out, "--workers", "1")[3:]
    done = subprocess.run(
        [sys.executable, "-B", "-c", code, *arguments],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "cannot be written (File too large)" in done.stderr
    assert "Traceback" not in done.stderr
    assert 1 <= len(load_metrics(out)) < 24
    batch(SHORT, out, workers=2)
    pd.testing.assert_frame_equal(results(out), uninterrupted)


@pytest.mark.slow
def test_bad_planners_are_rows_with_reasons_among_good_runs(tmp_path: Path) -> None:
    names = ["Good", "SegmentationFault", "EatsMemory", "Raises", "RaisesAtOnce"]
    experiment = {
        "scenarios": ["stalled"],
        "planners": [FAULTY + name for name in names],
        "seeds": [0, 1],
        "set": {"duration": 2.0},
        "limits": {"memory": 1.0, "retries": 1},
    }
    rows = batch(experiment, tmp_path / "out", workers=2)
    assert len(rows) == 10
    rows["planner"] = rows["planner"].str.removeprefix(FAULTY)
    own = {str(name): part for name, part in rows.groupby("planner")}
    assert (own["Good"]["status"] == "done").all()
    assert (own["Good"]["outcome"] == "finished").all()
    wanted = {
        "SegmentationFault": ("crash", "SIGSEGV", 2),
        "EatsMemory": ("memory", "needed more than 1 GB", 2),
        "RaisesAtOnce": ("error", "no such road", 1),  # it would raise again: not retried
        "Raises": ("done", "no plan in 10 of 20 steps, first: ValueError: no idea where to go", 1),
    }
    for name, (status, reason, attempts) in wanted.items():
        assert (own[name]["status"] == status).all(), name
        assert own[name]["reason"].str.contains(reason, regex=False).all(), name
        assert (own[name]["attempts"] == attempts).all(), name
    assert own["SegmentationFault"]["success"].isna().all()
    # Resumed, failed runs are left alone unless asked for.
    counted: list[Progress] = []
    batch(experiment, tmp_path / "out", workers=2, progress=counted.append)
    assert counted == []
    only = experiment | {"planners": [FAULTY + "RaisesAtOnce"]}
    batch(only, tmp_path / "out", workers=2, retry_failed=True, progress=counted.append)
    assert counted[-1][:3] == (2, 2, 2)
    assert "no such road" in counted[-1].reason


@pytest.mark.slow
def test_a_planner_that_never_ends_is_a_row_with_a_reason(tmp_path: Path) -> None:
    """No run of this batch could end: whatever the limit and the machine, it is met."""
    endless = {
        "scenarios": ["stalled"],
        "planners": [FAULTY + "Endless"],
        "seeds": [0, 1],
        "limits": {"run_time": 0.25, "retries": 1},
    }
    rows = batch(endless, tmp_path / "out", workers=2)
    assert rows["status"].tolist() == ["timeout"] * 2
    assert rows["reason"].tolist() == ["no result after 0.25 s"] * 2
    assert rows["attempts"].tolist() == [2, 2]  # in a process of its own: the first was killed
    assert rows["success"].isna().all()


@pytest.mark.slow
def test_a_dask_cluster_that_loses_a_worker_gives_the_same_rows(
    uninterrupted: pd.DataFrame, tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    if not Path("/proc/self/task").exists():
        pytest.skip("finding the workers needs Linux")
    killed: list[int] = []

    def kill_one(progress: Progress) -> None:
        if progress.done < 7 or killed:
            return
        for entry in Path("/proc/self/task").glob("*/children"):
            for pid in entry.read_text().split():
                if not killed and "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text():
                    os.kill(int(pid), signal.SIGKILL)
                    killed.append(int(pid))

    batch(SHORT, tmp_path / "out", workers=2, dask="local", progress=kill_one)
    assert killed
    pd.testing.assert_frame_equal(results(tmp_path / "out"), uninterrupted)


@pytest.mark.slow
def test_shards_share_a_folder_and_make_the_whole(
    uninterrupted: pd.DataFrame, tmp_path: Path
) -> None:
    file, out = toml(SHORT, tmp_path / "short.toml"), tmp_path / "out"
    first, second = (command(file, out, "--workers", "1", "--shard", f"{i}/2") for i in (1, 2))
    quiet: dict[str, Any] = {"cwd": REPOSITORY, "stdout": subprocess.DEVNULL}
    with started(first, **quiet) as one, started(second, **quiet) as other:
        assert [end_of(shard)[0] for shard in (one, other)] == [0, 0]
    pd.testing.assert_frame_equal(results(out), uninterrupted)
    whole = pd.read_parquet(out / "metrics.parquet").drop(columns=list(NOT_REPEATABLE))
    assert len(whole) == 24


def own_scenario(folder: Path) -> Path:
    """Copy a bundled scenario with its files."""
    text = (REPOSITORY / "scenarios" / "stalled.toml").read_text()
    (folder / "mine.toml").write_text(text.replace('name = "stalled"', 'name = "mine"'))
    for kind, name in (("networks", "highway.net.xml"), ("routes", "stalled.rou.xml")):
        shutil.copy(REPOSITORY / kind / name, folder / name)
    return folder / "mine.toml"


def counting(total: list[int]) -> Callable[[Progress], None]:
    return lambda progress: total.append(progress.total)


@pytest.mark.slow
def test_a_changed_network_is_never_mixed_with_old_results(tmp_path: Path) -> None:
    own_scenario(tmp_path)
    experiment = {
        "scenarios": ["mine.toml"],
        "planners": ["sumo"],
        "seeds": "0:3",
        "set": {"duration": 2.0},
    }
    file, out = toml(experiment, tmp_path / "mine_too.toml"), tmp_path / "out"
    first = batch(file, out, workers=1)
    network = tmp_path / "highway.net.xml"
    before = network.read_text()
    network.write_text(before.replace('speed="25.00"', 'speed="35.00"'))
    assert network.read_text() != before
    second = batch(file, out, workers=1)
    assert len(second) == 3
    assert not set(second["run"]) & set(first["run"])
    assert (second["mean_speed"] > first["mean_speed"] + 0.5).all()
    # Back to what it was: nothing is run again, and only the old rows are there.
    network.write_text(before)
    total: list[int] = []
    pd.testing.assert_frame_equal(batch(file, out, progress=counting(total)), first)
    assert total == []


@pytest.mark.slow
def test_a_network_that_changes_while_it_runs_stops_no_run_from_being_true(tmp_path: Path) -> None:
    own_scenario(tmp_path)
    experiment = {
        "scenarios": [str(tmp_path / "mine.toml")],
        "planners": ["sumo"],
        "seeds": "0:4",
        "set": {"duration": 1.0},
    }
    network = tmp_path / "highway.net.xml"

    def change(progress: Progress) -> None:
        if progress.done == 1:
            network.write_text(network.read_text().replace('speed="25.00"', 'speed="35.00"'))

    rows = batch(experiment, tmp_path / "out", workers=1, progress=change)
    late = rows[rows["status"] == "changed"]
    assert len(late) == 3
    assert late["reason"].str.contains("not those the batch was started with").all()
    # Changed back, they are done: they are no failures of their own.
    network.write_text(network.read_text().replace('speed="35.00"', 'speed="25.00"'))
    assert (batch(experiment, tmp_path / "out", workers=1)["status"] == "done").all()


def weights(path: Path, speed: float) -> Path:
    """Write a file of reward weights, as learn does."""
    path.write_text(f"[planner.reward]\nspeed = {speed}\n[learned]\nn = 50\n")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("dask", [None, "local"])
def test_a_grid_over_files_is_read_once_beside_the_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dask: str | None
) -> None:
    if dask is not None:
        pytest.importorskip("distributed")
    files = [weights(tmp_path / f"{name}.toml", speed) for name, speed in (("a", 0.01), ("b", 10))]
    experiment = {
        "scenarios": ["speeding"],
        "planners": ["nominal"],
        "seeds": "0:2",
        "set": {"duration": 3.0, "ego.speed": 20.0},
        "grid": {"planner.reward": ["@a.toml", "@b.toml"]},
    }
    file, out = toml(experiment, tmp_path / "mine.toml"), tmp_path / "out"
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")

    def gone(_: Progress) -> None:
        for path in files:  # what they said is known: no run reads them again
            path.unlink(missing_ok=True)

    rows = batch(file, out, workers=1, dask=dask, progress=gone)
    assert rows["planner.reward"].tolist() == ["@a.toml"] * 2 + ["@b.toml"] * 2
    assert (rows["status"] == "done").all()
    settings = {"duration": 3.0, "ego.speed": 20.0}
    for row, speed in ((0, 0.01), (2, 10.0)):
        used = settings | {"planner.reward": {"speed": speed}}
        (alone,) = run("speeding", "nominal", 0, overrides=used).metrics["mean_speed"]
        assert rows["mean_speed"][row] == alone
    assert rows["mean_speed"].nunique() == 4
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["files"]["planner.reward"]["@b.toml"] == {"speed": 10}
    with pytest.raises(UserError, match=r"mine\.toml: .*a\.toml: cannot be read"):
        batch(file, out, workers=1)
    # The same content: nothing is run again. Another: only that file's runs are.
    for path, speed in zip(files, (0.01, 10.0), strict=True):
        weights(path, speed)
    total: list[int] = []
    batch(file, out, workers=1, progress=counting(total))
    assert total == []
    weights(files[0], 0.02)
    again = batch(file, out, workers=1, progress=counting(total))
    assert total == [2, 2]
    assert set(again["run"][2:]) == set(rows["run"][2:])
    assert not set(again["run"][:2]) & set(rows["run"])


@pytest.mark.slow
def test_a_planners_own_code_decides_which_run_it_is(tmp_path: Path) -> None:
    """A package, and a module with a helper beside it: a change in either makes new runs."""
    (tmp_path / "own_package").mkdir()
    (tmp_path / "own_package" / "__init__.py").write_text("from .impl import Mine\n")
    (tmp_path / "own_module.py").write_text("from own_helper import Mine\n")
    code = (
        "from sumo_cohesion.state import Control, Plan\n"
        "class Mine:\n"
        "    def reset(self, road): pass\n"
        "    def plan(self, observation, history):\n"
        "        return Plan((Control(0.0, 0.5),), [], 'solved')\n"
    )
    run_keys = []
    for version in (code, code.replace("0.5", "0.9")):
        (tmp_path / "own_package" / "impl.py").write_text(version)
        (tmp_path / "own_helper.py").write_text(version)
        script = (
            "from sumo_cohesion.batches.experiment import load_experiment, spell_out\n"
            "e = load_experiment(dict(scenarios=['stalled'], seeds=[0],"
            " planners=['own_package:Mine', 'own_module:Mine']))\n"
            "print(*spell_out(e).plan['run'])\n"
        )
        done = subprocess.run(
            [sys.executable, "-c", script],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
            capture_output=True,
            text=True,
            check=True,
        )
        run_keys.append(done.stdout.split())
    assert len({key for keys in run_keys for key in keys}) == 4


@pytest.mark.slow
def test_a_planners_arguments_and_the_files_they_name_decide_which_run_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    weights = tmp_path / "weights.txt"

    def keys(*arguments: str) -> list[str]:
        arguments = (*arguments, "gain=['weights.txt']", f"gain='{'x' * 300}'")
        asked = [f"{FAULTY}Learned({given})" for given in arguments]
        experiment = {"scenarios": ["stalled"], "seeds": [0], "planners": asked}
        return list(spell_out(load_experiment(experiment)).plan["run"])

    weights.write_text("0.5")
    first = keys("gain=0.5", "gain=1.0", "file='weights.txt'")
    weights.write_text("0.75")
    second = keys("gain=0.5", "gain=1.0", "file='weights.txt'")
    assert (first[:2], first[4]) == (second[:2], second[4])
    assert len({*first, *second}) == 7  # the file's content counts, in a list, too
    experiment = {
        "scenarios": ["stalled"],
        "seeds": [0],
        "planners": [f"{FAULTY}Learned(gain=0.0)", f"{FAULTY}Learned(gain=4.0)"],
        "set": {"duration": 2.0},
    }
    slow, fast = batch(experiment, tmp_path / "out", workers=1)["mean_speed"]
    assert fast > slow + 1.0


@pytest.mark.slow
def test_no_run_sees_what_a_planner_remembers_of_another(tmp_path: Path) -> None:
    """A planner that forgets to forget in reset gives the same with any number of workers."""
    experiment = {
        "scenarios": ["stalled"],
        "seeds": "0:4",
        "planners": [FAULTY + "Forgetful"],
        "set": {"duration": 2.0},
    }
    one, two = (results_of(experiment, tmp_path / str(n), workers=n) for n in (1, 2))
    pd.testing.assert_frame_equal(one, two)
    alone = run("stalled", FAULTY + "Forgetful", 3, overrides={"duration": 2.0}).metrics
    assert one["mean_speed"].iloc[3] == alone["mean_speed"].iloc[0]


@pytest.mark.slow
def test_a_batch_whose_runs_fail_exits_with_1_and_its_summary_is_by_grid_point(
    tmp_path: Path,
) -> None:
    good = SHORT | {"scenarios": ["stalled"], "seeds": "0:2"}
    file = toml(good, tmp_path / "good.toml")
    done = subprocess.run(
        command(file, tmp_path / "good"), cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert "cohesive, cohesion.beta=0.03" in done.stdout
    assert done.stdout.count("n=2") > 4
    assert "n=4" not in done.stdout
    bad = good | {"planners": [FAULTY + "RaisesAtOnce"], "grid": {}}
    file = toml(bad, tmp_path / "bad.toml")
    failed = subprocess.run(
        command(file, tmp_path / "bad"), cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert failed.returncode == 1
    assert "no such road" in failed.stderr


@pytest.mark.slow
def test_what_was_retried_with_success_is_done_whoever_failed_first(tmp_path: Path) -> None:
    small = SHORT | {"scenarios": ["stalled"], "planners": ["sumo"], "grid": {}, "seeds": [0, 1]}
    out = tmp_path / "out"
    whole = batch(small, out, workers=1)
    # As if a shard, whose file is the last by name, had failed to do them before.
    part = out / "runs" / "1of1-00001.parquet"
    failed = pd.read_parquet(part).assign(status="crash", reason="lost")
    failed.to_parquet(out / "runs" / "2of2-00001.parquet", index=False)
    pd.testing.assert_frame_equal(load_metrics(out), whole)


@pytest.mark.slow
def test_an_interrupt_while_workers_start_does_not_wait_for_a_run(tmp_path: Path) -> None:
    """The run never ends: an interrupt that waited for it would not end either."""
    small = SHORT | {"scenarios": ["stalled"], "planners": [FAULTY + "Endless"], "grid": {}}
    file, out = toml(small, tmp_path / "short.toml"), tmp_path / "out"
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with started(command(file, out, "--workers", "1"), cwd=REPOSITORY, env=environment) as process:
        wait_for(lambda: list(tmp_path.glob("sumo-cohesion-*")), process, "a worker")
        process.send_signal(signal.SIGTERM)
        assert end_of(process)[0] == 1
    assert not list(tmp_path.glob("sumo-cohesion-*"))  # nor does it leave anything behind


@pytest.mark.slow
def test_a_reason_that_is_no_text_does_not_spoil_the_batch(tmp_path: Path) -> None:
    experiment = SHORT | {"scenarios": ["stalled"], "planners": [FAULTY + "RaisesNonsense"]}
    rows = batch(experiment | {"grid": {}, "seeds": [0]}, tmp_path / "out", workers=1)
    assert rows["reason"].str.contains("ValueError: bad file ?", regex=False).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seeds": []}, "at least 1 item"),
        ({"seeds": [True, 0.0]}, "valid integer"),
        ({"seeds": "0:1000000000"}, "more than a million seeds"),
        ({"seeds": [3, 3]}, "3 is listed twice"),
        ({"scenarios": []}, "at least 1 item"),
        ({"scenarios": ["stahled"]}, "did you mean 'stalled'"),
        ({"scenarios": ["a\0.toml"]}, "not a file's name"),
        ({"grid": {"cohesion.beta": []}}, "at least 1 item"),
        ({"grid": {"cohesion.beta": [0.1, 0.1]}}, "0.1 is listed twice"),
        ({"grid": {"cohesion.beta": [1, 1.0]}}, "lists a value twice"),
        ({"grid": {"cohesion.bta": [1]}}, "did you mean 'beta'"),
        ({"grid": {"cohesion.beta": [float("nan")]}}, "finite"),
        ({"grid": {"duration": [2.0]}}, "both in \\[set\\] and in \\[grid\\]"),
        ({"grid": {"cohesion.beta": [i / 1e6 for i in range(20_001)]}}, "too many"),
        ({"planners": ["nominl"]}, "unknown planner 'nominl'"),
        ({"planners": [FAULTY + "NoSuch"]}, "has no 'NoSuch'"),
        ({"planners": [FAULTY + "Good(1)"]}, "arguments by name"),
        ({"planners": [FAULTY + "Good(x=1)"]}, "cannot be called with these arguments"),
        ({"grid": {"chesion.beta": [1.0]}}, "did you mean 'cohesion.beta'"),
        ({"grid": {"beta": [1.0]}}, "did you mean 'cohesion.beta'"),
        ({"grid": {"planner.reward": ["@gone.toml"]}}, r"gone\.toml: cannot be read"),
        ({"planners": [FAULTY + "CannotBeMade"]}, "cannot be called with these arguments"),
        ({"keep": ["everything"]}, "keep"),
        ({"colour": 1}, "unknown key 'colour'"),
    ],
)
def test_a_mistake_in_an_experiment_is_one_line(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=message) as error:
        batch(SHORT | change, tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out" / "manifest.json").exists()


def test_a_planner_that_ends_its_process_when_imported_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "this_exits.py").write_text("import sys\n\nsys.exit(0)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match="cannot import 'this_exits'"):
        batch(SHORT | {"planners": ["this_exits:Planner"]}, tmp_path / "out")


def test_numbers_and_texts_on_one_axis_make_a_column_of_texts() -> None:
    mixed = SHORT | {"grid": {"human_type.speedFactor": [1.1, "normc(1,0.1,0.2,2)"]}}
    plan = spell_out(load_experiment(mixed)).plan
    assert set(plan["human_type.speedFactor"]) == {"1.1", "normc(1,0.1,0.2,2)"}


@pytest.mark.slow
def test_kept_tables_are_found_by_what_they_are_of(tmp_path: Path) -> None:
    experiment = {
        "scenarios": ["stalled"],
        "planners": ["nominal", "cohesive"],
        "seeds": "0:2",
        "set": {"duration": 12.0},
        "grid": {"randomize.humans": [[3, 3], [5, 5]]},
    }
    out = tmp_path / "out"
    batch(experiment, out, workers=2)
    with pytest.raises(UserError, match="not kept"):
        load_trajectories(out)
    # The same runs, now with tables: they have to be done again.
    total: list[int] = []
    keeping = experiment | {
        "keep": ["trajectory", "ego"],
        "sumo_outputs": ["fcd", "tripinfo", "ssm"],
    }
    batch(keeping, out, workers=2, progress=counting(total))
    assert total[-1] == 8
    some = load_trajectories(out, {"planner": "cohesive", "randomize.humans": [[3, 3]], "seed": 1})
    assert some["run"].nunique() == 1
    assert list(some.columns[:5]) == ["run", "scenario", "planner", "randomize.humans", "seed"]
    assert set(some["vehicle"]) == {"ego", "lead_1", "lead_2", "lead_3"}
    ego = load_trajectories(out, {"seed": [0, 1]}, table="ego")
    assert ego["run"].nunique() == 8
    fcd = load_trajectories(out, {"seed": 0}, table="sumo_fcd")
    same = fcd[(fcd["run"] == fcd["run"].iloc[0]) & (fcd["id"] == "ego")]
    assert same["time"].is_monotonic_increasing
    assert fcd["speed"].dtype == float
    trips = load_trajectories(out, table="sumo_tripinfo")
    assert {"stalled", "ego"} <= set(trips["id"])
    # Nobody has come near another yet.
    conflicts = load_trajectories(out, table="sumo_ssm")
    assert {"ego", "foe"} <= set(conflicts.columns)
    with pytest.raises(UserError, match="not told apart by 'colour'"):
        load_trajectories(out, {"colour": 1})
    with pytest.raises(UserError, match="no run there fits"):
        load_trajectories(out, {"seed": 99})


@pytest.mark.slow
def test_sumos_own_outputs_come_with_one_run_too(tmp_path: Path) -> None:
    rollout = run("stalled", "nominal", 0, sumo_outputs=("fcd", "ssm"), out=tmp_path / "run")
    conflicts = rollout.sumo["ssm"]
    hit = conflicts[(conflicts["ego"] == "ego") & (conflicts["foe"] == "stalled")]
    assert hit["minTTC_value"].min() == 0.0
    again = Rollout.read(tmp_path / "run")
    pd.testing.assert_frame_equal(again.sumo["ssm"], conflicts)
    # SUMO's record of the ego is the own one: of the front bumper, stamped with the step's begin.
    fcd = again.sumo["fcd"].query("id == 'ego'")
    fcd = fcd.assign(time=(fcd["time"] + 0.1).round(1)).set_index("time")
    own = again.trajectory.query("vehicle == 'ego'").set_index("time")
    own.index = own.index.to_numpy().round(1)
    both = own.join(fcd, rsuffix="_front", how="inner").iloc[1:]
    assert len(both) > 100
    assert (both["x_front"] - both["x"]).to_numpy() == pytest.approx(2.5, abs=0.05)


@pytest.mark.slow
def test_a_dry_run_counts_and_keeps_nothing(tmp_path: Path) -> None:
    one = SHORT | {"scenarios": ["stalled"]}
    plan = dry_run(one, tmp_path / "out", estimate=True).set_index(["scenario", "planner"])
    assert plan["runs"].to_dict() == {("stalled", "nominal"): 3, ("stalled", "cohesive"): 6}
    assert (plan["left"] == plan["runs"]).all()
    assert (plan["seconds"] > 0.0).all()
    assert not (tmp_path / "out").exists()


def test_a_dry_run_runs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sumo_cohesion.batches.batch.Workers", None)
    plan = dry_run(SHORT, tmp_path / "out")
    assert plan["left"].tolist() == plan["runs"].tolist()
    assert plan["seconds"].isna().all()


@pytest.mark.slow
def test_a_dry_run_knows_how_long_runs_took(tmp_path: Path) -> None:
    small = SHORT | {"scenarios": ["stalled"], "planners": ["sumo"], "grid": {}, "seeds": [0]}
    batch(small, tmp_path / "out", workers=1)
    plan = dry_run(small | {"seeds": [0, 1, 2]}, tmp_path / "out")
    assert plan["left"].tolist() == [2]
    assert (plan["seconds"] > 0.0).all()


@pytest.mark.slow
def test_two_batches_do_not_work_in_one_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    refused: list[str] = []

    def again(progress: Progress) -> None:
        if not refused:
            with pytest.raises(UserError, match="a batch is running there") as error:
                batch(SHORT, out)
            refused.append(str(error.value))

    batch(
        SHORT | {"scenarios": ["stalled"], "planners": ["sumo"], "seeds": [0]}, out, progress=again
    )
    assert refused


@pytest.mark.slow
def test_what_a_kill_has_torn_is_left_out(tmp_path: Path) -> None:
    small = SHORT | {"scenarios": ["stalled"], "planners": ["sumo"], "grid": {}, "seeds": "0:3"}
    out = tmp_path / "out"
    whole = batch(small, out, workers=1)
    # As if killed while it wrote the last row, before the rows became a part.
    part = out / "runs" / "1of1-00001.parquet"
    lines = pd.read_parquet(part).to_json(orient="records", lines=True, double_precision=15)
    part.unlink()
    part.with_suffix(".jsonl").write_text(lines.rstrip()[:-40])
    assert len(load_metrics(out)) == 2
    total: list[int] = []
    again = batch(small, out, workers=1, progress=counting(total))
    assert total == [1]
    assert again["seed"].tolist() == whole["seed"].tolist()


def test_threads_may_ask_for_runs_at_once_and_close_ends_them(tmp_path: Path) -> None:
    gate = Gate(tmp_path / "gate")
    workers = Workers(f"{hold.__module__}:{hold.__name__}", Limits(3600.0, 1.0))
    ended: list[str] = []

    def call() -> None:
        try:
            workers.call(str(gate.folder))
        except CallFailedError as error:
            ended.append(error.kind)

    threads = [threading.Thread(target=call, daemon=True) for _ in range(2)]
    for thread in threads:
        thread.start()
    wait_for(lambda: len(gate.waiting()) == 2, what="both calls")
    workers.close()
    wait_for(lambda: not any(thread.is_alive() for thread in threads), what="their end")
    assert ended == ["crash", "crash"]


class ClosedMeanwhile:
    """A pipe that another thread closes in the same moment."""

    def close(self) -> None:
        raise ValueError("flush of closed file")


def test_a_process_is_ended_by_two_threads_at_once_without_a_word() -> None:
    """By the one whose call it did, and by the one that closes the workers: after Ctrl-C."""
    workers = Workers("builtins:len", Limits(3600.0, 1.0))
    assert workers.call("four") == 4
    (process,) = workers._all
    with process._to:
        process._process.stdin = ClosedMeanwhile()  # type: ignore[assignment]
        workers.close()
    assert not process.is_alive()
    assert not Path(process._folder).exists()
