"""The two ways a run can go wrong that are not a programming error."""


class UserError(Exception):
    """The user's input is wrong; the message is one line that says what and how to mend it."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class SimulationError(Exception):
    """SUMO did something that would make the results untrue; the message is one line."""


class StorageError(UserError):
    """The disk is full or a folder cannot be written; the message is one line."""


class InputsChangedError(UserError):
    """What decides a run's result is not what it was when the run was planned."""
