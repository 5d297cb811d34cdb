"""Read a file of driving, whatever kind of file it is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sumo_cohesion.demonstrations.commonroad import read_commonroad
from sumo_cohesion.demonstrations.fcd import read_fcd
from sumo_cohesion.demonstrations.table import REQUIRED, read_csv
from sumo_cohesion.demonstrations.tabular import SUFFIXES, column_names
from sumo_cohesion.errors import UserError
from sumo_cohesion.learning.recording import Recording
from sumo_cohesion.traffic.network import Network
from sumo_cohesion.traffic.xml_files import root_of

KINDS = (
    "SUMO's floating car data (XML, CSV, Parquet), a table (CSV, Parquet) with the columns "
    f"{', '.join(REQUIRED)}, or a CommonRoad scene (XML)"
)
"""The files that can be read."""


def read(path: Path, network: Network | None = None, demand: Sequence[Path] = ()) -> Recording:
    """Read a file of one of KINDS.

    Parameters
    ----------
    path : the file.
    network : that was driven on; CommonRoad's scenes bring their own.
    demand : route and additional files with the types of SUMO's vehicles, which tell their sizes.

    Raises
    ------
    UserError
        If it is of no such kind, or cannot be read.
    """
    kind = _kind(path)
    if kind == "commonroad":
        return read_commonroad(path)
    if network is None:
        raise UserError(f"{path}: name the SUMO network that was driven on: --network FILE.net.xml")
    return read_fcd(path, network, demand) if kind == "fcd" else read_csv(path, network)


def _kind(path: Path) -> str:
    """Tell the kind of a file by its name and by how it begins."""
    name = path.name.lower()
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a file: {KINDS}")
    if name.endswith((".xml", ".xml.gz")):
        root = root_of(path)
        kinds = {"fcd-export": "fcd", "commonRoad": "commonroad"}
        if root not in kinds:
            raise UserError(f"{path}: its root element is <{root}>; what can be read is {KINDS}")
        return kinds[root]
    if name.endswith(SUFFIXES):
        return "fcd" if "vehicle_id" in column_names(path) else "table"
    raise UserError(f"{path}: not a kind of file that can be read, which are {KINDS}")
