"""The two ways a run can go wrong that are not a programming error."""

from __future__ import annotations

from typing import Self


class UserError(Exception):
    """The user's input is wrong; the message is one line that says what and how to mend it."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class _EndedError(Exception):
    """A run's end amid its steps.

    ``rollout`` is the record of the run until then (tables.rollout.Rollout), if there is any.
    """

    rollout: object = None

    def __reduce__(self) -> tuple[object, ...]:
        # To another process goes what it says, without the tables.
        kept = {key: value for key, value in vars(self).items() if key != "rollout"}
        return type(self), self.args, kept

    def said(self, more: str) -> Self:
        """Return the same error, with more to say."""
        error = type(self)(f"{self}; {more}")
        error.rollout = self.rollout
        return error


class SimulationError(_EndedError):
    """SUMO did something that would make the results untrue; the message is one line."""


class StoppedError(UserError, _EndedError):
    """SUMO stopped in the middle of a run, over something in its input that it met only then."""


class StorageError(UserError):
    """The disk is full or a folder cannot be written; the message is one line."""


class InputsChangedError(UserError):
    """What decides a run's result is not what it was when the run was planned."""
