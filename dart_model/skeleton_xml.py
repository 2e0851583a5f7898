"""The XML of a skeleton file, read so strictly that DART's own reader finds nothing else in it."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from can_dbc.yaml_file import read_text
from dart_model.errors import ModelError

_MAX_BYTES = 64 * 1024 * 1024
"""Largest file: a hundred times a robot with all its parts."""


@dataclass
class Element:
    """An element of an XML file; its text is that before its first child or comment, as DART's."""

    name: str
    attributes: dict[str, str]
    children: list["Element"] = field(default_factory=list["Element"])
    text: str = ""
    is_text_complete: bool = False

    def child(self, name: str) -> "Element":
        """The first child of a name, an empty one if there is none."""
        return next((child for child in self.children if child.name == name), Element(name, {}))

    def child_text(self, name: str) -> str:
        """Text of the first child of a name, empty if there is none."""
        return self.child(name).text.strip()


def walk(element: Element) -> Iterator[Element]:
    """An element and all that it contains."""
    waiting = [element]
    while waiting:
        element = waiting.pop()
        yield element
        waiting += element.children


def read_xml(path: Path) -> Element:
    """Root of an XML file.

    Raises:
        FileError: It cannot be read.
        ModelError: It is no XML, or has a document type.
    """
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
        self._open = [Element("", {})]
        parser = expat.ParserCreate()
        parser.buffer_text, parser.buffer_size = True, 1024 * 1024
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        parser.StartElementHandler = self._begin
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._add_text
        parser.CommentHandler = parser.ProcessingInstructionHandler = self._end_text
        parser.StartCdataSectionHandler = parser.EndCdataSectionHandler = self._end_text
        self._parser = parser

    def read(self, text: str) -> Element:
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
        element = Element(name, attributes)
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
