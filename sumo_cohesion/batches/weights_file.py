"""A user's file of reward weights, into which beta is written; whatever else is in it stays."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import tomllib
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sumo_cohesion.errors import StorageError, UserError
from sumo_cohesion.user_input import merge, read_toml

_MARK = "# by tune: "
"""After a beta that may be replaced: nobody else wrote it."""
_OURS = re.compile(rf"^[ \t]*beta[ \t]*=[^#\n]*{_MARK}[^\r\n]*", re.MULTILINE)
_HEADER = re.compile(r"^[ \t]*\[[ \t]*cohesion[ \t]*\][^\r\n]*", re.MULTILINE)


@dataclass(frozen=True)
class WeightsFile:
    """A file as it was read: beta belongs to these weights."""

    path: Path
    content: bytes

    @classmethod
    def read(cls, path: Path) -> WeightsFile:
        """Read it; raises UserError if it cannot be read, or beta could not be written into it."""
        read_toml(path)
        file = cls(path, path.read_bytes())
        file.with_beta(1.0, "")
        real = path.resolve()
        if not (os.access(real, os.W_OK) and os.access(real.parent, os.W_OK)):
            raise UserError(f"{path}: cannot be written, and beta is written into it; make a copy")
        return file

    def with_beta(self, beta: float, said: str) -> bytes:
        """Return its content with a beta, and beside it how it was found."""
        text = self.content.decode("utf-8")
        before = _parsed(text)
        there = before.get("cohesion", {})
        end = "\r\n" if "\r\n" in text else "\n"
        # A comment in TOML holds no control characters; a file's name in it may.
        comment = "".join(c if c.isprintable() else " " for c in said)
        line = f"beta = {beta!r}  {_MARK}{comment}"
        if isinstance(there, Mapping) and "beta" in there:
            if not _OURS.search(text):
                raise UserError(
                    f"{self.path}: has a cohesion.beta that is not of tune; take it out to have it "
                    "tuned"
                )
            new = _OURS.sub(lambda _: line, text, count=1)
        elif header := _HEADER.search(text):
            new = f"{text[: header.end()]}{end}{line}{text[header.end() :]}"
        else:
            gap = end if not text or text.endswith("\n") else end * 2
            new = f"{text}{gap}[cohesion]{end}{line}{end}"
        # Looked at before it is written: what a line means in TOML depends on those before it.
        with contextlib.suppress(tomllib.TOMLDecodeError, UserError):
            if _same(_parsed(new), merge(before, {"cohesion.beta": beta})):
                return new.encode("utf-8")
        raise UserError(f"{self.path}: write its settings of cohesion as a table: [cohesion]")

    def write_beta(self, beta: float, said: str) -> None:
        """Write a beta into the file, all of it or nothing; raises UserError if it has changed."""
        found = f"beta = {beta:g} ({said})"
        real = self.path.resolve()
        new = real.with_name(f".{real.name}.{uuid.uuid4().hex}.new")
        try:
            if real.read_bytes() != self.content:
                raise UserError(f"{self.path}: has changed while it was tuned; before: {found}")
            try:
                new.write_bytes(self.with_beta(beta, said))
                shutil.copymode(real, new)
                new.replace(real)
            finally:
                new.unlink(missing_ok=True)
        except OSError as error:
            raise StorageError(
                f"{self.path}: cannot be written ({error.strerror or error}); found: {found}"
            ) from None


def _parsed(text: str) -> dict[str, Any]:
    return tomllib.loads(text.removeprefix("\ufeff"))


def _same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Tell whether two files say the same; NaN, too, equals itself."""
    a, b = (json.dumps(data, sort_keys=True, default=str) for data in (one, other))
    return a == b
