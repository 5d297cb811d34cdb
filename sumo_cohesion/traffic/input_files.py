"""The files of one run: what SUMO is given, and where it writes.

SUMO looks for what a file names beside that file, and writes there, too: two runs at once would
write the same files. It splits lists of names at commas, wherever the comma is.
"""

from __future__ import annotations

import contextlib
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from sumo_cohesion.traffic.demand_files import AdditionalFile, Demand
from sumo_cohesion.traffic.xml_files import named_files

DEMAND_FILE = "demand.rou.xml"
OUTPUT_FOLDER = "outputs"


class InputFiles(NamedTuple):
    """Files that SUMO is started with.

    ``outputs`` is the folder where SUMO writes what additional files ask for; None if nothing.
    """

    network: Path
    demand: Path
    additional: tuple[Path, ...]
    outputs: Path | None


def write_input_files(demand: Demand, network: Path, folder: Path) -> InputFiles:
    """Write into a folder what cannot be left where it lies, and redirect outputs into it.

    Additional files that write nothing stay the user's own, and so does the network, unless a
    comma is in the way.
    """
    outputs = folder / OUTPUT_FOLDER
    names = _Names()
    writers = _redirected(demand, lambda path: str(outputs / names.of(path)))
    if writers:
        outputs.mkdir(exist_ok=True)
    additional = []
    for i, file in enumerate(demand.additional):
        if file.changed or file.root in writers or "," in str(file.path):
            additional.append(_write(file.root, folder / f"additional_{i}.add.xml"))
        else:
            additional.append(file.path)
    if "," in str(network):
        suffix = ".net.xml.gz" if network.suffix == ".gz" else ".net.xml"
        network = _link(network, folder / f"network{suffix}")
    routes = write_demand(demand, folder)
    return InputFiles(network, routes, tuple(additional), outputs if writers else None)


def write_portable_files(demand: Demand, network: Path, folder: Path) -> InputFiles:
    """Write all that a run needs into a folder that can be moved; outputs will be beside it."""
    names = _Names([DEMAND_FILE])
    copied = folder / names.of(network)
    shutil.copyfile(network, copied)
    additional = [_beside(file, folder, names) for file in demand.additional]
    for root in demand.roots():
        for named in named_files(root):
            if not named.written and named.path.is_file():
                name = names.of(named.path)
                if not (folder / name).exists():
                    shutil.copyfile(named.path, folder / name)
                named.rename(name)
    _redirected(demand, names.of)
    for file, path in zip(demand.additional, additional, strict=True):
        _write(file.root, path)
    return InputFiles(copied, write_demand(demand, folder), tuple(additional), None)


def _beside(file: AdditionalFile, folder: Path, names: _Names) -> Path:
    return folder / names.of(file.path, file.path.name.removesuffix(".gz"))


def write_demand(demand: Demand, folder: Path) -> Path:
    """Write a demand's routes and return the file's path."""
    ET.indent(demand.routes)
    return _write(demand.routes, folder / DEMAND_FILE)


def _write(root: ET.Element, path: Path) -> Path:
    ET.ElementTree(root).write(path, encoding="UTF-8", xml_declaration=True)
    return path


def _redirected(demand: Demand, new_name: Callable[[Path], str]) -> set[ET.Element]:
    """Rename what SUMO is to write; returns the roots below which something was renamed."""
    changed = set()
    for root in demand.roots():
        for named in named_files(root):
            if named.written:
                named.rename(new_name(named.path))
                changed.add(root)
    return changed


class _Names:
    """Names in one folder: a name of its own for each file, without what SUMO stumbles over."""

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self._taken = set(taken)
        self._names: dict[Path, str] = {}

    def of(self, path: Path, wanted: str = "") -> str:
        """Name of a file, always the same; as it is called, or as it is wanted to be."""
        if path not in self._names:
            plain = (wanted or path.name).replace(",", "_").replace("%", "_")
            stem, dot, suffix = plain.partition(".")
            name, count = plain, 1
            while name in self._taken:
                count += 1
                name = f"{stem}_{count}{dot}{suffix}"
            self._taken.add(name)
            self._names[path] = name
        return self._names[path]


def _link(path: Path, link: Path) -> Path:
    """Link to a file by another name, or copy it where links cannot be made."""
    link.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        link.symlink_to(path.resolve())
        return link
    shutil.copyfile(path, link)
    return link
