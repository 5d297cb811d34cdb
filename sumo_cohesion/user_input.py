"""What users write: TOML files, names with dots, seeds; mistakes in one line."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from sumo_cohesion.errors import UserError

Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a user's TOML file; raises UserError if it cannot be."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid TOML: {error}") from None
    except ValueError as error:
        raise UserError(f"{str(path)!r}: not a file's name ({error})") from None


def merge(data: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Put values into a nested mapping by dotted name; the input is left alone.

    >>> merge({"ego": {"lane": 0}}, {"ego.speed": 20.0})
    {'ego': {'lane': 0, 'speed': 20.0}}
    """
    result = {k: dict(v) if isinstance(v, Mapping) else v for k, v in data.items()}
    for name, value in overrides.items():
        head, _, tail = name.partition(".")
        if not tail:
            result[head] = value
            continue
        inner = result.get(head, {})
        if not isinstance(inner, Mapping):
            raise UserError(f"{name}: {head!r} is a value and has no key {tail!r}")
        result[head] = merge(inner, {tail: value})
    return result


def parse_override(text: str, texts: Collection[str] = ()) -> tuple[str, Any]:
    """Parse ``name=value``, the value as in TOML; a bare word is a string.

    ``texts`` are names whose value is a string in any case, quoted or as it stands.

    >>> parse_override("cohesion.beta=0.05")
    ('cohesion.beta', 0.05)
    >>> parse_override("planner.solver=ipopt")
    ('planner.solver', 'ipopt')
    >>> parse_override("ego.origin=123#0", {"ego.origin"})
    ('ego.origin', '123#0')
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise UserError(f"--set {text!r}: write it as name=value, e.g. cohesion.beta=0.05")
    try:
        # In brackets, so that nothing is taken for a comment.
        parsed, *more = tomllib.loads(f"value = [{value}]")["value"]
    except (tomllib.TOMLDecodeError, ValueError):
        return name.strip(), value.strip()
    as_it_stands = more or (name.strip() in texts and not isinstance(parsed, str))
    return name.strip(), value.strip() if as_it_stands else parsed


def text_settings(model: type[BaseModel], group: str = "") -> set[str]:
    """Dotted names of a model's settings that are strings."""
    names = set()
    for name, field in model.model_fields.items():
        kind = field.annotation
        if kind is str:
            names.add(group + name)
        elif isinstance(kind, type) and issubclass(kind, BaseModel):
            names |= text_settings(kind, f"{group}{name}.")
    return names


def split_planners(names: str) -> list[str]:
    """Split names at commas, but not within brackets or quotes.

    >>> split_planners("nominal, my:Follow(gain=(1, 2), name='a, ('),sumo")
    ['nominal', "my:Follow(gain=(1, 2), name='a, (')", 'sumo']
    """
    parts, depth, quote = [""], 0, ""
    for character in names:
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        else:
            depth += (character in "([{") - (character in ")]}")
        if character == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts if part.strip()]


def parse_seeds(text: str, what: str = "--seeds") -> list[int]:
    """Parse "0:20" (half-open) or "3,7,9".

    >>> parse_seeds("0:3"), parse_seeds("3,7,9")
    ([0, 1, 2], [3, 7, 9])
    """
    try:
        if ":" in text:
            low, high = (int(part) for part in text.split(":"))
            if high - low > 1_000_000:
                raise UserError(f"{what} {text!r}: more than a million seeds; make several parts")
            seeds = list(range(low, high))
        else:
            seeds = [int(part) for part in text.split(",")]
    except ValueError:
        raise UserError(f"{what} {text!r}: write 0:20 for 0 to 19, or a list 3,7,9") from None
    if not seeds:
        raise UserError(f"{what} {text!r} is empty; 0:20 means 0 to 19, the end is not included")
    return seeds


def validated(model: type[Model], data: object, where: str) -> Model:
    """Validate data; turn pydantic's report into one line."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        # A misspelt key is also a missing one; name the misspelling.
        first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = _fields_at(model, first["loc"][:-1])
            name = str(first["loc"][-1])
            hint = closest(name, known) or f"; known keys are {', '.join(known)}"
            raise UserError(f"{where}: unknown key {key!r}{hint}") from None
        said = first["msg"].removeprefix("Value error, ")
        got = first.get("input")
        shown = f" (got {got!r})" if isinstance(got, str | int | float | bool | list) else ""
        prefix = f"{where}: {key}: " if key else f"{where}: "
        raise UserError(prefix + said[:1].lower() + said[1:] + shown) from None


def _fields_at(model: type[BaseModel], loc: Sequence[int | str]) -> list[str]:
    """Names of the fields of the sub-model that a validation error's location points to."""
    for part in loc:
        inner = model.model_fields.get(str(part))
        kind = inner.annotation if inner is not None else None
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            model = kind
    return list(model.model_fields)


def closest(name: str, known: Sequence[str]) -> str:
    """Suggest what is spelt like a name, as the end of a message; empty if nothing is."""
    found = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {found[0]!r}?" if found else ""
