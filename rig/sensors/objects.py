"""Where the objects of a CANopen device are read: from the device itself, or from its EDS file."""

from typing import Protocol


class Objects(Protocol):
    """The objects of a device."""

    def read(self, index: int, subindex: int = 0) -> bytes | None:
        """Content of an object, or None where the device has none."""
        ...

    def is_signed(self, index: int, subindex: int) -> bool | None:
        """Whether an object is a signed integer, where that is known: a device does not tell."""
        ...


def number(objects: Objects, index: int, subindex: int = 0) -> int | None:
    """Content of an object as an unsigned integer; None where there is none or it is no number."""
    content = objects.read(index, subindex)
    if content is None or not 1 <= len(content) <= 8:
        return None
    return int.from_bytes(content, "little")


def text(objects: Objects, index: int) -> str:
    """Content of an object as printable text; empty where there is none."""
    content = objects.read(index) or b""
    found = content.split(b"\0")[0].decode("latin-1")
    return "".join(sign if sign.isprintable() else " " for sign in found).strip()[:80]
