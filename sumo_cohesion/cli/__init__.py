"""The command line. Everything it does is one call in Python."""

from __future__ import annotations

import os
import sys

# The matrices here are tiny; threads of the linear algebra library would only cost time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import click

from sumo_cohesion.cli import batches, results, running, scenarios
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
    results.metrics,
    results.figure,
    scenarios.scenario,
):
    app.add_command(_command)


def main() -> None:
    """Entry point: 0 done, 2 the user's input is wrong, 1 anything else; always one line."""
    try:
        app(standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.exceptions.NoArgsIsHelpError as stop:
        click.echo(stop.ctx.get_help() if stop.ctx else "")
        sys.exit(2)
    except click.ClickException as error:
        _fail(f"{error.format_message()} (sumo-cohesion --help)", 2)
    except UserError as error:
        _fail(str(error), 2)
    except SimulationError as error:
        _fail(str(error), 1)
    except (KeyboardInterrupt, click.Abort):
        _fail("interrupted", 1)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(1)


def _fail(message: str, status: int) -> None:
    click.echo("error: " + " ".join(message.split()), err=True)
    sys.exit(status)
