"""Bus logs that other programs wrote (BLF, ASC, candump, TRC, MF4), read through python-can."""

import importlib
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import MappingProxyType
from typing import IO, cast

import can
from can.io.blf import BLFParseError

from can_dbc.errors import InputError, missing_package
from can_dbc.frame import Frame

_TEXT = MappingProxyType(
    {".asc": can.ASCReader, ".log": can.CanutilsLogReader, ".trc": can.TRCReader}
)
_BINARY = MappingProxyType({".blf": can.BLFReader, ".mf4": can.MF4Reader})


class BusLogError(InputError):
    """A bus log cannot be read; one line: file, reason."""


LOG_SUFFIXES = (*_TEXT, *_BINARY)
"""Kinds of logs that are read."""

# What the readers raise on a damaged file depends on the format and is documented nowhere.
_READER_ERRORS: tuple[type[Exception], ...] = (
    can.CanError,
    BLFParseError,
    OSError,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    AttributeError,
    AssertionError,
    NotImplementedError,
    EOFError,
    struct.error,
    zlib.error,
)


def read_log(path: Path) -> Iterator[tuple[int, Frame]]:
    """Data frames of a bus log, in the order of the file, one at a time.

    Yields:
        Unix time of each frame in ns, as exact as the file and python-can (a float in s, to
        0.24 us today), and the frame, stamped with the time since the first one.

    Raises:
        BusLogError: The file is of no such kind, cannot be read, is damaged, or requires a package
            that is not installed.
    """
    if path.suffix.lower() not in LOG_SUFFIXES:
        raise BusLogError(
            f"{path}: expected a log with one of the endings {', '.join(LOG_SUFFIXES)}"
        )
    if not path.is_file():
        raise BusLogError(f"{path}: cannot be read: no such file")
    errors, first_ns = _reader_errors(path), None
    try:
        # Opened here and not by the reader, which leaves a damaged file open.
        with _open(path) as file:
            for message in _messages(path, file):
                if message.is_error_frame or message.is_remote_frame:
                    continue
                at_ns = round(message.timestamp * 1e9)
                first_ns = at_ns if first_ns is None else first_ns
                yield at_ns, _frame(message, at_ns - first_ns)
    except errors as error:
        kind = path.suffix.lstrip(".").upper()
        raise BusLogError(
            f"{path}: is no valid {kind} log, or is damaged: export it again"
        ) from error
    if first_ns is None:
        raise BusLogError(f"{path}: holds no frame, expected a log in the format of its ending")


def _open(path: Path) -> IO[str] | IO[bytes]:
    if path.suffix.lower() in _TEXT:
        return path.open(encoding="utf-8", errors="replace")
    return path.open("rb")


def _messages(path: Path, file: IO[str] | IO[bytes]) -> Iterable[can.Message]:
    reader = cast("Callable[[object], object]", {**_TEXT, **_BINARY}[path.suffix.lower()])
    return cast("Iterable[can.Message]", reader(file))


def _reader_errors(path: Path) -> tuple[type[Exception], ...]:
    """Errors that the reader of a file may raise when the file is damaged."""
    if path.suffix.lower() != ".mf4":
        return _READER_ERRORS
    try:
        module = importlib.import_module("asammdf.blocks.utils")
    except ImportError as error:
        raise BusLogError(
            f"{path}: " + missing_package("asammdf", "pip install -e '.[mf4]'")
        ) from error
    return (*_READER_ERRORS, cast("type[Exception]", module.MdfException))


def _frame(message: can.Message, t_ns: int) -> Frame:
    return Frame(
        t_ns,
        message.arbitration_id,
        bytes(message.data),
        message.is_extended_id,
        message.is_fd,
        message.bitrate_switch,
    )
