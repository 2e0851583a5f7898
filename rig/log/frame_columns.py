"""The received frames of a log as columns: a log of hours is read at once and not line by line.

Lines of one message have one shape (their digits stand in the same places), so that numpy reads
them together. A line of any other shape is read by `parse_frame`, which decides what is an error.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from can_dbc.frame import Frame
from rig.log.errors import LogError
from rig.log.reader import LATEST_S, parse_frame

_BLOCK_BYTES = 2 * 1024 * 1024
_MOST_SHAPES = 16
"""Shapes of one length that are tried in a block before its other lines are read one by one."""

_LINE = re.compile(
    rb"\((?P<s>[0-9]{1,10})\.(?P<ns>[0-9]{9})\) [!-~]+ "
    rb"(?P<id>[0-9A-F]{3}|[0-9A-F]{8})(?P<mark>#|##[0-9A-F])(?P<data>[0-9A-F]*) R"
)
_MOST_DIGITS = {b"#": 16, b"##": 128}
"""Of a payload, on classic CAN and on CAN FD."""
_NEWLINE, _SENT = 10, ord("T")
_NO_DIGIT = 255
_NIBBLES = np.full(256, _NO_DIGIT, dtype=np.uint8)
_NIBBLES[list(b"0123456789ABCDEF")] = np.arange(16)


@dataclass(frozen=True)
class FrameColumns:
    """Frames in the order of the log.

    Attributes:
        t_ns: Time on the run's clock, in ns, shape (n,).
        arbitration_id: Ids, shape (n,).
        is_extended: Whether ids have 29 bits, shape (n,).
        is_error: Whether it is an error frame, shape (n,).
        length: Length of the payload in bytes, shape (n,).
        is_fd: Whether it is a CAN FD frame, shape (n,).
        payload: Payloads, padded with zeros, shape (n, largest length).
    """

    t_ns: NDArray[np.int64]
    arbitration_id: NDArray[np.int64]
    is_extended: NDArray[np.bool_]
    is_error: NDArray[np.bool_]
    length: NDArray[np.int64]
    is_fd: NDArray[np.bool_]
    payload: NDArray[np.uint8]

    def between(self, first: int, end: int) -> Iterator[Frame]:
        """Frames `first` to `end - 1`, one by one."""
        part = slice(first, end)
        payload = self.payload[part]
        data, width = payload.tobytes(), payload.shape[1]
        columns = zip(
            self.t_ns[part].tolist(),
            self.arbitration_id[part].tolist(),
            range(0, len(data) + 1, width or 1),
            self.length[part].tolist(),
            self.is_extended[part].tolist(),
            self.is_fd[part].tolist(),
            self.is_error[part].tolist(),
            strict=False,
        )
        for t_ns, arbitration_id, begin, length, is_extended, is_fd, is_error in columns:
            yield Frame(
                t_ns,
                arbitration_id,
                data[begin : begin + length],
                is_extended,
                is_fd,
                is_error=is_error,
            )


def received_frames(paths: Sequence[Path], epoch_ns: int) -> FrameColumns:
    """Every received frame of a log; a last line that a kill cut off is left out.

    Args:
        paths: Files of the log in candump's format, in their order.
        epoch_ns: Unix time of the run's start.

    Raises:
        LogError: The file cannot be read, or a line of it is no frame.
    """
    parts = [
        _block(text, first_line, epoch_ns, path)
        for path in paths
        for text, first_line in _whole_lines(path)
    ] or [_columns(0, 0)]
    width = max(part.payload.shape[1] for part in parts)
    return FrameColumns(
        np.concatenate([part.t_ns for part in parts]),
        np.concatenate([part.arbitration_id for part in parts]),
        np.concatenate([part.is_extended for part in parts]),
        np.concatenate([part.is_error for part in parts]),
        np.concatenate([part.length for part in parts]),
        np.concatenate([part.is_fd for part in parts]),
        np.concatenate(
            [np.pad(part.payload, ((0, 0), (0, width - part.payload.shape[1]))) for part in parts]
        ),
    )


def _whole_lines(path: Path) -> Iterator[tuple[bytes, int]]:
    """Blocks of whole lines, each with the number of its first line."""
    rest, number = b"", 1
    try:
        with path.open("rb") as file:
            while block := file.read(_BLOCK_BYTES):
                text = rest + block
                end = text.rfind(b"\n") + 1
                whole, rest = text[:end], text[end:]
                if whole:
                    yield whole, number
                    number += whole.count(b"\n")
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error


def _columns(count: int, width: int) -> FrameColumns:
    return FrameColumns(
        np.zeros(count, dtype=np.int64),
        np.zeros(count, dtype=np.int64),
        np.zeros(count, dtype=np.bool_),
        np.zeros(count, dtype=np.bool_),
        np.zeros(count, dtype=np.int64),
        np.zeros(count, dtype=np.bool_),
        np.zeros((count, width), dtype=np.uint8),
    )


def _block(text: bytes, first_line: int, epoch_ns: int, path: Path) -> FrameColumns:
    characters = np.frombuffer(text, dtype=np.uint8)
    ends = np.flatnonzero(characters == _NEWLINE)
    starts = np.concatenate([[0], ends[:-1] + 1])
    numbers = np.flatnonzero(characters[ends - 1] != _SENT)
    starts, ends = starts[numbers], ends[numbers]
    widths = ends - starts
    found = _columns(len(starts), 64)
    odd: list[int] = []
    for width in np.unique(widths).tolist():
        rows = np.flatnonzero(widths == width)
        lines = characters[starts[rows][:, None] + np.arange(width)]
        for _ in range(_MOST_SHAPES):
            if not len(rows):
                break
            read = _read_alike(lines, rows, epoch_ns, found)
            odd += rows[:1][~read[:1]].tolist()
            read[0] = True
            lines, rows = lines[~read], rows[~read]
        odd += rows.tolist()
    for row in sorted(odd):
        line = text[starts[row] : ends[row]].decode("ascii", "replace")
        _read_line(line, row, epoch_ns, f"{path}: line {first_line + numbers[row]}", found)
    received = found.length >= 0
    largest = int(found.length.max(initial=0))
    return FrameColumns(
        found.t_ns[received],
        found.arbitration_id[received],
        found.is_extended[received],
        found.is_error[received],
        found.length[received],
        found.is_fd[received],
        found.payload[received, :largest],
    )


def _read_alike(
    lines: NDArray[np.uint8], rows: NDArray[np.intp], epoch_ns: int, found: FrameColumns
) -> NDArray[np.bool_]:
    """Read all lines of the first one's shape; says which they were."""
    first = lines[0].tobytes()
    shape = _LINE.fullmatch(first)
    if (
        shape is None
        or len(shape["data"]) % 2
        or len(shape["data"]) > _MOST_DIGITS[shape["mark"][:2]]
    ):
        return np.zeros(len(lines), dtype=np.bool_)
    digits = [slice(*shape.span(name)) for name in ("s", "ns", "id", "data")]
    values = [_NIBBLES[lines[:, place]] for place in digits]
    fixed = np.ones(len(first), dtype=np.bool_)
    for place in digits:
        fixed[place] = False
    alike = (lines[:, fixed] == lines[0, fixed]).all(axis=1)
    for value, base in zip(values, (10, 10, 16, 16), strict=True):
        alike &= (value < base).all(axis=1)
    if values[0].shape[1] >= len(str(LATEST_S)):
        alike &= values[0][:, 0] < int(str(LATEST_S)[0])
    seconds, fraction, identifier, data = (value[alike] for value in values)
    at = rows[alike]
    number = _number(identifier, 16)
    is_long = identifier.shape[1] == 8
    found.t_ns[at] = _number(seconds, 10) * 1_000_000_000 + _number(fraction, 10) - epoch_ns
    found.arbitration_id[at] = number & 0x1FFFFFFF
    found.is_error[at] = is_long & ((number & 0x20000000) != 0)
    found.is_extended[at] = is_long & ((number & 0x20000000) == 0)
    found.length[at] = data.shape[1] // 2
    found.is_fd[at] = shape["mark"].startswith(b"##")
    found.payload[at, : data.shape[1] // 2] = data[:, ::2] << 4 | data[:, 1::2]
    return alike


def _number(digits: NDArray[np.uint8], base: int) -> NDArray[np.int64]:
    value = np.zeros(len(digits), dtype=np.int64)
    for column in range(digits.shape[1]):
        value *= base
        value += digits[:, column]
    return value


def _read_line(line: str, row: int, epoch_ns: int, place: str, found: FrameColumns) -> None:
    try:
        frame, direction = parse_frame(line, epoch_ns)
    except (ValueError, IndexError) as error:
        raise LogError(
            f"{place}: {line.strip()[:60]!r}: expected a line such as "
            "'(1.000000000) can0 100#0102 R'"
        ) from error
    found.t_ns[row] = frame.t_ns
    found.arbitration_id[row] = frame.arbitration_id
    found.is_extended[row] = frame.is_extended
    found.is_error[row] = frame.is_error
    found.is_fd[row] = frame.is_fd
    found.length[row] = len(frame.data) if direction == "R" else -1
    found.payload[row, : len(frame.data)] = np.frombuffer(frame.data, dtype=np.uint8)
