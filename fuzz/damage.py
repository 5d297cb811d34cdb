"""Ways to damage a file: its values, its structure, its bytes."""

from __future__ import annotations

import io
import json
import random
import re
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

NUMBERS = (
    "", " ", "nan", "inf", "-inf", "0", "-0.0", "-1", "1", "2", "7", "0.5", "1e-9", "1e-300",
    "1e9", "1e20", "-1e20", "1e308", "1e999", "2147483648", "99999999999999999999", "0x10", "1,5",
    "1.5.2", "true", "ü", "\u2028", "None",
)  # fmt: skip
"""Texts in the place of a number, or of anything."""
_TOML = (
    "nan", "inf", "-inf", "0", "-1", "1", "7", "1e-300", "1e20", "1e308", "2147483648", "1.5",
    "99999999999999999999", '""', '"x"', "true", "false", "[]", "[[]]", "{}", "[1, 2]", '["x"]',
    "1979-05-27", '"ü"', '"../mine.toml"', '"."', '"/"', "'\\n'", '"\\u0000"', '"nan"',
)  # fmt: skip
_BORDERS = re.compile(r"[\s,:]+")


def damage(name: str, data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """Damage a file by its kind; return its new content and what was done."""
    kind = name.rpartition(".")[2]
    ways: list[Callable[[bytes, random.Random], tuple[bytes, str]]] = [_bytes]
    ways += {
        "xml": [_xml] * 9,
        "toml": [_toml] * 6,
        "json": [_json] * 4,
        "parquet": [_table] * 4,
        "csv": [],
    }[kind]
    new, what = rng.choice(ways)(data, rng)
    return new, f"{name}: {what}"


def _bytes(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    at = rng.randrange(len(data) + 1)
    way = rng.choice(("cut", "flip", "insert", "drop", "empty", "utf-16", "latin-1", "bom"))
    if way == "cut":
        return data[:at], f"cut off after {at} bytes"
    if way == "flip":
        new = bytearray(data)
        for _ in range(rng.choice((1, 4, 32))):
            if new:
                new[rng.randrange(len(new))] = rng.randrange(256)
        return bytes(new), "some bytes are others"
    if way == "insert":
        some = rng.choice((b"\0", b"\xff\xfe", b"<", b"&", b'"', b"\xc3", b"]]>", b"\r", b"<!--"))
        return data[:at] + some + data[at:], f"{some!r} at byte {at}"
    if way == "drop":
        return data[:at] + data[at + rng.choice((1, 10, 100)) :], f"some bytes gone at {at}"
    if way == "bom":
        return b"\xef\xbb\xbf" + data, "a byte order mark"
    if way == "empty":
        return b"", "empty"
    try:
        return data.decode().replace("human", "hümän").encode(way), f"in {way}"
    except UnicodeError:
        return b"\0" + data, "a zero first"


def _xml(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    try:
        root = ET.fromstring(data)
    except ET.ParseError:
        return _bytes(data, rng)
    parents = {child: parent for parent in root.iter() for child in parent}
    # Each tag as often as any other, so that the rare are not lost among the many.
    tag = rng.choice(sorted({element.tag for element in root.iter()}))
    element = rng.choice([e for e in root.iter() if e.tag == tag])
    of = f"<{tag} {element.get('id') or element.get('from') or element.get('index') or ''}>"
    way = rng.choice(("value",) * 8 + ("structure",) * 4 + ("attribute",) * 2)
    if way == "structure" and element in parents:
        what = _restructure(element, parents[element], root, parents, rng)
    elif way == "attribute" or not element.attrib:
        what = _attribute(element, rng)
    else:
        key = rng.choice(sorted(element.attrib))
        value = _other_value(element.attrib[key], key, root, rng)
        what = f"{key} {element.attrib[key][:40]!r} -> {value[:60]!r}"
        element.set(key, value)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True), f"{of}: {what}"


def _restructure(
    element: ET.Element,
    parent: ET.Element,
    root: ET.Element,
    parents: dict[ET.Element, ET.Element],
    rng: random.Random,
) -> str:
    way = rng.choice(("remove", "remove", "repeat", "swap", "move", "empty", "remove all"))
    if way == "remove":
        parent.remove(element)
    elif way == "repeat":
        parent.insert(rng.randrange(len(parent) + 1), element)
    elif way == "swap":
        other = rng.choice([e for e in parents if e.tag == element.tag])
        element.attrib, other.attrib = other.attrib, element.attrib
    elif way == "move":
        parent.remove(element)
        root.insert(rng.randrange(len(root) + 1), element)
    elif way == "empty":
        del element[:]
    else:
        for other in [e for e in parent if e.tag == element.tag]:
            parent.remove(other)
    return way


def _attribute(element: ET.Element, rng: random.Random) -> str:
    if not element.attrib:
        element.set("id", "x")
        return "id = 'x'"
    key = rng.choice(sorted(element.attrib))
    if rng.random() < 0.7:
        del element.attrib[key]
        return f"no {key}"
    element.set(key + "s", element.attrib.pop(key))
    return f"{key} is {key}s"


def _other_value(value: str, key: str, root: ET.Element, rng: random.Random) -> str:
    way = rng.choice(("number", "number", "item", "item", "scale", "like", "any", "break"))
    parts = _BORDERS.split(value)
    if way == "item" and len(parts) > 1:  # one number or name of a list
        at = rng.choice([m.span() for m in re.finditer(r"[^\s,:]+", value)] or [(0, 0)])
        inside = rng.choice((*NUMBERS, "", "", rng.choice(parts), f"{value} {value}"))
        return value[: at[0]] + inside + value[at[1] :]
    if way == "scale":
        return re.sub(
            r"-?\d+\.?\d*", lambda m: str(float(m[0]) * rng.choice((-1, 0, 1e-6, 3, 1e6))), value
        )
    if way == "like":  # what another element has there
        return rng.choice([e.attrib[key] for e in root.iter() if key in e.attrib])
    if way == "any":
        element = rng.choice([e for e in root.iter() if e.attrib])
        return rng.choice(list(element.attrib.values()))
    if way == "break":
        return rng.choice((value[: len(value) // 2], value[::-1], value + "x", value * 2, parts[0]))
    return rng.choice(NUMBERS)


def _toml(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    lines = data.decode(errors="replace").splitlines()
    if not lines:
        return _bytes(data, rng)
    at = rng.randrange(len(lines))
    key, equals, value = lines[at].partition("=")
    way = rng.choice(("value",) * 6 + ("remove", "repeat", "swap", "rename"))
    if way == "value" and equals:
        known = tomllib.loads(f"value = {value}")["value"] if _is_toml(value) else None
        new = rng.choice((*_TOML, repr(-known) if type(known) in (int, float) else '"x"'))
        if isinstance(known, list) and rng.random() < 0.5:
            items = [json.dumps(item) for item in known]
            items[rng.randrange(len(items)) if items else 0 :][:1] = []
            items.insert(rng.randrange(len(items) + 1), new)
            new = f"[{', '.join(items)}]"
        lines[at] = f"{key}= {new}"
    elif way == "remove":
        del lines[at]
    elif way == "repeat":
        lines.insert(rng.randrange(len(lines) + 1), lines[at])
    elif way == "swap":
        other = rng.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    else:
        lines[at] = "x" + lines[at]
    return "\n".join(
        lines
    ).encode(), f"line {at + 1}: {way}: {lines[at] if at < len(lines) else ''}"


def _is_toml(value: str) -> bool:
    try:
        tomllib.loads(f"value = {value}")
    except tomllib.TOMLDecodeError:
        return False
    return True


def _json(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    try:
        tree: Any = json.loads(data)
    except ValueError:
        return _bytes(data, rng)
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        inside = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in inside:
            places.append((node, key))
            if isinstance(value, dict | list):
                walk(value)

    walk(tree if isinstance(tree, dict | list) else [])
    if not places:
        return _bytes(data, rng)
    node, key = rng.choice(places)
    values: tuple[Any, ...] = (None, [], {}, "", "x", -1, 1e308, float("nan"), True, [1], "gone")
    if isinstance(node, dict) and rng.random() < 0.4:
        del node[key]
        return json.dumps(tree).encode(), f"no {key!r}"
    node[key] = rng.choice(values)
    return json.dumps(tree).encode(), f"{key!r} = {node[key]!r}"


def _table(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    try:
        frame = pd.read_parquet(io.BytesIO(data))
    except Exception:  # damaged before
        return _bytes(data, rng)
    if not len(frame.columns):
        return _bytes(data, rng)
    column = str(rng.choice(list(frame.columns)))
    way = rng.choice(("drop", "rename", "texts", "none", "no rows", "twice", "infinite", "one row"))
    if way == "drop":
        frame = frame.drop(columns=column)
    elif way == "rename":
        frame = frame.rename(columns={column: column + "s"})
    elif way == "texts":
        frame = frame.assign(**{column: ["x"] * len(frame)})
    elif way == "none":
        frame = frame.assign(**{column: [None] * len(frame)})
    elif way == "no rows":
        frame = frame.iloc[:0]
    elif way == "twice":
        frame = pd.concat([frame, frame])
    elif way == "infinite":
        frame = frame.assign(**{column: np.full(len(frame), np.inf)})
    else:
        frame = frame.iloc[:1]
    buffer = io.BytesIO()
    frame.to_parquet(buffer, index=False)
    return buffer.getvalue(), f"{way} ({column})"
