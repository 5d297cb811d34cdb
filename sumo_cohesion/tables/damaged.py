"""Saved tables that are not what was written: one line, whatever reading them causes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sumo_cohesion.errors import SimulationError, UserError


@contextmanager
def tables_of(folder: Path) -> Iterator[None]:
    """Context in which saved tables are read or drawn.

    Each is checked where it is read; what passes there and makes no sense in the end, such as a
    column without values or rows of another run, ends here.
    """
    try:
        with warnings.catch_warnings():  # what NumPy says of such values is no help
            warnings.simplefilter("ignore", RuntimeWarning)
            yield
    except (UserError, SimulationError):
        raise
    except Exception as error:
        raise UserError(
            f"{folder}: its tables are not those that were written ({type(error).__name__}: "
            f"{error}); run it again"
        ) from None
