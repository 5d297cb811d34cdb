"""Folders of results: written whole or not at all, and nothing of a user's is touched."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from sumo_cohesion.errors import UserError


def require_replaceable(folder: Path, marker: str) -> None:
    """Raise UserError unless a folder is new, empty, or an earlier result (holds ``marker``)."""
    if not folder.exists():
        return
    if not folder.is_dir() or (any(folder.iterdir()) and not (folder / marker).is_file()):
        raise UserError(
            f"{folder}: holds something else than an earlier result; choose another --out"
        )


def require_writable(folder: Path) -> None:
    """Raise UserError unless a result can be written to a folder; its parents are made."""
    _new_sibling(folder).rmdir()


def _new_sibling(folder: Path) -> Path:
    """Make a hidden folder beside one that may not be there yet."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise UserError(
            f"{folder}: cannot write there ({error.strerror}); choose another --out"
        ) from None


class whole_folder:  # noqa: N801 - reads as a function where it is used
    """Context: write into a temporary sibling that replaces ``folder`` only if all went well."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __enter__(self) -> Path:
        self._new = _new_sibling(self._folder)
        self._new.chmod(0o755)
        return self._new

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        if kind is None:
            old = self._new.with_name(self._new.name + "-old")
            if self._folder.exists():
                self._folder.rename(old)
            self._new.rename(self._folder)
            shutil.rmtree(old, ignore_errors=True)
            return
        shutil.rmtree(self._new, ignore_errors=True)
        if isinstance(error, OSError):
            raise UserError(
                f"{self._folder}: cannot write there ({error.strerror or error}); "
                "free some space or choose another --out"
            ) from None
