"""What a driver does anyway: the variance of its features in its own past.

A driver who has been weaving for ten seconds says little by weaving once more; one who has kept
its lane for ten seconds and now leaves it says a lot.
"""

from __future__ import annotations

from collections.abc import Sequence

Features = tuple[float, ...]


class Habit:
    """Running mean and variance of one driver's features.

    Starts as a plain average, in which ``prior`` counts as one value, and goes on as an
    exponentially forgetting one over ``window`` values (Welford 1962; West 1979). What is newer
    than ``delay`` values does not count yet: it is what the driver is judged by.
    """

    __slots__ = ("_delay", "_every", "_mean", "_n", "_rest", "_window", "variance")

    def __init__(self, prior: Features, window: int, delay: int, every: int) -> None:
        self.variance = prior
        """Variance of each feature."""
        self._mean: Features = ()
        self._n = 0
        self._rest = 0
        self._window = window
        self._delay = delay
        self._every = every

    def see(self, features: Sequence[Features]) -> None:
        """Take in a driver's features, newest last; every ``every``-th one counts."""
        self._rest += 1
        if self._rest < self._every or len(features) <= self._delay:
            return
        self._rest = 0
        values = features[-1 - self._delay]
        self._n += 1
        if not self._mean:
            self._mean = values
        n = min(self._n, self._window)
        share = 1.0 / (n + 1)
        gain = 1.0 / n
        off = [value - m for value, m in zip(values, self._mean, strict=True)]
        self._mean = tuple([m + gain * o for m, o in zip(self._mean, off, strict=True)])
        self.variance = tuple(
            [(1.0 - share) * (v + share * o * o) for v, o in zip(self.variance, off, strict=True)]
        )
