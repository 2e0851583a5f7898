"""Objects of a CANopen device, read from the device itself or from its EDS file."""

from typing import Protocol


class CanOpenObjects(Protocol):
    """The objects of a device."""

    def read(self, index: int, subindex: int = 0) -> bytes | None:
        """Content of an object, or None where the device has none."""
        ...

    def is_signed(self, index: int, subindex: int) -> bool | None:
        """Whether an object is a signed integer, where that is known: from an EDS file."""
        ...


def number(objects: CanOpenObjects, index: int, subindex: int = 0) -> int | None:
    """Content of an object as an unsigned integer; None where there is none or it is no number."""
    content = objects.read(index, subindex)
    if content is None or not 1 <= len(content) <= 8:
        return None
    return int.from_bytes(content, "little")


def text(objects: CanOpenObjects, index: int) -> str:
    """Content of an object as printable text; empty where there is none."""
    content = objects.read(index) or b""
    characters = content.split(b"\0")[0].decode("latin-1")
    return "".join(c if c.isprintable() else " " for c in characters).strip()[:80]
