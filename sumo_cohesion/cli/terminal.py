"""What commands print: numbers, tables, and how far they are."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    import pandas as pd

_SIDE_BY_SIDE = 4
"""Planners, or points of a grid, that a summary shows beside each other."""
_IN_SHORT = ("success", "collision", "off_road", "mean_speed", "plan_failures")
"""What it shows of more than these."""
_QUIET = 60.0
"""Seconds between two lines of progress where there is no terminal."""


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows as JSON has them: a number that is not finite is null."""
    return [
        {
            str(k): None if isinstance(v, float) and not math.isfinite(v) else v
            for k, v in row.items()
        }
        for row in frame.to_dict(orient="records")
    ]


def shown(value: object) -> str:
    """One value as a person reads it."""
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def print_summary(summary: pd.DataFrame) -> None:
    """Print rates and means with their intervals as a table."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if summary.empty:
        return
    table = Table(title="95 % confidence intervals: Wilson for rates, bootstrap for means")
    down, across = "metric", "planner"
    if summary["planner"].nunique() > _SIDE_BY_SIDE:  # one below the other, what matters most
        down, across = across, down
        summary = summary[summary["metric"].isin(_IN_SHORT)]
    for name in (down, *summary[across].unique()):
        table.add_column(escape(name), justify="left" if name == down else "right", no_wrap=True)
    for of in summary[down].unique():
        cells = [
            f"{r.value:.2f} [{r.low:.2f}, {r.high:.2f}] n={r.n}" if r.n else "-"
            for r in summary[summary[down] == of].itertuples()
        ]
        table.add_row(escape(of), *cells)
    # Wide enough for the table where the output is a file or a pipe.
    Console(width=None if sys.stdout.isatty() else 140).print(table)


@contextmanager
def progress_bar(title: str, runs: int | None = None) -> Iterator[Any]:
    """Say how far a number of runs are, on standard error: (done, total, failed, what) are shown.

    A bar with rate and ETA on a terminal; elsewhere a line now and then, for the log of a night.
    """
    with _bar(title, runs) if sys.stderr.isatty() else _lines(title) as show:
        yield show


@contextmanager
def _lines(title: str) -> Iterator[Any]:
    told = time.monotonic()

    def show(done: int, total: int, failed: int = 0, what: str = "") -> None:
        nonlocal told
        if time.monotonic() - told > _QUIET:
            told = time.monotonic()
            click.echo(f"{_counted(title, failed, what)}: {done} of {total}", err=True)

    yield show


@contextmanager
def _bar(title: str, runs: int | None) -> Iterator[Any]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=runs)

        def show(done: int, total: int, failed: int = 0, what: str = "") -> None:
            description = _counted(title, failed, what)
            bar.update(task, completed=done, total=total, description=description)

        yield show


def _counted(title: str, failed: int, what: str) -> str:
    title = f"{title}: {what}" if what else title
    return f"{title}, {failed} failed" if failed else title


@contextmanager
def clean_stdout() -> Iterator[None]:
    """Send what native libraries print to standard output to standard error instead."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)
