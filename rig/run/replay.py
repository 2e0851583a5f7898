"""A run computed again from its log, through the loop that ran live, and compared bit for bit.

The ticks, the frames of each and what the loop knew come from the log; nothing is sent.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.bridge.bridge import TickResult
from rig.bridge.counts import Conditions
from rig.log.checksums import Damage, refuse_damage
from rig.log.errors import LogError
from rig.log.file_names import RUN_FILE
from rig.log.reader import RUN_SCHEMA, RunFolder, last_frame_ns, read_run
from rig.log.received_frames import FrameColumns, read_frame_columns
from rig.log.step_columns import BUS_FAULT, LOG_FAULT, LogColumns, Step, StepRows, request_of
from rig.plan.build import build_bridge
from rig.plan.config import VirtualSensorConfig
from rig.plan.load import plan_of_header
from rig.plan.plan import Plan
from rig.run.changed_settings import changes_for_replay, no_changes
from rig.run.loop import Progress, Tick, no_progress, run

_TICKS_AT_ONCE = 4096
"""Ticks whose frames and steps are objects in memory at once."""

_MOST_LOST_A_FRAME = 1000
"""Ticks without a step for each frame after the last step, beyond which times cannot be right."""

_NO_CONDITIONS = Conditions()


@dataclass(frozen=True)
class Replay:
    """A run computed again from its log, and how many of its steps differ in any bit."""

    steps: pa.Table
    logged: int
    different: int
    first_different_ns: int | None
    refused_frames: int
    damage: tuple[Damage, ...] = ()


@dataclass(frozen=True)
class LoggedTicks:
    """Ticks of a run, with what the loop knew at each; all of shape (ticks,)."""

    t_ns: NDArray[np.int64]
    overruns: NDArray[np.int64]
    received: NDArray[np.int64]
    flags: NDArray[np.int64]


def replay(
    folder: Path,
    *,
    plan: Plan | None = None,
    sensors: Mapping[str, VirtualSensorConfig] = MappingProxyType({}),
    progress: Progress = no_progress,
) -> Replay:
    """Compute a run again from its frames, and compare it with its steps.

    Ticks whose steps a kill took are those of the rate, up to the last frame.

    `plan` may be another one, such as one with a corrected model or other gains; `sensors` are
    virtual sensors in addition to those of the run, whose columns come last.

    Raises:
        InputError: The run is damaged.
    """
    run_folder = read_run(folder)
    schema = run_folder.header["schema"]
    if schema != RUN_SCHEMA:
        raise InputError(
            f"{folder / RUN_FILE}: schema: {schema}: expected {RUN_SCHEMA}: an estimate was valid "
            "before it had settled; replay the run with the version that logged it (0.2)"
        )
    own = plan_of_header(folder, run_folder.header)
    is_own, plan = plan is None, plan or own
    if sensors:
        for name in sensors:
            if name in plan.config.virtual_sensors:
                raise InputError(f"{folder}: has a virtual sensor {name}, expected another name")
        every = {**plan.config.virtual_sensors, **sensors}
        plan = plan.with_config(plan.config.model_copy(update={"virtual_sensors": every}))
    bridge = build_bridge(plan, sending=False)
    try:
        frames = read_frame_columns(run_folder.frame_files, run_folder.epoch_ns)
    except LogError:
        refuse_damage(folder, run_folder.damage)
        raise
    ticks = _ticks(run_folder, frames, plan.period_ns)
    columns = LogColumns(plan.strut_names, plan.channels, plan.virtual_columns)
    rows = StepRows(columns.names)
    batches: list[pa.RecordBatch] = []

    def keep(
        _received: Sequence[Frame], _sent: Sequence[Frame], result: TickResult, step: Step
    ) -> None:
        rows.append(step)
        progress(step.t_ns, result.output.mode)

    def make_batch() -> None:
        batches.append(rows.batch())
        rows.clear()

    port = _LogPort(frames, ticks)
    # With another plan the run's own changes would undo what is tried.
    changes = changes_for_replay(folder, own, bridge) if is_own else no_changes
    again = port.ticks(make_batch)
    last = deque(run(bridge, again, port, keep, columns, changes), maxlen=1)
    steps = pa.Table.from_batches(batches, schema=rows.schema)
    different = _find_differences(run_folder.logged_steps, steps)
    return Replay(
        steps,
        run_folder.steps.num_rows,
        len(different),
        int(ticks.t_ns[different[0]]) if len(different) else None,
        last[0].counts.refused if last else 0,
        run_folder.damage,
    )


class _LogPort:
    """The frames of a log, tick by tick, with what the loop knew."""

    def __init__(self, frames: FrameColumns, ticks: LoggedTicks) -> None:
        self._frames = frames
        self._ticks = ticks
        self._current: tuple[Sequence[Frame], Conditions] = (), _NO_CONDITIONS

    def ticks(self, end_part: Callable[[], None]) -> Iterator[Tick]:
        """The ticks, in parts whose frames are in memory at once; each part has an end."""
        logged = self._ticks
        begins = np.concatenate([[0], np.cumsum(logged.received)])
        for first in range(0, len(logged.t_ns), _TICKS_AT_ONCE):
            part = slice(first, first + _TICKS_AT_ONCE)
            ends = begins[1:][part]
            begin = int(begins[first])
            frames = list(self._frames.between(begin, int(ends[-1])))
            columns = (logged.t_ns[part], logged.overruns[part], logged.flags[part], ends - begin)
            begin = 0
            for t_ns, overruns, flags, end in zip(*(c.tolist() for c in columns), strict=True):
                conditions = _conditions(flags) if flags else _NO_CONDITIONS
                self._current = frames[begin:end], conditions
                begin = end
                yield Tick(t_ns, overruns)
            end_part()

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        """Frames that the tick received, and what the loop knew."""
        _ = t_ns  # the ticks come in their order
        return self._current

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Nothing is sent."""
        return frames


def _conditions(flags: int) -> Conditions:
    return Conditions(
        request=request_of(flags),
        bus_fault=bool(flags & BUS_FAULT),
        log_fault=bool(flags & LOG_FAULT),
    )


def _ticks(log: RunFolder, frames: FrameColumns, period_ns: int) -> LoggedTicks:
    """Logged ticks whose frames are there, then those of the rate up to the last frame."""
    t_ns, overruns, received, flags = (
        np.asarray(log.steps.column(name).to_numpy(), dtype=np.int64)
        for name in ("t_ns", "overruns", "received", "flags")
    )
    if (received < 0).any() or (np.diff(t_ns) <= 0).any():
        raise InputError(
            f"{log.folder}: steps.arrow: expected times that rise and numbers of frames received"
        )
    complete = int(np.searchsorted(np.cumsum(received), len(frames.t_ns), side="right"))
    t_ns, overruns, received, flags = (
        column[:complete] for column in (t_ns, overruns, received, flags)
    )
    used = int(received.sum())
    begin_ns = int(t_ns[-1]) + period_ns if complete else 0
    end_ns = last_frame_ns(log.folder, log.epoch_ns) + 1
    if complete < log.steps.num_rows:
        end_ns = begin_ns  # the next tick's frames are not all there
    if (end_ns - begin_ns) // period_ns > _MOST_LOST_A_FRAME * (len(frames.t_ns) - used + 10):
        raise InputError(
            f"{log.folder}: the last frame is {(end_ns - begin_ns) * 1e-9:.0f} s after the last "
            "step, expected a log whose times belong together"
        )
    lost_ns = np.arange(begin_ns, end_ns, period_ns, dtype=np.int64)
    # A frame comes with the first tick after it, and after the frames before it.
    came_ns = np.maximum.accumulate(frames.t_ns[used:])
    came = np.searchsorted(came_ns, lost_ns, side="right")
    nothing = np.zeros(len(lost_ns), dtype=np.int64)
    return LoggedTicks(
        np.concatenate([t_ns, lost_ns]),
        np.concatenate([overruns, nothing]),
        np.concatenate([received, np.diff(came, prepend=0)]),
        np.concatenate([flags, nothing]),
    )


def _find_differences(logged: pa.Table, again: pa.Table) -> NDArray[np.intp]:
    """Indices of logged steps that are not the same bit for bit."""
    count = min(logged.num_rows, again.num_rows)
    unequal = np.zeros(count, dtype=np.bool_)
    if count == 0:
        return np.flatnonzero(unequal)
    names = logged.schema.names
    # A version that logged less has fewer columns.
    if not set(names) <= set(again.schema.names) or logged.schema != again.select(names).schema:
        raise InputError("steps.arrow: its columns are not those of the run's struts and signals")
    for name in logged.schema.names:
        a, b = (table.column(name).to_numpy()[:count] for table in (logged, again))
        unequal |= a.view(f"V{a.itemsize}") != b.view(f"V{b.itemsize}")
    return np.flatnonzero(unequal)
