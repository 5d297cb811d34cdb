"""One column of a table: declared once, where what fills it is."""

from __future__ import annotations

from typing import NamedTuple


class Column(NamedTuple):
    """One column of a table.

    A name that ends in a star stands for every column whose name begins so.
    """

    name: str
    dtype: str
    unit: str
    meaning: str
