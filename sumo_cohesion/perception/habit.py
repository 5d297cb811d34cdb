"""What a driver does anyway: the variance of its features in its own past.

A driver who has been weaving for ten seconds says little by weaving once more; one who has kept
its lane for ten seconds and now leaves it says a lot.
"""

from __future__ import annotations

from collections import deque

Features = tuple[float, ...]


class Habit:
    """Variance of one driver's features, of values that do not overlap in time.

    Starts as a plain average, in which ``prior`` counts as one value, and goes on as an
    exponentially forgetting one over ``window`` values (Welford 1962; West 1979). The newest
    ``delay`` values do not count yet: they are what the driver is judged by. With a window of
    zero the prior stays.
    """

    __slots__ = ("_mean", "_n", "_newest", "_window", "variance")

    def __init__(self, prior: Features, window: int, delay: int) -> None:
        self.variance = prior
        """Variance of each feature; a new tuple whenever it changes."""
        self._mean: Features = ()
        self._n = 0
        self._window = window
        self._newest: deque[Features] = deque(maxlen=delay + 1)

    def see(self, features: Features) -> None:
        """Take in one value of each feature."""
        if not self._window:
            return
        self._newest.append(features)
        if len(self._newest) < self._newest.maxlen:  # type: ignore[operator]
            return
        values = self._newest[0]
        self._n = n = min(self._n + 1, self._window)
        off = [x - m for x, m in zip(values, self._mean or values, strict=True)]
        self._mean = tuple([x - o + o / n for x, o in zip(values, off, strict=True)])
        share = 1.0 / (n + 1)
        self.variance = tuple(
            [(1.0 - share) * (v + share * o * o) for v, o in zip(self.variance, off, strict=True)]
        )
