"""Results replace their own files and nothing else, whatever lies beside them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sumo_cohesion.errors import UserError
from sumo_cohesion.tables import folders
from sumo_cohesion.tables.folders import MARKER, claim, keep, require_replaceable, whole_folder


def write(folder: Path, *names: str, text: str = "new") -> None:
    """Write a result of some files."""
    require_replaceable(folder)
    with whole_folder(folder) as new:
        for name in names:
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            (new / name).write_text(text)


def files(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_an_earlier_result_is_replaced_and_a_users_files_stay(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, "run.json", "old/a.parquet", "shared/b.parquet", text="old")
    (out / "notes.md").write_text("mine")
    (out / "shared" / "notebook.ipynb").write_text("mine")
    write(out, "run.json", "plan.parquet")
    assert files(out) == {"run.json", "plan.parquet", "notes.md", "shared/notebook.ipynb", MARKER}
    assert (out / "run.json").read_text() == "new"
    assert (out / "notes.md").read_text() == (out / "shared/notebook.ipynb").read_text() == "mine"
    assert not (out / "old").exists()  # of the files that have gone no empty folders are left


def test_what_is_put_there_meanwhile_stays(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, "run.json", text="old")
    with whole_folder(out) as new:
        (new / "run.json").write_text("new")
        (out / "meanwhile.txt").write_text("mine")
    assert (out / "meanwhile.txt").read_text() == "mine"
    assert (out / "run.json").read_text() == "new"


@pytest.mark.parametrize("there_before", [True, False])
def test_nobodys_file_is_overwritten_and_the_new_result_is_kept(
    tmp_path: Path, there_before: bool
) -> None:
    out = tmp_path / "out"
    if there_before:
        write(out, "run.json", text="old")
    with (  # noqa: PT012 - what raises is the end of the block
        pytest.raises(UserError, match=r"plan\.parquet there is not of an earlier result") as error,
        whole_folder(out) as new,
    ):
        (new / "run.json").write_text("new")
        (new / "plan.parquet").write_text("new")
        out.mkdir(exist_ok=True)
        (out / "plan.parquet").write_text("mine")
    assert (out / "plan.parquet").read_text() == "mine"
    assert (out / "run.json").exists() == there_before
    kept = tmp_path / "out.unfinished"
    assert str(kept) in str(error.value)
    assert files(kept) == {"run.json", "plan.parquet", MARKER}
    assert files(out) == ({"run.json", MARKER} if there_before else set()) | {"plan.parquet"}


def test_a_folder_of_something_else_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")  # named as ours, but not ours
    with pytest.raises(UserError, match="something else"):
        require_replaceable(tmp_path)
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(UserError, match="something else"):
        require_replaceable(file)
    with pytest.raises(UserError, match="cannot write there"):
        require_replaceable(file / "below")
    (tmp_path / "empty").mkdir()
    require_replaceable(tmp_path / "empty")
    assert files(tmp_path) == {"run.json", "file"}


def test_the_current_folder_and_a_link_can_hold_a_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.chdir(scratch)
    for _ in range(2):
        write(Path(), "run.json")
    assert files(scratch) == {"run.json", MARKER}
    link = tmp_path / "link"
    link.symlink_to(scratch)
    write(link, "run.json", "plan.parquet")
    assert link.is_symlink()
    assert files(scratch) == {"run.json", "plan.parquet", MARKER}
    assert {p.name for p in tmp_path.iterdir()} == {"scratch", "link"}


@pytest.mark.parametrize("nth", range(6))
def test_a_disk_that_refuses_leaves_the_old_result_whole_and_keeps_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nth: int
) -> None:
    out = tmp_path / "out"
    write(out, "a", "b", text="old")
    real, calls = Path.rename, iter(range(100))

    def rename(self: Path, target: Path) -> Path:
        if next(calls) == nth:
            raise OSError(28, "No space left on device")
        return real(self, target)

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(UserError, match="No space left on device") as error:
        write(out, "a", "c")
    monkeypatch.undo()
    assert {name: (out / name).read_text() for name in ("a", "b")} == {"a": "old", "b": "old"}
    assert json.loads((out / MARKER).read_text())["files"] == ["a", "b"]
    kept = tmp_path / "out.unfinished"
    assert f"kept in {kept}" in str(error.value)
    assert {name: (kept / name).read_text() for name in ("a", "c")} == {"a": "new", "c": "new"}
    assert files(out) == {"a", "b", MARKER}


def test_unfinished_work_takes_a_name_that_nobody_has(tmp_path: Path) -> None:
    (tmp_path / "out.unfinished").mkdir()
    (tmp_path / "out.unfinished" / "mine").write_text("mine")
    new = tmp_path / ".new"
    new.mkdir()
    assert keep(new, tmp_path / "out") == tmp_path / "out.unfinished-2"
    assert (tmp_path / "out.unfinished" / "mine").read_text() == "mine"


def test_a_failure_while_writing_leaves_nothing_behind(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with (  # noqa: PT012 - as a full disk does
        pytest.raises(UserError, match="cannot write there"),
        whole_folder(out) as new,
    ):
        (new / "a").write_text("half")
        raise OSError(28, "No space left on device")
    with pytest.raises(KeyError), whole_folder(out):
        raise KeyError
    assert list(tmp_path.iterdir()) == []


def test_a_picture_joins_a_result_but_replaces_no_other(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, "run.json")
    for text in ("drawn", "drawn again"):
        with claim(out, "paths.png") as path:
            path.write_text(text)
    (out / "other.png").write_text("mine")
    with (
        pytest.raises(UserError, match=r"other\.png: is not of this result"),
        claim(out, "other.png"),
    ):
        pass
    with pytest.raises(KeyError), claim(out, "third.png"):
        raise KeyError  # nothing was drawn
    (out / "third.png").write_text("mine")
    write(out, "run.json")
    assert files(out) == {"run.json", "other.png", "third.png", MARKER}


def test_a_list_that_names_files_elsewhere_reaches_none_of_them(tmp_path: Path) -> None:
    outside, out = tmp_path / "outside", tmp_path / "out"
    outside.write_text("mine")
    write(out, "run.json")
    listed = {"files": ["run.json", "../outside", str(outside)]}
    (out / MARKER).write_text(json.dumps(listed))
    write(out, "run.json")
    assert outside.read_text() == "mine"
    for nonsense in ("", "[]", '{"files": 3}', '{"files": [3]}'):
        (out / MARKER).write_text(nonsense)
        assert folders._listed(out) == []


def test_a_batch_is_never_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, "a.png")
    (out / "manifest.json").write_text("{}")
    with pytest.raises(UserError, match="something else"):
        require_replaceable(out)


def test_unfinished_work_stays_on_its_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it cannot be moved beside the folder, as from another disk, it is kept within."""
    out = tmp_path / "out"
    out.mkdir()
    real = Path.rename

    def rename(self: Path, target: Path) -> Path:
        if Path(target).parent != out:
            raise OSError(18, "Invalid cross-device link")
        return real(self, target)

    monkeypatch.setattr(Path, "rename", rename)
    for expected in ("unfinished", "unfinished-2"):
        with pytest.raises(KeyError), whole_folder(out) as new:  # noqa: PT012
            (new / "run.json").write_text("done")
            assert keep(new, out) == out / expected
            raise KeyError
    assert files(out) == {"unfinished/run.json", "unfinished-2/run.json"}


@pytest.mark.parametrize("nth", range(6))
def test_ctrl_c_while_files_are_moved_leaves_the_old_result_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nth: int
) -> None:
    out = tmp_path / "out"
    write(out, "a", "b", text="old")
    real, calls = Path.rename, iter(range(100))

    def rename(self: Path, target: Path) -> Path:
        if next(calls) == nth:
            raise KeyboardInterrupt
        return real(self, target)

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(KeyboardInterrupt):
        write(out, "a", "c")
    monkeypatch.undo()
    assert {name: (out / name).read_text() for name in ("a", "b")} == {"a": "old", "b": "old"}
    assert (tmp_path / "out.unfinished" / "c").read_text() == "new"
    write(out, "a")  # it is an earlier result still
    assert files(out) == {"a", MARKER}
