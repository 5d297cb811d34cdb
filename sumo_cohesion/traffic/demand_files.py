"""A scenario's route and additional files, as they are read."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from sumo_cohesion.traffic.xml_files import contents, read_with_includes


@dataclass(frozen=True)
class AdditionalFile:
    """An additional file as it was read; ``changed``: it is no longer what lies on the disk."""

    path: Path
    root: ET.Element
    changed: bool = False


@dataclass(frozen=True)
class Demand:
    """What SUMO is given beside the network: all route files as one, and additional files.

    ``source`` says where the routes come from, for messages.
    """

    routes: ET.Element
    additional: tuple[AdditionalFile, ...] = ()
    source: str = "route files"

    def roots(self) -> tuple[ET.Element, ...]:
        """All there is, in the order in which SUMO reads it: additional files come first."""
        return (*(file.root for file in self.additional), self.routes)


def read_demand(route_files: Iterable[Path], additional: Iterable[Path] = ()) -> Demand:
    """Read route and additional files, with what they include.

    Raises
    ------
    UserError
        If one is missing, unreadable, not well-formed or of another kind.
    """
    merged, paths = ET.Element("routes"), list(route_files)
    for path in paths:
        merged.extend(contents(read_with_includes(path)))
    files = []
    for path in additional:
        root = ET.Element("additional")
        root.extend(contents(read_with_includes(path)))
        files.append(AdditionalFile(path, root))
    return Demand(merged, tuple(files), ", ".join(map(str, paths)))
