"""XML files, read as SUMO reads them: gzipped or not, with what they include.

Includes: https://sumo.dlr.de/docs/sumo.html#including_files
"""

from __future__ import annotations

import gzip
import re
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from io import BufferedReader
from pathlib import Path
from typing import NamedTuple

from sumo_cohesion.errors import UserError

_GZIP = b"\x1f\x8b"
_OTHER_KINDS = {"net", "nodes", "edges", "connections", "configuration", "sumoConfiguration"}
"""Root elements of files that are neither demand nor additional. SUMO takes any other root."""
_READS_FILE = {"variableSpeedSign", "rerouter", "calibrator"}
"""Elements that read the file that their attribute ``file`` names; all others write it."""
_READ = ("edgesFile", "imgFile", "osgFile")
_NO_FILES = {"", "-", "nul", "/dev/null", "stdout", "stderr"}
_SOCKET = re.compile(r"[^/\\]{2,}:\d+")


class NamedFile(NamedTuple):
    """A file that an element names in one of its attributes, to read it or to write it."""

    element: ET.Element
    attribute: str
    written: bool

    @property
    def path(self) -> Path:
        """The file."""
        return Path(self.element.get(self.attribute, ""))

    def rename(self, name: str) -> None:
        """Name another file instead."""
        self.element.set(self.attribute, name)


def parse_xml(path: Path) -> ET.Element:
    """Parse an XML file, gzipped or not whatever its name.

    Raises
    ------
    UserError
        If the file is missing, unreadable, damaged or not well-formed.
    """
    with _one_line(path), _opened(path) as file:
        return ET.parse(file).getroot()


def each_element(path: Path, root: str, tag: str) -> Iterator[ET.Element]:
    """Elements of a tag right below the root, each thrown away after use: the file may be long.

    Raises
    ------
    UserError
        As `check_xml` does, when it comes to what is wrong.
    """
    with _one_line(path), _opened(path) as file:
        top: ET.Element | None = None
        for event, element in ET.iterparse(file, events=("start", "end")):
            if top is None:
                top = _of_kind(element, root, path)
            elif event == "end" and element.tag == tag:
                yield element
                top.clear()


def root_of(path: Path) -> str:
    """Name of a file's root element; of the file no more is read.

    Raises
    ------
    UserError
        If the file is missing, unreadable, damaged or not well-formed up to there.
    """
    with _one_line(path), _opened(path) as file:
        _, element = next(iter(ET.iterparse(file, events=("start",))))
        return str(element.tag)


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turn whatever reading an XML file causes into one line."""
    try:
        yield
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise UserError(
            f"{path}: gzipped, but truncated or damaged ({error}); write it again"
        ) from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except (ET.ParseError, UnicodeDecodeError, ValueError, LookupError) as error:
        raise UserError(
            f"{path}: not well-formed XML ({error}); the file is truncated or damaged, "
            "write it again"
        ) from None


def _opened(path: Path) -> gzip.GzipFile | BufferedReader:
    with path.open("rb") as file:
        zipped = file.read(len(_GZIP)) == _GZIP
    return gzip.open(path) if zipped else path.open("rb")


def check_xml(path: Path, root: str) -> ET.Element:
    """Parse an XML file and check its root element, before SUMO sees it.

    A malformed network kills the whole process inside SUMO, so this must come first.

    Raises
    ------
    UserError
        If the file is missing, unreadable, not well-formed or of another kind.
    """
    return _of_kind(parse_xml(path), root, path)


def _of_kind(element: ET.Element, root: str, path: Path) -> ET.Element:
    if element.tag != root:
        raise UserError(f"{path}: its root element is <{element.tag}>, expected <{root}>")
    return element


def read_with_includes(path: Path) -> ET.Element:
    """Read a route or additional file, and in their places the files that it includes.

    What files it names are named as seen from anywhere: SUMO looks beside the file that names
    them, and so do included files.

    Raises
    ------
    UserError
        If one of the files is missing, unreadable, not well-formed or of another kind.
    """
    return _read(path, ())


def files_behind(path: Path) -> list[Path]:
    """Files that a route or additional file includes or reads, and those that they do."""
    found: dict[Path, None] = {}
    left = [path]
    while left:
        here = left.pop()
        stat = here.stat()
        named = (p.resolve() for p in _next_to_read(here, stat.st_mtime_ns, stat.st_size))
        new = [p for p in named if p.is_file()]
        left += [p for p in new if p not in found and p.suffix in (".xml", ".gz")]
        found |= dict.fromkeys(new)
    return list(found)


@lru_cache(maxsize=256)
def _next_to_read(path: Path, _changed: int, _size: int) -> tuple[Path, ...]:
    root = parse_xml(path)
    includes = [element.get("href", "") for element in root.iter("include")]
    reads = [str(named.path) for named in named_files(root) if not named.written]
    return tuple(path.parent / name for name in (*includes, *reads))


def contents(root: ET.Element) -> list[ET.Element]:
    """Return what a file holds; its root is only the wrapping, whatever it is called.

    A file may also consist of a single element, such as one <vType>.
    """
    return [root] if root.get("id") is not None else list(root)


def _read(path: Path, above: Sequence[Path]) -> ET.Element:
    here = path.resolve()
    if here in above:
        raise UserError(f"{path}: includes itself; take out the <include>")
    try:
        root = parse_xml(path)
    except UserError as error:
        by = f"; it is included by {above[-1]}" if above else ""
        raise UserError(f"{error}{by}") from None
    if root.tag in _OTHER_KINDS:
        raise UserError(
            f"{path}: its root element is <{root.tag}>, expected <routes> or <additional>; "
            "it is another kind of file"
        )
    for named in named_files(root):
        named.rename(str(here.parent / named.path))
    if root.find(".//include") is not None:
        _put_in_place(root, path.parent, (*above, here))
    return root


def _put_in_place(parent: ET.Element, folder: Path, above: Sequence[Path]) -> None:
    """Replace every <include> below an element by what the file holds that it names."""
    children: list[ET.Element] = []
    for child in parent:
        if child.tag == "include":
            children += contents(_read(folder / child.get("href", ""), above))
        else:
            _put_in_place(child, folder, above)
            children.append(child)
    parent[:] = children


def named_files(root: ET.Element) -> Iterator[NamedFile]:
    """Files that the elements below a root name, to read or to write; sockets are none."""
    for element in root.iter():
        for attribute, written in _attributes(element):
            text = element.get(attribute, "")
            if text.strip().lower() not in _NO_FILES and not _SOCKET.fullmatch(text):
                yield NamedFile(element, attribute, written)


def _attributes(element: ET.Element) -> Iterator[tuple[str, bool]]:
    """Attributes of an element that hold a file's name, and whether SUMO writes it."""
    tag, attributes = element.tag, element.attrib
    if tag == "param":
        if attributes.get("key", "").rpartition(".")[2] == "file":  # device.ssm.file
            yield "value", True
        return
    if "file" in attributes:
        yield "file", tag not in _READS_FILE
    if tag == "calibrator" and "output" in attributes:
        yield "output", True
    if tag == "timedEvent" and "dest" in attributes:
        yield "dest", True
    for name in _READ:
        if name in attributes:
            yield name, False
