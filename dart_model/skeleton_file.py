"""What DART's parsers would read without end in a skeleton file, and the files that it includes.

DART inserts what an MJCF file includes as often as it stands there, and follows the joints of an
SDF or SKEL file from body to parent until it comes to a root. Both are checked here before.
"""

import re
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from dart_model.errors import ModelError
from dart_model.skeleton_xml import Element, read_xml, walk

MJCF_SUFFIXES = (".xml", ".mjcf")
_SUFFIXES_WITH_RINGS = (".sdf", ".skel")

_WORLD = "world"
_INCLUDED_NAME = re.compile(r"[\w+-][\w .+-]*(/[\w+-][\w .+-]*)*")
"""Names that mean to DART what they mean to the disk: no URI, nothing outside the folder."""


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
        for element in walk(read_xml(path)):
            _refuse_ring(element, path)


def _find_includes(path: Path) -> Iterator[str]:
    """Files that an MJCF file includes where DART looks for it: directly below its root."""
    for element in read_xml(path).children:
        if element.name != "include":
            continue
        name = element.attributes.get("file", "")
        if not _INCLUDED_NAME.fullmatch(name):
            raise ModelError(
                f"{path}: include file {name[:100]!r}: expected a path inside the model's folder"
            )
        yield name


def _refuse_ring(element: Element, path: Path) -> None:
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
