"""Objects of a sensor that is not on the bus, from its EDS or DCF file.

Reference: CiA 306, "Electronic data sheet specification for CANopen".
"""

import configparser
import io
import struct
import warnings
from pathlib import Path
from typing import Any

from can_dbc.errors import InputError
from rig.bus.canopen_network import package

SIZE_MAX_BYTES = 4 * 1024 * 1024
_SIGNED = (0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15)
"""Data types that are signed integers: 8, 16, 32, 24, 40, 48, 56 and 64 bits."""

_ENDINGS = (".eds", ".dcf")


class EdsObjects:
    """Objects with their default values, from an EDS or DCF file.

    The node id is for values such as ``$NODEID+0x180``.

    Raises:
        InputError: The file cannot be read, or is no EDS.
    """

    def __init__(self, path: Path, node_id: int) -> None:
        self._objects = _read_objects(path, node_id)

    def read(self, index: int, subindex: int = 0) -> bytes | None:
        """Default value of an object, or None where there is none."""
        variable = self._variable(index, subindex)
        if variable is None:
            return None
        value = variable.default if variable.value is None else variable.value
        if value is None:
            return None
        if isinstance(value, str):
            return value.encode("latin-1", "replace")
        try:
            return bytes(variable.encode_raw(value))
        except (struct.error, ValueError, TypeError, OverflowError):
            return None

    def is_signed(self, index: int, subindex: int) -> bool | None:
        """Whether an object is a signed integer."""
        variable = self._variable(index, subindex)
        return None if variable is None else variable.data_type in _SIGNED

    def _variable(self, index: int, subindex: int) -> Any:
        try:
            entry = self._objects[index]
            return entry if hasattr(entry, "data_type") else entry[subindex]
        except KeyError:
            return None


class _Text(io.StringIO):
    """Text of a file with the name of the file, whose ending determines its format."""

    def __init__(self, text: str, name: str) -> None:
        super().__init__(text)
        self.name = name.lower()


def _read_text(path: Path) -> str:
    """Text of a file in UTF-8 or, as many manufacturers write, in Windows-1252."""
    content = path.read_bytes()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252")


def _read_objects(path: Path, node_id: int) -> Any:
    if path.suffix.lower() not in _ENDINGS:
        raise InputError(f"{path}: expected a file .eds or .dcf")
    try:
        size = path.stat().st_size
    except ValueError:  # a name that no file can have
        raise InputError(f"{str(path)!a}: no such file, expected an EDS file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if size > SIZE_MAX_BYTES:
        raise InputError(f"{path}: larger than {SIZE_MAX_BYTES} bytes, expected an EDS file")
    canopen = package()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of how it logs
            objects = canopen.import_od(_Text(_read_text(path), path.name), node_id)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (
        configparser.Error,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        ArithmeticError,
        struct.error,
    ) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: is no EDS file, or is damaged: {reason}") from error
    if 0x1000 not in objects:
        raise InputError(f"{path}: has no device type (1000h), expected an EDS file")
    return objects
