"""Commands that read results: metrics and pictures."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import click

from sumo_cohesion.cli.terminal import records
from sumo_cohesion.errors import UserError


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--format",
    "style",
    type=click.Choice(["table", "csv", "parquet", "json"]),
    default="table",
    show_default=True,
)
@click.option("--out", type=click.Path(path_type=Path), help="File to write (parquet needs it).")
def metrics(folder: Path, style: str, out: Path | None) -> None:
    """Print or convert the metrics of all runs below FOLDER."""
    from sumo_cohesion.batches.results import load_metrics
    from sumo_cohesion.tables.damaged import tables_of

    with tables_of(folder):
        frame = load_metrics(folder)
    if style == "parquet":
        if out is None:
            raise UserError("--format parquet writes a file; name it with --out")
        with _writing(out):
            frame.to_parquet(out, index=False)
        return
    if style == "csv":
        text = frame.to_csv(index=False)
    elif style == "json":
        text = json.dumps(records(frame), ensure_ascii=False) + "\n"
    else:
        text = frame.to_string(index=False) + "\n"
    if out is None:
        click.echo(text, nl=False)
        return
    with _writing(out):
        out.write_text(text, encoding="utf-8")


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Picture file, .png, .pdf or .svg.")
@click.option("--seed", type=int, help="Which seed of a comparison. Default: the first.")
@click.option("--metric", help="Of a batch: what to draw, e.g. success.")
@click.option("--over", help="Of a batch: a name of its grid, the horizontal axis.")
@click.option("--panels", help="Of a batch: another name of its grid, a panel per value.")
def figure(
    folder: Path,
    out: Path | None,
    seed: int | None,
    metric: str | None,
    over: str | None,
    panels: str | None,
) -> None:
    """Draw the picture of a run, a comparison or a batch from its saved tables."""
    from sumo_cohesion.batches.store import is_batch
    from sumo_cohesion.tables.damaged import tables_of

    if is_batch(folder):
        if metric is None or over is None:
            raise UserError(f"{folder}: is a batch; say what to draw with --metric and --over")
        from sumo_cohesion.batches.results import load_metrics
        from sumo_cohesion.report.grid import draw_grid
        from sumo_cohesion.tables.folders import claim

        with tables_of(folder), nullcontext(out) if out else claim(folder, f"{metric}.png") as path:
            draw_grid(load_metrics(folder), metric, over, panels, path)
        click.echo(path)
        return
    from sumo_cohesion.report.paths import draw_comparison, draw_run

    _require_one(folder)
    draw = draw_comparison if (folder / "comparison.json").is_file() else draw_run
    if draw is draw_run and seed is not None:
        raise UserError(f"{folder}: one run has one seed; leave --seed out")
    with tables_of(folder):
        both = draw is draw_comparison
        path = draw_comparison(folder, out, seed) if both else draw_run(folder, out)
    click.echo(path)


def _require_one(folder: Path) -> None:
    """Raise UserError unless a folder is that of a comparison or of one run."""
    from sumo_cohesion.tables.compared import COMPARISON_FILE
    from sumo_cohesion.tables.rollout import RUN_FILE

    if (folder / COMPARISON_FILE).is_file() or (folder / RUN_FILE).is_file():
        return
    wanted = "give a folder that run, compare or batch wrote with --out"
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; {wanted}")
    for file, kind in ((COMPARISON_FILE, "comparisons"), (RUN_FILE, "runs")):
        if found := sorted(path.parent for path in folder.rglob(file)):
            several = f"{len(found)} {kind}" if len(found) > 1 else f"one of the {kind}"
            raise UserError(f"{folder}: {several} lie below; name one, e.g. {found[0]}")
    raise UserError(f"{folder}: no run there; {wanted}")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from None
