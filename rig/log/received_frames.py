"""The received frames of a log as columns: a log of hours is read at once and not line by line.

Arrow splits the lines that `format_frame` writes, a block at a time. A line of any other form is
read by `parse_frame`, which decides what is an error. (The columns of a tick are those of
`rig.log.step_columns`.)
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from can_dbc.frame import Frame
from rig.log.candump import LATEST_S, line_error, parse_frame
from rig.log.errors import LogError

_pc = cast("Any", pc)  # its stubs know no patterns of bytes

_BLOCK_BYTES = 2 * 1024 * 1024

_LINE = (
    r"^\((?P<stamp>[0-9]{1,10}\.[0-9]{9})\) [!-~]+ "
    r"(?P<id>[0-9A-F]{3}(?:[0-9A-F]{5})?)#(?P<flags>#[0-9A-F])?(?P<data>[0-9A-F]*) R$"
)
"""Four groups: RE2 takes twice the time where there are more."""

_MOST_DIGITS, _MOST_FD_DIGITS = 16, 128
"""Of a payload."""


class FrameColumns(NamedTuple):
    """Frames in the order of the log.

    Attributes:
        t_ns: Time on the run's clock, in ns, shape (n,).
        length: Length of the payload in bytes, shape (n,).
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


def read_frame_columns(paths: Sequence[Path], epoch_ns: int) -> FrameColumns:
    """Every received frame of a log, from its files in their order.

    A last line that a kill cut off is left out.

    Raises:
        LogError: The file cannot be read, or a line of it is no frame.
    """
    parts = [
        _read_block(text, first_line, epoch_ns, path)
        for path in paths
        for text, first_line in _whole_lines(path)
    ] or [_empty(0, 0)]
    width = max(part.payload.shape[1] for part in parts)
    others = zip(*(part[:-1] for part in parts), strict=True)
    padded = [np.pad(part.payload, ((0, 0), (0, width - part.payload.shape[1]))) for part in parts]
    return FrameColumns._make([*map(np.concatenate, others), np.concatenate(padded)])


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


def _empty(count: int, width: int) -> FrameColumns:
    payload = np.zeros((count, width), dtype=np.uint8)
    t_ns, ids, length = np.zeros((3, count), dtype=np.int64)
    is_extended, is_error, is_fd = np.zeros((3, count), dtype=np.bool_)
    return FrameColumns(t_ns, ids, is_extended, is_error, length, is_fd, payload)


def _read_block(text: bytes, first_line: int, epoch_ns: int, path: Path) -> FrameColumns:
    lines = _pc.split_pattern(pa.array([text], pa.binary()), b"\n")[0].values[:-1]
    numbers = np.flatnonzero(_numpy(_pc.invert(_pc.ends_with(lines, b"T"))))
    lines = lines.take(pa.array(numbers))
    columns = _empty(len(numbers), _MOST_FD_DIGITS // 2)
    groups = _pc.extract_regex(lines, _LINE)
    is_read = _numpy(groups.is_valid()).copy()
    rows = np.flatnonzero(is_read)
    is_read[rows] = _read_usual(groups.filter(pa.array(is_read)), rows, epoch_ns, columns)
    for row in np.flatnonzero(~is_read).tolist():
        line = lines[row].as_py().decode("ascii", "replace")
        _read_line(line, row, epoch_ns, f"{path}: line {first_line + numbers[row]}", columns)
    received = columns.length >= 0
    largest = int(columns.length.max(initial=0))
    columns = FrameColumns._make(column[received] for column in columns)
    return columns._replace(payload=columns.payload[:, :largest])


def _read_usual(
    groups: Any, rows: NDArray[np.intp], epoch_ns: int, columns: FrameColumns
) -> NDArray[np.bool_]:
    """Write the frames of lines that match `_LINE`; gives whether each is one, shape (n,)."""
    stamp, identifier, flags, data = (group.cast(pa.string()) for group in groups.flatten())
    stamp_ns = _numpy(_pc.replace_substring(stamp, ".", "").cast(pa.uint64()))
    digits, is_fd = _numpy(_pc.binary_length(data)), _numpy(_pc.binary_length(flags)) > 0
    is_frame = (digits % 2 == 0) & (digits <= np.where(is_fd, _MOST_FD_DIGITS, _MOST_DIGITS))
    is_frame &= stamp_ns < LATEST_S * 1_000_000_000
    rows, length = rows[is_frame], digits[is_frame] // 2
    number = _numpy(_pc.binary_join_element_wise("0x", identifier, "").cast(pa.int64()))[is_frame]
    is_long = _numpy(_pc.binary_length(identifier))[is_frame] == 8
    columns.t_ns[rows] = stamp_ns[is_frame].astype(np.int64) - epoch_ns
    columns.arbitration_id[rows] = number & 0x1FFFFFFF
    columns.is_error[rows] = is_long & (number & 0x20000000 != 0)
    columns.is_extended[rows] = is_long & (number & 0x20000000 == 0)
    columns.length[rows] = length
    columns.is_fd[rows] = is_fd[is_frame]
    payload = np.zeros((len(rows), length.max(initial=0)), dtype=np.uint8)
    content = bytes.fromhex("".join(data.filter(pa.array(is_frame)).to_pylist()))
    payload[np.arange(payload.shape[1]) < length[:, None]] = np.frombuffer(content, np.uint8)
    columns.payload[rows, : payload.shape[1]] = payload
    return is_frame


def _numpy(array: Any) -> NDArray[Any]:
    return array.to_numpy(zero_copy_only=False)


def _read_line(line: str, row: int, epoch_ns: int, where: str, columns: FrameColumns) -> None:
    try:
        frame, direction = parse_frame(line, epoch_ns)
    except (ValueError, IndexError) as error:
        raise line_error(where, line) from error
    columns.t_ns[row] = frame.t_ns
    columns.arbitration_id[row] = frame.arbitration_id
    columns.is_extended[row] = frame.is_extended
    columns.is_error[row] = frame.is_error
    columns.is_fd[row] = frame.is_fd
    columns.length[row] = len(frame.data) if direction == "R" else -1
    columns.payload[row, : len(frame.data)] = np.frombuffer(frame.data, dtype=np.uint8)
