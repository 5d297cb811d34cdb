"""What a batch leaves in its folder, and how nothing of it is lost or doubled.

    DIR/manifest.json         the experiment, the grid's names, versions
    DIR/plan.parquet          one row per wanted run: its key, scenario, planner, grid, seed
    DIR/runs/*.parquet        one row per run that was done, by key
    DIR/runs/*.jsonl          the newest rows, while a batch runs or after it was killed
    DIR/tables/NAME/*.parquet tables that were kept, one file per run
    DIR/metrics.parquet       plan and runs joined, once the batch has come to its end

Rows are appended to a journal, one line each, and turned into a parquet part now and then. A line
that a kill has torn is left out; its run is done again. Rows of settings, networks or code that are
no longer in the plan stay in runs/ and are never joined; they count again when the plan does.
"""

from __future__ import annotations

import contextlib
import json
import os
import uuid
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import pandas as pd

from sumo_cohesion.errors import StorageError, UserError
from sumo_cohesion.locks import alone
from sumo_cohesion.tables.columns import BATCH
from sumo_cohesion.tables.folders import BATCH_FILE
from sumo_cohesion.tables.metrics import METRICS

MANIFEST = BATCH_FILE
FORMAT = 1
ROWS_PER_PART = 1000
DONE = "done"
CHANGED = "changed"
"""Status of a run that was not done, because what decides its result was no longer the same."""

_NULLABLE = {"bool": "boolean", "int64": "Int64"}
_DTYPES = {c.name: c.dtype for c in BATCH} | {
    c.name: _NULLABLE.get(c.dtype, c.dtype) for c in METRICS
}
NOT_REPEATABLE = ("attempts", "wall_time", "plan_ms_median", "plan_ms_p99")
"""Columns that differ between two runs of the same key: times."""


Value = bool | int | float | str | list[Any]
"""A value of a grid."""


def table_file(folder: Path, name: str, run: str) -> Path:
    """File of one kept table of one run."""
    return folder / "tables" / name / f"{run}.parquet"


def as_cell(value: Value) -> bool | int | float | str:
    """Return a grid value as a table holds it: lists as text.

    >>> as_cell([2, 5]), as_cell(0.5)
    ('[2, 5]', 0.5)
    """
    return json.dumps(value, default=str) if isinstance(value, list) else value


class Store:
    """The folder of a batch, open for one writer; a context manager.

    Several writers of different names (the shards of one batch) may work on one folder.
    """

    def __init__(self, folder: Path, writer: str) -> None:
        self.folder = folder
        self._runs = folder / "runs"
        self._writer = writer
        self._journal: IO[str] | None = None
        self._rows = 0
        self._lock: IO[str] | None = None

    def __enter__(self) -> Store:
        with storing(self.folder):
            _require_ours(self.folder)
            self._runs.mkdir(parents=True, exist_ok=True)
            self._lock = _locked(self._runs / f".{self._writer}.lock")
            if self._lock is None:
                raise UserError(f"{self.folder}: a batch is running there; wait, or stop it first")
            for journal in sorted(self._runs.glob(f"{self._writer}-*.jsonl")):
                _seal(journal)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            with storing(self.folder):
                self._close_journal()
        except StorageError:
            if kind is None:  # else the first problem is told; the journal keeps the rows
                raise
        finally:
            if self._lock is not None:
                self._lock.close()

    def write_plan(self, plan: pd.DataFrame, about: Mapping[str, Any]) -> None:
        """Write what is wanted; an older plan's joined table is no longer true."""
        with storing(self.folder):
            (self.folder / "metrics.parquet").unlink(missing_ok=True)
            _write_parquet(plan, self.folder / "plan.parquet")
            text = json.dumps({"format": FORMAT, "kind": "batch", **about}, indent=2)
            _write_text(text + "\n", self.folder / MANIFEST)

    def finished(self, tables: Iterable[str], *, retry_failed: bool = False) -> set[str]:
        """Keys of the runs that need not be done (again)."""
        rows = _stored(self.folder, ["run", "status"])
        rows = rows[rows["status"] != CHANGED]
        failed = set(rows.loc[rows["status"] != DONE, "run"])
        done = set(rows["run"]) - failed
        for name in tables:
            folder = table_file(self.folder, name, "").parent
            done &= {path.stem for path in folder.glob("*.parquet")}
        return done if retry_failed else done | failed

    def add(self, row: Mapping[str, Any]) -> None:
        """Keep one row; once this returns, a kill does not lose it."""
        if self._journal is None:
            self._journal = _new_journal(self._runs, self._writer).open("w", encoding="utf-8")
        end = self._journal.tell()
        try:
            self._journal.write(json.dumps(row) + "\n")
            self._journal.flush()
        except OSError as error:
            with contextlib.suppress(OSError):  # leave no torn line before later ones
                os.truncate(self._journal.name, end)
            raise _storage_error(self.folder, error) from None
        self._rows += 1
        if self._rows >= ROWS_PER_PART:
            with storing(self.folder):
                self._close_journal()

    def _close_journal(self) -> None:
        if self._journal is None:
            return
        journal, self._journal, self._rows = self._journal, None, 0
        with contextlib.suppress(OSError):  # what could not be flushed has been reported
            journal.close()
        _seal(Path(journal.name))

    def join(self) -> pd.DataFrame:
        """Write metrics.parquet: what load_metrics gives, for those who read without us."""
        # Of several shards, the one that writes last must also have read last.
        with storing(self.folder), alone(self._runs / ".join.lock"):
            self._close_journal()
            table = joined(self.folder)
            _write_parquet(table, self.folder / "metrics.parquet")
        return table


def is_batch(folder: Path) -> bool:
    """Tell whether a folder is that of a batch."""
    return (folder / MANIFEST).is_file()


def manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a batch's folder."""
    try:
        about: dict[str, Any] = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{folder / MANIFEST}: cannot be read ({error})") from None
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise UserError(f"{folder}: written by another version of this package")
    return about


def wanted(folder: Path) -> pd.DataFrame:
    """Return a batch's plan: one row per wanted run."""
    manifest(folder)
    return read_parquet(folder / "plan.parquet")


def joined(folder: Path) -> pd.DataFrame:
    """One row per wanted run that was done or has failed, in the order of the plan."""
    plan, rows = wanted(folder), _stored(folder, None)
    named = {"scenario", "planner", "seed"}
    rows = rows.drop(columns=[c for c in rows.columns if c in named])
    table = plan.merge(rows, on="run", how="inner", sort=False, validate="many_to_one")
    first = [c.name for c in BATCH]
    return table[[*first, *(c for c in table.columns if c not in first)]]


def _stored(folder: Path, columns: list[str] | None) -> pd.DataFrame:
    """All rows in runs/, each run once: the newest that has a result, else the newest."""
    paths = [p for p in (folder / "runs").glob("*") if not p.name.startswith(".")]
    paths.sort(key=_changed)
    sealed = {p.stem for p in paths if p.suffix == ".parquet"}
    frames = [
        read_parquet(path, columns) if path.suffix == ".parquet" else _read_journal(path, columns)
        for path in paths
        if path.suffix == ".parquet" or (path.suffix == ".jsonl" and path.stem not in sealed)
    ]
    if not frames:
        frames = [_frame([], columns)]
    rows = pd.concat(frames, ignore_index=True)
    rows = rows.sort_values("status", key=lambda s: s == DONE, kind="stable")
    return rows.drop_duplicates("run", keep="last")


def _changed(path: Path) -> tuple[float, str]:
    try:
        return path.stat().st_mtime, path.name
    except FileNotFoundError:  # a journal that became a part in this moment
        return float("inf"), path.name


def _read_journal(path: Path, columns: list[str] | None) -> pd.DataFrame:
    try:
        return _frame(list(_lines(path)), columns)
    except FileNotFoundError:  # it has become a part since the folder was listed
        part = path.with_suffix(".parquet")
        return read_parquet(part, columns) if part.exists() else _frame([], columns)


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    """Rows of a journal, up to a line that was torn."""
    text = path.read_text(encoding="utf-8", errors="replace")
    for line in text.split("\n")[:-1]:
        try:
            yield json.loads(line)
        except ValueError:
            return


def _frame(rows: list[dict[str, Any]], columns: list[str] | None) -> pd.DataFrame:
    names = columns or list(_DTYPES)
    frame = pd.DataFrame(rows, columns=names)
    return frame.astype({name: _DTYPES[name] for name in names})


def _seal(journal: Path) -> None:
    """Turn a journal into a parquet part of the same name."""
    part = journal.with_suffix(".parquet")
    rows = list(_lines(journal))
    if rows and not part.exists():
        _write_parquet(_frame(rows, None), part)
    journal.unlink()


def _new_journal(runs: Path, writer: str) -> Path:
    numbers = [int(p.stem.rpartition("-")[2]) for p in runs.glob(f"{writer}-*.parquet")]
    return runs / f"{writer}-{max(numbers, default=0) + 1:05d}.jsonl"


def read_parquet(path: Path, columns: list[str] | None = None) -> pd.DataFrame:
    """Read a table that this package wrote; raises UserError if it is damaged."""
    try:
        return pd.read_parquet(path, columns=columns)
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"{path}: not a readable table ({error}); remove it and run again"
        ) from None


def _write_parquet(frame: pd.DataFrame, path: Path) -> None:
    with _replacing(path) as new:
        frame.to_parquet(new, index=False)


def _write_text(text: str, path: Path) -> None:
    with _replacing(path) as new:
        new.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Give a new file to write, which then replaces the old one: whole, or not at all."""
    new = path.with_name(f".{path.name}.{uuid.uuid4().hex}.new")
    try:
        yield new
        with new.open("rb") as file:
            os.fsync(file.fileno())
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)


def _require_ours(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file; choose another --out")
    if folder.is_dir() and not is_batch(folder):
        own = ("runs", "plan.parquet")  # of a batch that was killed at once
        if any(p.name not in own and not p.name.startswith(".") for p in folder.iterdir()):
            raise UserError(f"{folder}: holds something else than a batch; choose another --out")


def _locked(path: Path) -> IO[str] | None:
    """Lock a file until it is closed, or the process ends; None if another has it."""
    file = path.open("w")
    try:
        import fcntl
    except ImportError:  # Windows: nothing keeps two batches apart
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    except OSError:  # a file system without locks
        return file
    return file


class storing:  # noqa: N801 - reads as a function where it is used
    """Context: what the disk refuses is one clear line."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __enter__(self) -> None:
        pass

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if isinstance(error, OSError):
            raise _storage_error(self._folder, error) from None


def _storage_error(folder: Path, error: OSError) -> StorageError:
    return StorageError(
        f"{folder}: cannot be written ({error.strerror or error}); what is done is kept: free some "
        "space or mend the permissions, and run the batch again"
    )
