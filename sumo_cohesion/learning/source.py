"""Where examples are cut from: something that remembers its driving until it is asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from sumo_cohesion.learning.example import Example
from sumo_cohesion.learning.recording import Recording
from sumo_cohesion.learning.tracks import Cutting, cut

Kind = Literal["plans", "driven", "humans"]
"""Whose driving: a planner's plans, what it drove, or the humans around it."""


class Source(Protocol):
    """One run or one file."""

    @property
    def name(self) -> str:
        """Of the run or file, for messages."""

    def examples(self, how: Cutting) -> Sequence[Example]:
        """Cut its driving into examples."""


@dataclass(frozen=True)
class Tracks:
    """A recording whose vehicles demonstrate."""

    recording: Recording

    @property
    def name(self) -> str:
        """Of the file."""
        return self.recording.name

    def examples(self, how: Cutting) -> Sequence[Example]:
        """Cut every vehicle's track."""
        return cut(self.recording, how)
