"""Folders of results: written whole or not at all, and nothing of a user's is touched.

A result's folder holds a list of the files that are the result's (`MARKER`). Only these are
replaced by the next result; whatever else lies beside them stays.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from sumo_cohesion.errors import UserError

MARKER = ".sumo-cohesion.json"
"""File that lists, by relative path, which files of a folder are the result's."""
BATCH_FILE = "manifest.json"
"""File of a batch's folder (batches.store), which is gone on with and never replaced."""


def require_replaceable(folder: Path, option: str = "--out") -> None:
    """Raise UserError unless a result can be written to a folder; its parents are made.

    That is one that is not there yet, is empty, or holds an earlier result. ``option`` is the
    command line's, to choose another with.
    """
    try:
        holds_other = folder.is_dir() and any(folder.iterdir()) and not _is_result(folder)
        if holds_other or (folder.exists() and not folder.is_dir()):
            raise UserError(
                f"{folder}: holds something else than an earlier result; choose another {option}"
            )
        _new_beside(folder.resolve()).rmdir()
    except OSError as error:
        raise _cannot_write(folder, error, option) from None


class whole_folder:  # noqa: N801 - reads as a function where it is used
    """Context: a new folder to write into, whose files are moved to ``folder`` if all went well.

    They replace those of an earlier result. If a file of somebody else is in the way, or the disk
    refuses, the new files are kept and the UserError says where.
    """

    def __init__(self, folder: Path, option: str = "--out") -> None:
        self._folder, self._option = folder, option

    def __enter__(self) -> Path:
        try:
            self._target = self._folder.resolve()  # a link stays one
            self._new = _new_beside(self._target)
            self._new.chmod(0o755)
        except OSError as error:
            raise _cannot_write(self._folder, error, self._option) from None
        return self._new

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            shutil.rmtree(self._new, ignore_errors=True)
            if isinstance(error, OSError):
                raise _cannot_write(self._folder, error, self._option) from None
            return
        try:
            _list_files(self._new)
            if self._target.exists():
                _move_into(self._target, self._new)
            else:
                self._new.rename(self._target)
        except BaseException as problem:
            kept = keep(self._new, self._target)
            if not isinstance(problem, OSError | UserError):
                raise
            said = problem.strerror or problem if isinstance(problem, OSError) else problem
            raise UserError(
                f"{self._folder}: {said}; the new result is kept in {kept}; choose another "
                f"{self._option}"
            ) from None


def keep(new: Path, folder: Path) -> Path:
    """Move unfinished work to a name that nobody has, beside a folder or else in it.

    Returns where it is.
    """
    folder = folder.resolve()
    for place in (folder.with_name(f"{folder.name}.unfinished"), new.with_name("unfinished")):
        for number in range(1, 1000):
            free = place if number == 1 else place.with_name(f"{place.name}-{number}")
            if not free.exists():
                with contextlib.suppress(OSError):  # another disk, or not to be written to
                    return new.rename(free)
                break
    return new


def _is_result(folder: Path) -> bool:
    """Tell whether a folder holds a result that another may replace: a batch's never is."""
    return (folder / MARKER).is_file() and not (folder / BATCH_FILE).is_file()


@contextlib.contextmanager
def claim(folder: Path, name: str) -> Iterator[Path]:
    """Context: the path of one more file of a result, which is the result's once it is written.

    Raises
    ------
    UserError
        If somebody else's file has this name.
    """
    path, files = folder / name, _listed(folder)
    if path.exists() and name not in files:
        raise UserError(f"{path}: is not of this result and stays; name another file with --out")
    yield path
    with contextlib.suppress(OSError):
        _write_list(folder, [*files, name])


def _new_beside(folder: Path) -> Path:
    """Make a hidden folder from which files can be moved to one that may not be there yet."""
    if folder.is_dir():
        return Path(tempfile.mkdtemp(prefix=".new-", dir=folder))
    folder.parent.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))


def _listed(folder: Path) -> list[str]:
    """Files of the result that a folder holds; none if it holds none."""
    try:
        files = [Path(name) for name in json.loads((folder / MARKER).read_text("utf-8"))["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return [p.as_posix() for p in files if not p.is_absolute() and ".." not in p.parts]


def _list_files(folder: Path) -> None:
    _write_list(
        folder, [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()]
    )


def _write_list(folder: Path, files: list[str]) -> None:
    text = json.dumps({"files": sorted(set(files))}, indent=1, ensure_ascii=False)
    (folder / MARKER).write_text(text + "\n", encoding="utf-8")


def _move_into(folder: Path, new: Path) -> None:
    """Replace the files of a folder's earlier result by those of the new one."""
    earlier, files = [*_listed(folder), MARKER], [*_listed(new), MARKER]
    for name in files:
        if (folder / name).exists() and name not in earlier:
            raise UserError(f"{name} there is not of an earlier result and would be overwritten")
    old = Path(tempfile.mkdtemp(prefix=".old-", dir=folder))
    moved: list[tuple[Path, Path]] = []
    try:
        # The list goes first and comes last: without it there is no result.
        for source, target, names in ((folder, old, reversed(earlier)), (new, folder, files)):
            for name in names:
                if (source / name).exists():
                    (target / name).parent.mkdir(parents=True, exist_ok=True)
                    moved.append((source / name, (target / name)))
                    (source / name).rename(target / name)
    except BaseException:  # Ctrl-C, too
        restored = True
        for source_file, target_file in reversed(moved):
            try:
                target_file.rename(source_file)
            except FileNotFoundError:  # the one that could not be moved
                restored = restored and source_file.exists()
            except OSError:
                restored = False
        if restored:
            shutil.rmtree(old, ignore_errors=True)
        raise
    for done in (old, new):
        shutil.rmtree(done, ignore_errors=True)
    _remove_emptied(folder, earlier)


def _remove_emptied(folder: Path, names: list[str]) -> None:
    """Remove the folders of files that have gone, as far as nothing else is in them."""
    for name in names:
        for parent in (folder / name).parents:
            if parent == folder:
                break
            with contextlib.suppress(OSError):  # not empty
                parent.rmdir()


def _cannot_write(folder: Path, error: OSError, option: str) -> UserError:
    return UserError(
        f"{folder}: cannot write there ({error.strerror or error}); free some space or choose "
        f"another {option}"
    )
