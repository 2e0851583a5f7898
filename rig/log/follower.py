"""Reads a run's steps while they are being written, in memory that hardly grows.

Of all steps only the least and the largest value of each 64 are kept; the newest are kept whole,
and older ones are read again where they are looked at closely. A window is thinned by minimum and
maximum, never by skipping, so that no peak is lost at any zoom.
"""

import bisect
import contextlib
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rig.bridge.values import Mode, Request
from rig.log.file_names import STEPS_FILE, part_name
from rig.log.step_columns import BUS_FAULT, END_OF_STREAM, LOG_FAULT, REQUEST_FLAGS, step_schema

Array = NDArray[np.float64]
BUCKET = 64
"""Steps of which the extremes are kept: a screen's width of them is a minute at 1 kHz."""

FLAGS = {
    "acknowledged": REQUEST_FLAGS[Request.ACKNOWLEDGE],
    "bus_fault": BUS_FAULT,
    "log_fault": LOG_FAULT,
}
"""Columns that the bits of `flags` become: of a sum of bits the largest says little."""

FORCE_ERROR = "force_error_n"
"""Column of the estimated force less that of the load cell, where the model has one strut; NaN in
cycles without a sample or a valid estimate. Extremes of two curves would not give those of their
difference."""

_INNOVATION = ".innovation_m"
"""End of the name of a column that says nothing where no height arrives: it keeps its last value,
or is zero, and reads as a perfect match."""

_APART = tuple(float(mode) for mode in (Mode.WAITING, Mode.HOLD, Mode.SAFE))
"""Modes in which the model does not follow the bench."""

_CELL, _FORCE = "strut_force_n", ".force_n"
"""Column of the load cell, and end of the name of that of a strut's estimate."""

_NEWEST = 131_072
"""Steps that are kept whole: two minutes at 1 kHz, in some ten megabytes."""

_PIECE = 4096
"""Steps of a piece that is not added to any more."""

_AT_ONCE = 1024
"""Batches that are turned into numbers in one go, which bounds the memory for it."""


class Stretch(NamedTuple):
    """A stretch of a run.

    Attributes:
        values: Columns in the order asked for, shape (columns, N); NaN where there is nothing.
            Where steps were thinned, two neighbours are a bucket's least and largest value.
    """

    t_s: Array
    values: Array
    steps: int


class RunFollower:
    """The steps of a run's folder, which may still be written."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._part, self._offset = 0, 0
        self._schema = step_schema()
        self.columns: tuple[str, ...] = ()
        """Names of the columns, `t_ns` first; none before the stream has begun."""
        self.steps = 0
        """Steps that have been read."""
        self._begins: list[int] = []
        self._places: list[tuple[int, int]] = []
        self._least, self._largest = _Growing(), _Growing()
        self._newest: deque[Array] = deque()
        self._following = 0
        self._open = np.zeros((0, 0))

    @property
    def unread_bytes(self) -> int:
        """Bytes of the present file that have not been read."""
        with contextlib.suppress(OSError):
            return max(0, self._path.stat().st_size - self._offset)
        return 0

    @property
    def is_another(self) -> bool:
        """Whether the file is shorter than what was read of it: another run's."""
        with contextlib.suppress(OSError):
            return self._path.stat().st_size < self._offset
        return False

    @property
    def share_read(self) -> float:
        """Share of the present file that has been read, 0 to 1."""
        return self._offset / max(1, self._offset + self.unread_bytes)

    @property
    def span_s(self) -> tuple[float, float]:
        """Times of the first and the last step; zeros before there is one."""
        if not self.steps:
            return 0.0, 0.0
        first = self._least.rows[0, 0] if len(self._least.rows) else self._open[0, 0]
        return float(first) * 1e-9, float(self._newest[-1][-1, 0]) * 1e-9

    @property
    def newest(self) -> Array | None:
        """The newest step, shape (columns,); None before there is one."""
        return self._newest[-1][-1] if self._newest else None

    def update(self, most_steps: int) -> None:
        """Take about so many steps of what was written since; the rest is for the next call."""
        end = self.steps + most_steps
        while self.steps < end and (batches := self._read_batches()):
            self._add(_matrix(pa.Table.from_batches(batches)))

    def window(self, names: Sequence[str], begin_s: float, end_s: float, points: int) -> Stretch:
        """A stretch of the run, thinned into at most so many buckets; unknown columns are NaN."""
        columns = [self.columns.index(name) if name in self.columns else -1 for name in names]
        begin_ns, end_ns = begin_s * 1e9 - 0.5, end_s * 1e9 + 0.5
        begin, end = self.between(begin_s, end_s)
        first, last = begin // BUCKET, -(-end // BUCKET)
        if end - begin <= max(_NEWEST // 2, 2 * points):
            rows = self.rows(begin, end)
            rows = rows[(rows[:, 0] >= begin_ns) & (rows[:, 0] <= end_ns)]
            if len(rows) <= 2 * points:
                return Stretch(rows[:, 0] * 1e-9, _select_columns(rows, columns), len(rows))
            values = _select_columns(rows, columns)
            return _thin(rows[:, 0], values, values, points, len(rows))
        least, largest = self._least.rows[first:last], self._largest.rows[first:last]
        if last > len(self._least.rows) and len(self._open):
            least = np.vstack([least, np.fmin.reduce(self._open)])
            largest = np.vstack([largest, np.fmax.reduce(self._open)])
        low, high = _select_columns(least, columns), _select_columns(largest, columns)
        return _thin(least[:, 0], low, high, points, end - begin)

    def between(self, begin_s: float, end_s: float) -> tuple[int, int]:
        """Numbers of steps between which all of a stretch are, with some before and after it."""
        last = self._bucket(end_s * 1e9 + 0.5) + 1
        # Behind the last whole bucket are the steps of the next one.
        end = last * BUCKET if last < len(self._least.rows) else self.steps
        return self._bucket(begin_s * 1e9 - 0.5) * BUCKET, end

    def rows(self, begin: int, end: int) -> Array:
        """Steps `begin` to `end - 1`, shape (N, columns), times in ns in the first column."""
        begin, end = max(begin, 0), min(end, self.steps)
        if begin >= end:
            return np.zeros((0, max(len(self.columns), 1)))
        kept_from = self.steps - sum(map(len, self._newest))
        if begin >= kept_from:
            return self._newest_rows(begin - kept_from, end - kept_from)
        first = bisect.bisect_right(self._begins, begin) - 1
        last = bisect.bisect_left(self._begins, end)
        batches = [self._read_again(*place) for place in self._places[first:last]]
        offset = self._begins[first]
        return _matrix(pa.Table.from_batches(batches))[begin - offset : end - offset]

    @property
    def _path(self) -> Path:
        return self._folder / part_name(STEPS_FILE, self._part)

    def _read_batches(self) -> list[pa.RecordBatch]:
        """The next batches that are whole; none where nothing more has been written."""
        self._go_on()
        if not self.unread_bytes:
            return []
        batches: list[pa.RecordBatch] = []
        # Behind the last whole batch may stand one that is still on its way to the disk.
        with (
            # A damaged name is not even UTF-8, which is a ValueError.
            contextlib.suppress(pa.ArrowException, EOFError, OSError, ValueError),
            # No mapping: a piece that the disk did not take is cut off again under it.
            pa.OSFile(str(self._path), "r") as source,
        ):
            if self._offset == 0:
                schema = pa.ipc.open_stream(source).schema
                common = step_schema()
                if schema.names[: len(common)] != common.names:
                    return []  # not a run's steps
                self._schema, self._offset = schema, source.tell()
            source.seek(self._offset)
            while len(batches) < _AT_ONCE:
                message = pa.ipc.read_message(source)
                batch = pa.ipc.read_record_batch(message, self._schema)
                self._begins.append(self._following)
                self._places.append((self._part, self._offset))
                self._following += batch.num_rows
                self._offset = source.tell()
                batches.append(batch)
        return batches

    def _go_on(self) -> None:
        """Go on to the next part, where this one has ended and there is one."""
        following = self._folder / part_name(STEPS_FILE, self._part + 1)
        # A full disk may have kept the end from this one.
        with contextlib.suppress(OSError):
            if following.stat().st_size and self.unread_bytes <= len(END_OF_STREAM):
                self._part, self._offset = self._part + 1, 0

    def _read_again(self, part: int, offset: int) -> pa.RecordBatch:
        with pa.OSFile(str(self._folder / part_name(STEPS_FILE, part)), "r") as source:
            source.seek(offset)
            return pa.ipc.read_record_batch(pa.ipc.read_message(source), self._schema)

    def _add(self, rows: Array) -> None:
        if not self.columns:
            self.columns = (*self._schema.names, *FLAGS, FORCE_ERROR)
            self._open = rows[:0]
        self.steps += len(rows)
        if self._newest and len(self._newest[-1]) < _PIECE:
            self._newest[-1] = np.concatenate([self._newest[-1], rows])
        else:
            self._newest.append(rows)
        while sum(map(len, self._newest)) - len(self._newest[0]) >= _NEWEST:
            self._newest.popleft()
        rows = np.concatenate([self._open, rows])
        whole = len(rows) // BUCKET * BUCKET
        if whole:
            buckets = rows[:whole].reshape(-1, BUCKET, rows.shape[1])
            self._least.add(np.fmin.reduce(buckets, axis=1))
            self._largest.add(np.fmax.reduce(buckets, axis=1))
        self._open = rows[whole:].copy()

    def _newest_rows(self, begin: int, end: int) -> Array:
        """Rows of the newest steps."""
        rows: list[Array] = []
        first = 0
        for piece in self._newest:
            if first < end and first + len(piece) > begin:
                rows.append(piece[max(begin - first, 0) : end - first])
            first += len(piece)
        return np.concatenate(rows)

    def _bucket(self, t_ns: float) -> int:
        """Number of the bucket that a time is in."""
        return max(0, int(np.searchsorted(self._least.rows[:, 0], t_ns, side="right")) - 1)


class _Growing:
    """Rows that are added to; twice the room is taken where there is no more."""

    def __init__(self) -> None:
        self._room = np.zeros((0, 1))
        self._count = 0

    @property
    def rows(self) -> Array:
        return self._room[: self._count]

    def add(self, rows: Array) -> None:
        count = self._count + len(rows)
        if count > len(self._room):
            room = np.zeros((max(2 * len(self._room), count, 1024), rows.shape[1]))
            room[: self._count] = self.rows
            self._room = room
        self._room[self._count : count] = rows
        self._count = count


def _matrix(table: pa.Table) -> Array:
    columns = [np.asarray(column.to_numpy(), np.float64) for column in table.columns]
    mode = columns[table.schema.names.index("mode")]
    is_apart = np.isin(mode, _APART)
    for index, name in enumerate(table.schema.names):
        if name.endswith(_INNOVATION):
            columns[index] = np.where(is_apart, np.nan, columns[index])
    flags = table.column("flags").to_numpy()
    bits = [(flags & bit > 0).astype(np.float64) for bit in FLAGS.values()]
    return np.column_stack([*columns, *bits, _force_error(table.schema.names, columns)])


def _force_error(names: Sequence[str], columns: Sequence[Array]) -> Array:
    struts = [name.removesuffix(_FORCE) for name in names if name.endswith(_FORCE)]
    if len(struts) != 1 or _CELL not in names:
        return np.full(len(columns[0]), np.nan)
    force, valid, cell = (
        columns[names.index(name)] for name in (struts[0] + _FORCE, f"{struts[0]}.valid", _CELL)
    )
    return np.where(valid == 1.0, force - cell, np.nan)


def _select_columns(rows: Array, columns: Sequence[int]) -> Array:
    """Columns of rows, shape (columns, N); NaN where there is none."""
    found = np.full((len(columns), len(rows)), np.nan)
    for row, column in enumerate(columns):
        if column >= 0:
            found[row] = rows[:, column]
    return found


def _thin(t_ns: Array, least: Array, largest: Array, points: int, steps: int) -> Stretch:
    """Least and largest values of some buckets, one after the other."""
    edges = np.linspace(0, len(t_ns), min(points, len(t_ns)) + 1).astype(np.intp)[:-1]
    low = np.fmin.reduceat(least, edges, axis=1)
    high = np.fmax.reduceat(largest, edges, axis=1)
    begin_s = t_ns[edges] * 1e-9
    middle_s = 0.5 * (begin_s + np.append(begin_s[1:], t_ns[-1] * 1e-9))
    t_s = np.column_stack([begin_s, middle_s]).ravel()
    # In the order in which the curve passes them, so that a slope is no staircase.
    falls = np.diff(low + high, axis=1, append=np.nan) < 0.0
    low, high = np.where(falls, high, low), np.where(falls, low, high)
    values = np.stack([low, high], axis=2).reshape(len(low), -1)
    return Stretch(t_s, values, steps)
