"""Load SUMO's libraries, quietly, and understand their complaints."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

from sumo_cohesion.errors import UserError

OLDEST_SUMO = (1, 24)


def load_libsumo() -> Any:
    """Import libsumo, quietly, and check that it is recent enough.

    Raises
    ------
    UserError
        If libsumo is missing or too old.
    """
    try:
        # First, so that it is itself: with the variable below it would become libsumo.
        import traci  # noqa: F401

        with _quiet_import():
            import libsumo
    except ImportError as error:
        raise UserError(f"libsumo cannot be loaded ({error}); pip install libsumo") from None
    version = sumo_version(libsumo)
    if version < OLDEST_SUMO:
        found, least = (".".join(map(str, numbers)) for numbers in (version, OLDEST_SUMO))
        raise UserError(
            f"libsumo {found} is too old; "
            f"pip install --upgrade 'libsumo>={least}' 'sumolib>={least}' 'traci>={least}'"
        )
    return libsumo


@contextlib.contextmanager
def _quiet_import() -> Iterator[None]:
    """Keep libsumo from printing a warning about pyarrow's version, which would spoil --json.

    Its import reads this variable. The two libraries are not used together here.
    """
    before = os.environ.get("LIBSUMO_AS_TRACI")
    os.environ["LIBSUMO_AS_TRACI"] = "quiet"
    try:
        yield
    finally:
        if before is None:
            del os.environ["LIBSUMO_AS_TRACI"]
        else:
            os.environ["LIBSUMO_AS_TRACI"] = before


def vehicle_type_attributes() -> frozenset[str]:
    """Names of SUMO's vType attributes, from the schema that comes with libsumo; empty if none."""
    try:
        schema = resources.files("sumo_data") / "data" / "xsd" / "types" / "route.xsd"
        root = ET.fromstring(schema.read_text(encoding="utf-8"))
    except (ImportError, OSError, ET.ParseError):
        return frozenset()
    xsd = "{http://www.w3.org/2001/XMLSchema}"
    kind = root.find(f"{xsd}complexType[@name='vTypeBaseType']")
    found = () if kind is None else kind.iter(f"{xsd}attribute")
    return frozenset(attribute.get("name", "") for attribute in found)


def sumo_version(libsumo: Any) -> tuple[int, int]:
    """Return SUMO's version as (major, minor), as SUMO itself says it.

    libsumo's ``__version__`` came with 1.26; versions built from source say 1_28 for 1.28.
    """
    found = re.search(r"(\d+)[._](\d+)", libsumo.getVersion()[1])
    return (int(found[1]), int(found[2])) if found else OLDEST_SUMO


def load_window() -> tuple[Any, str]:
    """Return traci, and the path of sumo-gui, which it drives from outside.

    libsumo can show the window too, but does not always come back from closing it.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        raise UserError(
            "--gui needs a screen and DISPLAY is not set; leave --gui out, or write the "
            "scenario with `sumo-cohesion scenario export` and open it elsewhere"
        )
    program = shutil.which("sumo-gui") or shutil.which(
        "sumo-gui", path=str(Path(sys.executable).parent)
    )
    if program is None:
        raise UserError("--gui needs sumo-gui; pip install eclipse-sumo")
    load_libsumo()
    import traci

    return traci, program


@contextlib.contextmanager
def captured_stderr() -> Iterator[Any]:
    """Catch what SUMO's C++ code prints to standard error; yields a function to read it."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as sink:
        kept = os.dup(2)
        os.dup2(sink.fileno(), 2)

        def said() -> str:
            sink.seek(0)
            return sink.read().decode(errors="replace")

        try:
            yield said
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def first_error(text: str) -> str:
    """Return the first line of SUMO's messages that names an error."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("Error")]
    return (errors or lines or [""])[0].removeprefix("Error:").strip()
