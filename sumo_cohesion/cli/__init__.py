"""The command line. Everything it does is one call in Python."""

from __future__ import annotations

import os
import sys
import traceback

# The matrices here are tiny; threads of the linear algebra library would only cost time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import click

from sumo_cohesion.cli import about, batches, learning, results, running, scenarios, tuning
from sumo_cohesion.cli.options import Asked
from sumo_cohesion.errors import SimulationError, UserError


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="sumo-cohesion")
def app() -> None:
    """Socially cohesive driving in SUMO: an ego car that follows what nearby humans agree on."""


for _command in (
    scenarios.scenarios,
    running.run,
    running.compare,
    batches.run_batch,
    tuning.tune,
    learning.learn,
    results.metrics,
    results.figure,
    scenarios.scenario,
    about.info,
):
    app.add_command(_command)


def main() -> None:
    """Entry point: 0 done, 2 the user's input is wrong, 1 anything else; always one line."""
    asked = Asked()
    try:
        app(prog_name="sumo-cohesion", standalone_mode=False, obj=asked)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.exceptions.NoArgsIsHelpError as stop:
        click.echo(stop.ctx.get_help() if stop.ctx else "")
        sys.exit(2)
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "sumo-cohesion"
        _fail(f"{error.format_message()} ({command} --help)", 2)
    except UserError as error:
        _fail(_told(error, asked), 2)
    except SimulationError as error:
        _fail(_told(error, asked), 1)
    except (KeyboardInterrupt, click.Abort):
        _fail("interrupted", 1)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(1)


def _told(error: Exception, asked: Asked) -> str:
    """Return an error's line, and show whose code raised where that was asked for."""
    origin = _origin(error)
    if asked.traceback is None or not origin:
        return str(error)
    if not asked.traceback:
        return f"{error}; --traceback shows all of it"
    click.echo(origin, err=True)
    return str(error)


def _origin(error: BaseException | None) -> str:
    """Traceback of somebody's code that raised, here or in a process that notes it; or nothing."""
    while error is not None:
        if notes := getattr(error, "__notes__", None):
            return str(notes[-1])
        if not isinstance(error, UserError | SimulationError | KeyboardInterrupt):
            return "".join(traceback.format_exception(error))
        error = error.__cause__
    return ""


def _fail(message: str, status: int) -> None:
    click.echo("error: " + " ".join(message.split()), err=True)
    sys.exit(status)
