"""What DART's parsers would read without end in a skeleton file, and the files that it includes.

DART inserts what an MJCF file includes as often as it stands there, and follows the joints of an
SDF or SKEL file from body to parent until it comes to a root. Both are checked here before: the
XML is read so strictly that DART's own reader finds nothing else in it.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from xml.parsers import expat

from can_dbc.yaml_file import read_text
from dart_model.errors import ModelError

MJCF_SUFFIXES = (".xml", ".mjcf")
_SUFFIXES_WITH_RINGS = (".sdf", ".skel")

_MAX_BYTES = 64 * 1024 * 1024
"""Largest file: a hundred times a robot with all its parts."""

_WORLD = "world"
_INCLUDED_NAME = re.compile(r"[\w+-][\w .+-]*(/[\w+-][\w .+-]*)*")
"""Names that mean to DART what they mean to the disk: no URI, nothing outside the folder."""


@dataclass
class _Element:
    """An element of an XML file; its text is that before its first child or comment, as DART's."""

    name: str
    attributes: dict[str, str]
    children: list["_Element"] = field(default_factory=list["_Element"])
    text: str = ""
    is_text_complete: bool = False

    def child_text(self, name: str) -> str:
        """Text of the first child of a name, empty if there is none."""
        return next((child.text.strip() for child in self.children if child.name == name), "")


def list_includes(path: Path) -> list[str]:
    """Files that a skeleton file includes, also through others, from its own folder on.

    Raises:
        FileError: One of them cannot be read.
        ModelError: One is included twice, or by itself, lies outside the folder, or is no XML.
    """
    if path.suffix.lower() not in MJCF_SUFFIXES:
        return []
    found: list[str] = []
    waiting = [path]
    while waiting:
        file = waiting.pop()
        for name in _find_includes(file):
            # DART looks for it in the folder of the first file, whichever includes it.
            if name in found or name == path.name:
                raise ModelError(
                    f"{file}: include file {name!r}: is included already, or includes itself: "
                    "expected every file once"
                )
            found.append(name)
            waiting.append(path.parent / name)
    return found


def refuse_endless(path: Path) -> None:
    """Refuse a skeleton file that DART would read without end.

    Raises:
        FileError: It cannot be read.
        ModelError: It includes itself, or a body carries itself; or it is no XML.
    """
    list_includes(path)
    if path.suffix.lower() in _SUFFIXES_WITH_RINGS:
        for element in _walk(_read_xml(path)):
            _refuse_ring(element, path)


def _find_includes(path: Path) -> Iterator[str]:
    """Files that an MJCF file includes where DART looks for it: directly below its root."""
    for element in _read_xml(path).children:
        if element.name != "include":
            continue
        name = element.attributes.get("file", "")
        if not _INCLUDED_NAME.fullmatch(name):
            raise ModelError(
                f"{path}: include file {name[:100]!r}: expected a path inside the model's folder"
            )
        yield name


def _refuse_ring(element: _Element, path: Path) -> None:
    """Refuse joints of an element by which a body carries itself."""
    parents: dict[str, set[str]] = {}
    for joint in element.children:
        if joint.name == "joint" and joint.child_text("parent") != _WORLD:
            parents.setdefault(joint.child_text("child"), set()).add(joint.child_text("parent"))
    try:
        TopologicalSorter(parents).prepare()
    except CycleError as error:
        ring = " -> ".join(error.args[1])[:100]
        raise ModelError(
            f"{path}: joints {ring!r}: a body carries itself, expected joints that begin at the "
            "world"
        ) from None


def _walk(element: _Element) -> Iterator[_Element]:
    waiting = [element]
    while waiting:
        element = waiting.pop()
        yield element
        waiting += element.children


def _read_xml(path: Path) -> _Element:
    reader = _XmlReader(path)
    try:
        return reader.read(read_text(path, _MAX_BYTES))
    except expat.ExpatError as error:
        reason = expat.errors.messages.get(error.code, "unknown error")
        raise ModelError(
            f"{path}: line {error.lineno}: {reason}, expected a valid {path.suffix} file"
        ) from error


class _XmlReader:
    """Reads one XML file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open = [_Element("", {})]
        parser = expat.ParserCreate()
        parser.buffer_text, parser.buffer_size = True, 1024 * 1024
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        parser.StartElementHandler = self._begin
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._add_text
        parser.CommentHandler = parser.ProcessingInstructionHandler = self._end_text
        parser.StartCdataSectionHandler = parser.EndCdataSectionHandler = self._end_text
        self._parser = parser

    def read(self, text: str) -> _Element:
        """The root element.

        Raises:
            ExpatError: The text is no XML.
            ModelError: It has a document type, which can give texts another content.
        """
        self._parser.Parse(text, True)
        return self._open[0].children[0]

    def _refuse_doctype(self, *_: object) -> None:
        raise ModelError(f"{self._path}: has a DOCTYPE, expected a file without one")

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        self._end_text()
        element = _Element(name, attributes)
        self._open[-1].children.append(element)
        self._open.append(element)

    def _end(self, _name: str) -> None:
        self._open.pop()

    def _add_text(self, text: str) -> None:
        if not self._open[-1].is_text_complete:
            self._open[-1].text += text

    def _end_text(self, *_: object) -> None:
        # White space alone is no text to DART.
        self._open[-1].is_text_complete |= bool(self._open[-1].text.strip())
