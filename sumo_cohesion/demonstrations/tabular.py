"""Files of rows and columns: CSV, gzipped or not, with commas, semicolons or tabs, and Parquet."""

from __future__ import annotations

import gzip
import warnings
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
from pyarrow import parquet

from sumo_cohesion.errors import UserError

SUFFIXES = (".csv", ".csv.gz", ".parquet")
_NO_NUMBER = ["", "nan", "NaN", "NA"]


def column_names(path: Path) -> list[str]:
    """Names of a file's columns.

    Raises
    ------
    UserError
        If the file cannot be read.
    """
    return list(_schema(path).names) if path.suffix == ".parquet" else _header(path)[0]


def read_table(path: Path, text: Collection[str]) -> pd.DataFrame:
    """Read a file of rows and columns as it stands.

    ``text`` are the columns that are no numbers.

    Raises
    ------
    UserError
        If the file cannot be read.
    """
    if path.suffix == ".parquet":
        with _sound_parquet(path):
            return pd.read_parquet(path)
    columns, separator = _header(path)
    if len(columns) != len(set(columns)):
        raise UserError(f"{path}: two columns have one name; its columns are {', '.join(columns)}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            return pd.read_csv(
                path,
                sep=separator,
                header=0,
                names=columns,
                index_col=False,
                encoding="utf-8-sig",
                dtype={name: str for name in columns if name in text},
                keep_default_na=False,
                na_values={name: _NO_NUMBER for name in columns if name not in text},
            )
    except pd.errors.ParserWarning:
        raise UserError(
            f"{path}: its rows have more values than there are columns; write decimal points, "
            "not commas"
        ) from None
    except (ValueError, EOFError, OSError, zlib.error) as error:  # pandas' errors are ValueErrors
        raise UserError(f"{path}: cannot be read as CSV ({error}); write it again") from None


def _schema(path: Path) -> Any:
    with _sound_parquet(path):
        return parquet.read_schema(path)


@contextmanager
def _sound_parquet(path: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise UserError(f"{path}: cannot be read (no such file)") from None
    except Exception as error:
        # pyarrow raises whatever a damaged file happens to cause.
        raise UserError(f"{path}: is no sound Parquet file ({error}); write it again") from None


def _header(path: Path) -> tuple[list[str], str]:
    """Names of a CSV file's columns, and what is between them."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            line = file.readline().decode("utf-8-sig").strip()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, EOFError, zlib.error) as error:
        raise UserError(f"{path}: damaged, or not UTF-8 text ({error}); write it again") from None
    separator = max(",;\t", key=line.count)
    return [name.strip().strip('"') for name in line.split(separator)], separator
