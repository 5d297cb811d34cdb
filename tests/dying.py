"""The command line in a process that kills itself and its group at a given moment.

    python -m tests.dying MODULE:NAME NUMBER batch FILE --out DIR

It dies as soon as the function of this name has returned for the NUMBER-th time.
"""

from __future__ import annotations

import os
import signal
import sys
from functools import reduce
from importlib import import_module
from itertools import count
from typing import Any

from sumo_cohesion import cli


def die_after(function: str, number: int) -> None:
    """Replace a function, ``module:name`` or ``module:Class.name``, by one that kills."""
    module, _, path = function.partition(":")
    *owners, name = path.split(".")
    owner = reduce(getattr, owners, import_module(module))
    real, calls = getattr(owner, name), count(1)

    def deadly(*args: Any, **kwargs: Any) -> Any:
        result = real(*args, **kwargs)
        if next(calls) == number:
            os.killpg(0, signal.SIGKILL)
        return result

    setattr(owner, name, deadly)


if __name__ == "__main__":
    die_after(sys.argv[1], int(sys.argv[2]))
    sys.argv[1:3] = []
    cli.main()
