"""SUMO's own outputs of a run, as tables: floating car data, trips, safety surrogate measures.

https://sumo.dlr.de/docs/Simulation/Output/index.html
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pandas as pd

Output = Literal["fcd", "tripinfo", "ssm"]
_TEXT = {"id", "type", "vType", "lane", "departLane", "arrivalLane", "devices", "vaporized"}
_TEXT |= {"ego", "foe"}


@dataclass(frozen=True)
class SumoOutputs:
    """Which outputs SUMO is to write, and where."""

    kinds: tuple[Output, ...]
    folder: Path

    def options(self) -> dict[str, object]:
        """SUMO's options for them. Every vehicle gets an SSM device if ``ssm`` is asked for."""
        options: dict[str, object] = {}
        if "fcd" in self.kinds:
            options["fcd-output"] = self._file("fcd")
        if "tripinfo" in self.kinds:
            options["tripinfo-output"] = self._file("tripinfo")
            # The ego, and all who are still on the road at the end.
            options["tripinfo-output.write-unfinished"] = "true"
        if "ssm" in self.kinds:
            options["device.ssm.probability"] = 1
            options["device.ssm.file"] = self._file("ssm")
        return options

    def _file(self, kind: Output) -> Path:
        return self.folder / f"{kind}.xml"

    def read(self) -> dict[str, pd.DataFrame]:
        """Read what SUMO has written; names and units are SUMO's own.

        SUMO stamps the state after a step with the time the step began: its t is t + 0.1 s of a
        run's own tables. One row is, in fcd, a vehicle at a time step; in tripinfo, a vehicle; in
        ssm, an encounter of two, with each measure's extreme as ``minTTC_value``,
        ``minTTC_time`` and ``minTTC_type``.
        """
        return {kind: _table(_ROWS[kind](self._file(kind)), _ALWAYS[kind]) for kind in self.kinds}


def _table(rows: Iterator[dict[str, str]], always: Sequence[str]) -> pd.DataFrame:
    found = list(rows)
    frame = pd.DataFrame(found) if found else pd.DataFrame(columns=list(always))
    for name in frame.columns:
        if name in _TEXT:
            frame[name] = frame[name].astype("string")
            continue
        values = frame[name].replace({"NA": None, "": None})
        try:
            frame[name] = pd.to_numeric(values)
        except (ValueError, TypeError):
            frame[name] = values.astype("string")  # a place is two numbers
    return frame


def _elements(path: Path, tags: Sequence[str]) -> Iterator[ET.Element]:
    """Elements of these tags, each thrown away after use: outputs are long."""
    if not path.is_file():
        return
    for _, element in ET.iterparse(path):
        if element.tag in tags:
            yield element
            element.clear()


def _fcd(path: Path) -> Iterator[dict[str, str]]:
    for step in _elements(path, ["timestep"]):
        for vehicle in step.iter("vehicle"):
            yield {"time": step.get("time", ""), **vehicle.attrib}


def _tripinfo(path: Path) -> Iterator[dict[str, str]]:
    for trip in _elements(path, ["tripinfo"]):
        yield dict(trip.attrib)


def _ssm(path: Path) -> Iterator[dict[str, str]]:
    for conflict in _elements(path, ["conflict"]):
        row = dict(conflict.attrib)
        for measure in conflict:
            if "value" in measure.attrib:  # the spans and series per time step stay behind
                row[f"{measure.tag}_value"] = measure.attrib["value"]
                row[f"{measure.tag}_time"] = measure.get("time", "")
                row[f"{measure.tag}_type"] = measure.get("type", "")
        yield row


_ALWAYS: dict[Output, Sequence[str]] = {
    "fcd": ("time", "id", "x", "y", "angle", "speed", "lane"),
    "tripinfo": ("id", "depart", "arrival", "duration", "timeLoss"),
    "ssm": ("begin", "end", "ego", "foe"),
}
"""Columns of a table without rows."""
_ROWS: dict[Output, Callable[[Path], Iterator[dict[str, str]]]] = {
    "fcd": _fcd,
    "tripinfo": _tripinfo,
    "ssm": _ssm,
}
