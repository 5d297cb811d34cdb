"""What users write: TOML files, names with dots, seeds; mistakes in one line."""

from __future__ import annotations

import difflib
import tomllib
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, SupportsIndex, TypeVar

from pydantic import BaseModel, ValidationError

from sumo_cohesion.errors import UserError

Model = TypeVar("Model", bound=BaseModel)
MOST_SEEDS = 1_000_000
"""Seeds that a text may stand for: a mistake should be a line, not a night of silence."""
_LONGEST = 60
"""Characters of a value that a message repeats."""


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


_SUMO_FILES = {
    ".sumocfg": "SUMO configuration",
    ".net.xml": "SUMO network",
    ".rou.xml": "SUMO route file",
    ".add.xml": "SUMO additional file",
    ".xml": "SUMO file",
}


def refuse_sumo_file(name: str) -> None:
    """Raise UserError if a name is that of one of SUMO's files, and not of one of ours."""
    for suffix, kind in _SUMO_FILES.items():
        if name.removesuffix(".gz").endswith(suffix):
            raise UserError(
                f"{name}: is a {kind}, not a scenario; write a scenario: a .toml file that names "
                "the network, the routes, and where the ego drives (docs/scenarios.md)"
            )


def refuse_other_kind(data: Mapping[str, Any], path: Path, kind: str) -> None:
    """Raise UserError if a file that should be a scenario is an experiment, or the other way."""
    if kind == "scenario" and "scenarios" in data:
        raise UserError(
            f"{path}: is an experiment, not a scenario; do it with sumo-cohesion batch {path}"
        )
    if kind == "experiment" and "network" in data:
        raise UserError(
            f"{path}: is a scenario, not an experiment; drive it with sumo-cohesion run {path}"
        )


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


def split_names(names: str) -> list[str]:
    """Split names at commas, but not within brackets or quotes.

    >>> split_names("nominal, my:Follow(gain=(1, 2), name='a, ('),sumo")
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


def seeds_of(given: object) -> list[int]:
    """Seeds, however they are given: "0:20" (half-open), "3,7,9", a range or a list.

    >>> seeds_of("0:3"), seeds_of("3,7,9"), seeds_of(range(2))
    ([0, 1, 2], [3, 7, 9], [0, 1])

    Raises
    ------
    ValueError
        If they are none; the message says how to write them.
    """
    if isinstance(given, str):
        return _seeds_in(given)
    if isinstance(given, Sized) and len(given) > MOST_SEEDS:
        raise ValueError("more than a million seeds; make several parts")
    if isinstance(given, Iterable):
        return [_whole(value) for value in given]
    number = _whole(given)
    raise ValueError(f"is one number; write [{number}] for it alone, 0:{number} for as many seeds")


def _seeds_in(text: str) -> list[int]:
    try:
        if ":" not in text:
            return [int(part) for part in text.split(",")]
        low, high = (int(part) for part in text.split(":"))
    except ValueError:
        raise ValueError("write 0:20 for 0 to 19, or a list 3,7,9") from None
    if high <= low:
        raise ValueError("is empty; 0:20 means 0 to 19, the end is not included")
    return seeds_of(range(low, high))


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, SupportsIndex):
        raise ValueError(f"{value!r} is no valid integer")
    return value.__index__()


def parse_seeds(given: object, what: str = "--seeds") -> list[int]:
    """Seeds as `seeds_of` reads them; raises UserError, which says ``what`` was wrong."""
    try:
        return seeds_of(given)
    except ValueError as error:
        shown = repr(given)
        shown = _cut(shown)
        raise UserError(f"{what} {shown}: {error}") from None


def refuse_repeats(values: Iterable[object]) -> None:
    """Raise ValueError if a value is listed twice."""
    value, count = next(iter(Counter(values).most_common(1)), (None, 0))
    if count > 1:
        raise ValueError(f"{value} is listed twice")


_KINDS = ("bool", "float", "int", "str")
"""What pydantic adds to a place where a value may be of several kinds: which it was taken for."""
_IN_TOML = {
    "tuple_type": "should be a list, in brackets",
    "list_type": "should be a list, in brackets",
    "dict_type": "should be a table of names and values",
    "model_type": "should be a table of names and values",
}
"""What pydantic says in Python's words, in those of a TOML file."""


def validated(model: type[Model], data: object, where: str) -> Model:
    """Validate data; turn pydantic's report into one line."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        # A misspelt key is also a missing one; name the misspelling. What is one of several kinds
        # is none of them for several reasons; name the one that says most.
        said_first = ("extra_forbidden", "value_error")
        found = sorted(error.errors(), key=lambda e: [e["type"] != kind for kind in said_first])
        first = found[0]
        parts = [str(part) for part in first["loc"]]
        key = ".".join(p for p in parts if p not in _KINDS and not p.startswith("function-"))
        also = {str(e["loc"][0]) for e in found if e["loc"] and e["type"] != "missing"}
        also -= {str(part) for part in first["loc"][:1]}
        rest = f"; look at {', '.join(sorted(also))}, too" if also else ""
        if first["type"] == "extra_forbidden":
            known = _fields_at(model, first["loc"][:-1])
            name = str(first["loc"][-1])
            hint = closest(name, known) or f"; known keys are {', '.join(known)}"
            raise UserError(f"{where}: unknown key {key!r}{hint}{rest}") from None
        said = _IN_TOML.get(first["type"], first["msg"].removeprefix("Value error, "))
        got = first.get("input")
        shown = f" (got {_cut(repr(got))})" if isinstance(got, str | int | float | list) else ""
        prefix = f"{where}: {key}: " if key else f"{where}: "
        raise UserError(prefix + said[:1].lower() + said[1:] + shown + rest) from None


def _cut(text: str) -> str:
    return text if len(text) < _LONGEST else f"{text[:_LONGEST]}..."


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
