"""A run computed again from its log, and compared with it bit for bit.

The core is the one that ran live, step by step. What is done for the whole log at once is only what
stands around it: reading lines, checking and decoding frames. Sending is left out.
"""

from dataclasses import dataclass
from itertools import chain
from math import nan
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
from msgspec.structs import astuple, replace
from numpy.typing import NDArray

from can_dbc.codec import compile_decoder, decode_log
from can_dbc.database import load_database
from can_dbc.frame import Frame
from can_dbc.protection import SequenceState
from can_dbc.protection_log import in_sequence
from dart_model.spec import load_model
from rig.core.bridge import Bridge, BridgeState
from rig.core.messages import Conditions, Incoming, Quantity
from rig.core.types import Measurement, Mode, RigState, StepInput, StepOutput
from rig.inputs.errors import InputError
from rig.inputs.yaml_file import validated
from rig.io.frame_columns import FrameColumns, received_frames
from rig.io.run_log import (
    DBC_FILE,
    MODEL_FILE,
    RUN_FILE,
    RunFolder,
    last_frame_ns,
    read_run,
)
from rig.io.steps import step_schema
from rig.operation.assembly import build_bridge
from rig.operation.config import RunConfig
from rig.operation.loop import Progress
from rig.operation.setup import Setup, put_together

_CHUNK = 2048
"""Ticks whose objects are in memory at once."""

_MOST_LOST_A_FRAME = 1000
"""Ticks without a step for each frame after the last step, beyond which times cannot be right."""

_NOTHING = (nan,) * 7
"""Of a strut before the first measurements."""

_HOLD = Mode.HOLD
_pa = cast("Any", pa)


@dataclass(frozen=True)
class Replayed:
    """A run computed again from its log.

    Attributes:
        steps: Every step, as an Arrow table like that of the log.
        logged: How many steps the log holds.
        different: How many of them differ from the steps computed here in any bit.
        first_different_ns: Time of the first that differs.
        refused_frames: Frames refused in the replay.
    """

    steps: Any
    logged: int
    different: int
    first_different_ns: int | None
    refused_frames: int


@dataclass(frozen=True)
class Ticks:
    """Ticks of a run, with what the loop told the bridge, each of shape (ticks,).

    Attributes:
        t_ns: Time.
        overruns: Ticks missed before it.
        received: Frames received.
        flags: Conditions, as in the log.
    """

    t_ns: NDArray[np.int64]
    overruns: NDArray[np.int32]
    received: NDArray[np.int32]
    flags: NDArray[np.int8]


def setup_of_run(folder: Path) -> tuple[RunFolder, Setup]:
    """A logged run and the configuration it ran with.

    Raises:
        InputError: A file of the run is missing or damaged.
        DatabaseError: Its DBC is.
    """
    found = read_run(folder)
    config = validated(RunConfig, found.header.get("config"), f"{folder / RUN_FILE}: config")
    model = load_model(folder / MODEL_FILE)
    database = load_database(folder / DBC_FILE)
    return found, put_together(config, folder / RUN_FILE, model, database)


def replay(
    folder: Path, *, ready: Setup | None = None, progress: Progress = lambda _t, _mode: None
) -> Replayed:
    """Compute a run again from its frames, and compare it with its steps.

    Ticks whose steps a kill took are those of the rate, up to the last frame.

    Args:
        folder: Folder of the run.
        ready: Another configuration to replay with, e.g. with a corrected model or other gains.
        progress: Told of ticks now and then.

    Raises:
        InputError: The run is damaged.
    """
    found, own = setup_of_run(folder)
    ready = ready or own
    bridge = build_bridge(ready)
    frames = received_frames(found.frame_files, found.epoch_ns)
    ticks = _ticks(found, frames, ready.config.period_ns)
    log = _Log(bridge, frames, ticks)
    if ready.config.supervision.limits:
        log.plain[:] = False  # limits are the bridge's own business
    schema = step_schema(list(ready.config.observers))
    tables: list[Any] = []
    state = bridge.init(0)
    for start in range(0, len(ticks.t_ns), _CHUNK):
        part = slice(start, min(start + _CHUNK, len(ticks.t_ns)))
        state, inputs, outputs = _computed(bridge, state, log, part)
        tables.append(_table(ticks, part, inputs, outputs, schema))
        progress(state.rig.t_ns, state.rig.mode)
    steps = _pa.concat_tables(tables) if tables else schema.empty_table()
    different = _different(found.steps, steps)
    return Replayed(
        steps,
        found.steps.num_rows,
        len(different),
        int(ticks.t_ns[different[0]]) if len(different) else None,
        state.counts.refused,
    )


def _computed(
    bridge: Bridge, state: BridgeState, log: "_Log", part: slice
) -> tuple[BridgeState, list[StepInput], list[StepOutput]]:
    """Inputs and outputs of some ticks, and the bridge after them.

    Where frames simply follow each other the core is stepped with what they hold; any other tick
    is the bridge's.
    """
    inputs, outputs = log.inputs(part), list[StepOutput]()
    step = bridge.core.step
    tick = part.start
    while tick < part.stop:
        if not log.plain[tick] or not log.continues(state, tick):
            state, result = bridge.tick(state, *log.received(tick))
            inputs[tick - part.start] = result.step_input
            outputs.append(result.output)
            tick += 1
            continue
        odd = np.flatnonzero(~log.plain[tick : part.stop])
        end = tick + int(odd[0]) if len(odd) else part.stop
        rig, holds = state.rig, 0
        for given in inputs[tick - part.start : end - part.start]:
            rig, output = step(rig, given)
            outputs.append(output)
            holds += output.mode is _HOLD
        state = log.after(state, end, rig, holds)
        tick = end
    return state, inputs, outputs


def _ticks(found: RunFolder, frames: FrameColumns, period_ns: int) -> Ticks:
    """Logged ticks whose frames are there, then those of the rate up to the last frame."""
    count = len(frames.t_ns)
    if found.steps.num_rows == 0:
        t_ns, overruns, received, flags = (np.zeros(0, dtype=np.int64) for _ in range(4))
    else:
        t_ns, overruns, received, flags = (
            cast("NDArray[np.int64]", found.steps.column(name).to_numpy())
            for name in ("t_ns", "overruns", "received", "flags")
        )
    if (received < 0).any() or (np.diff(t_ns) <= 0).any():
        raise InputError(
            f"{found.folder}: steps.arrow: expected times that rise and numbers of frames received"
        )
    there = int(np.searchsorted(np.cumsum(received), count, side="right"))
    t_ns, overruns, received, flags = (
        column[:there] for column in (t_ns, overruns, received, flags)
    )
    used = int(received.sum())
    begin_ns = int(t_ns[-1]) + period_ns if there else 0
    end_ns = last_frame_ns(found.folder, found.epoch_ns) + 1
    if there < found.steps.num_rows:
        end_ns = begin_ns  # the next tick's frames are not all there
    if (end_ns - begin_ns) // period_ns > _MOST_LOST_A_FRAME * (count - used + 10):
        raise InputError(
            f"{found.folder}: the last frame is {(end_ns - begin_ns) * 1e-9:.0f} s after the last "
            "step, expected a log whose times belong together"
        )
    lost_ns = np.arange(begin_ns, end_ns, period_ns, dtype=np.int64)
    # A frame comes with the first tick after it, and after the frames before it.
    came_ns = np.maximum.accumulate(frames.t_ns[used:])
    came = np.searchsorted(came_ns, lost_ns, side="right")
    zeros = np.zeros(len(lost_ns), dtype=np.int64)
    return Ticks(
        np.concatenate([t_ns, lost_ns]),
        np.concatenate([overruns, zeros]).astype(np.int32),
        np.concatenate([received, np.diff(came, prepend=0)]).astype(np.int32),
        np.concatenate([flags, zeros]).astype(np.int8),
    )


@dataclass(frozen=True)
class _Received:
    """Frames of one message.

    Attributes:
        tick: The tick that received each, shape (n,).
        t_ns: Time of arrival, shape (n,).
        counter: Counter, or zero for an unprotected message, shape (n,).
        values: Values in SI, in the order of the message's targets, shape (n, targets).
        latest: The last frame in each tick, -1 where there is none, shape (ticks,).
    """

    tick: NDArray[np.intp]
    t_ns: NDArray[np.int64]
    counter: NDArray[np.int64]
    values: NDArray[np.float64]
    latest: NDArray[np.intp]


class _Log:
    """What a bridge is given, tick by tick, checked and decoded at once."""

    def __init__(self, bridge: Bridge, frames: FrameColumns, ticks: Ticks) -> None:
        self._struts = bridge.struts
        self._incoming = bridge.incoming
        self._frames = frames
        self._ticks = ticks
        self._ends = np.cumsum(ticks.received)
        self.plain: NDArray[np.bool_] = (ticks.flags == 0) & (ticks.overruns == 0)
        """Ticks whose frames all follow the ones before, at most one of each message."""
        tick_of = np.repeat(np.arange(len(ticks.t_ns)), ticks.received)
        unknown = np.ones(len(tick_of), dtype=np.bool_)
        self._messages = [self._read(item, tick_of, unknown) for item in bridge.incoming]
        self.plain[tick_of[unknown]] = False

    def _read(
        self, item: Incoming, tick_of: NDArray[np.intp], unknown: NDArray[np.bool_]
    ) -> _Received:
        message, frames, count = item.message, self._frames, len(self._ticks.t_ns)
        of_message = (frames.arbitration_id == message.arbitration_id) & ~frames.is_error
        of_message &= frames.is_extended == message.is_extended
        number = np.flatnonzero(of_message[: len(tick_of)])
        unknown[number] = False
        tick, payload = tick_of[number], frames.payload[number]
        length, t_ns = frames.length[number], frames.t_ns[number]
        counter = np.zeros(len(number), dtype=np.int64)
        if item.message.protection is None:
            good = length == message.length_bytes
        else:
            good = in_sequence(payload, length, t_ns, item.message.protection)
            if payload.shape[1] > 1:
                counter = (payload[:, 1] & 0x0F).astype(np.int64)
        values, has_values = _decoded(item, payload)
        self.plain[tick[~(good & has_values)]] = False
        self.plain[np.bincount(tick, minlength=count) > 1] = False
        latest = np.full(count, -1, dtype=np.intp)
        latest[tick] = np.arange(len(tick))
        return _Received(tick, t_ns, counter, values, latest)

    def continues(self, state: BridgeState, tick: int) -> bool:
        """Whether the bridge accepted the last frame of every message before a tick."""
        for index, found in enumerate(self._messages):
            last = int(np.searchsorted(found.tick, tick)) - 1
            sequence = state.sequences[index]
            if last >= 0 and self._incoming[index].message.protection is not None:
                expected = int(found.counter[last]), int(found.t_ns[last])
                if (sequence.counter, sequence.t_ns) != expected:
                    return False
        return True

    def after(self, state: BridgeState, tick: int, rig: RigState, holds: int) -> BridgeState:
        """The bridge before a tick, after plain ones that ended with `rig`."""
        sequences = list(state.sequences)
        for index, found in enumerate(self._messages):
            last = int(np.searchsorted(found.tick, tick)) - 1
            if last >= 0 and self._incoming[index].message.protection is not None:
                sequences[index] = SequenceState(int(found.counter[last]), int(found.t_ns[last]))
        ledger, counts = state.ledger, state.counts
        if holds:
            ledger = replace(ledger, counts=counts._replace(stale=counts.stale + holds))
        return replace(state, rig=rig, sequences=tuple(sequences), ledger=ledger)

    def received(self, tick: int) -> tuple[int, list[Frame], Conditions]:
        """Time, frames and conditions of a tick."""
        frames, ticks = self._frames, self._ticks
        end = int(self._ends[tick])
        received = [
            Frame(
                int(frames.t_ns[number]),
                int(frames.arbitration_id[number]),
                frames.payload[number, : frames.length[number]].tobytes(),
                is_extended=bool(frames.is_extended[number]),
                is_error=bool(frames.is_error[number]),
            )
            for number in range(end - int(ticks.received[tick]), end)
        ]
        flags = int(ticks.flags[tick])
        conditions = Conditions(
            int(ticks.overruns[tick]), bool(flags & 1), bool(flags & 2), bool(flags & 4)
        )
        return int(ticks.t_ns[tick]), received, conditions

    def inputs(self, part: slice) -> list[StepInput]:
        """What the core is given in plain ticks; of no meaning in others."""
        t_ns = self._ticks.t_ns[part]
        nothing: list[Any] = [None] * len(t_ns)
        heights: list[list[Any]] = [nothing] * self._struts
        others: dict[Quantity, list[Any]] = {}
        for item, found in zip(self._incoming, self._messages, strict=True):
            if len(found.tick) == 0:
                continue
            latest = found.latest[part]
            came = (latest >= 0).tolist()
            arrived = np.minimum(found.t_ns[latest], t_ns).tolist()
            for column, target in enumerate(item.targets):
                values = found.values[latest, column].tolist()
                if target.quantity is Quantity.HEIGHT:
                    heights[target.strut] = [
                        Measurement(value, t) if new else None
                        for value, t, new in zip(values, arrived, came, strict=True)
                    ]
                else:
                    others[target.quantity] = [
                        value if new else None for value, new in zip(values, came, strict=True)
                    ]
        columns = (
            t_ns.tolist(),
            zip(*heights, strict=True),
            others.get(Quantity.APPLIED_FORCE, nothing),
            others.get(Quantity.TEMPERATURE, nothing),
            [False] * len(t_ns),
            others.get(Quantity.LOAD_CELL_FORCE, nothing),
        )
        return [StepInput(*given) for given in zip(*columns, strict=True)]


def _decoded(
    item: Incoming, payloads: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Values in the order of the targets, and which frames have them."""
    message = item.message
    names = [target.signal for target in item.targets]
    length, count = message.length_bytes, len(payloads)
    if payloads.shape[1] < length:
        return np.full((count, len(names)), nan), np.zeros(count, dtype=np.bool_)
    dimensions = [target.quantity.dimension for target in item.targets]
    if any(message.signal(name).multiplexer is not None for name in names):
        decode = compile_decoder(message, names, dimensions)
        each = [decode(payload[:length].tobytes()) for payload in payloads]
        nothing = (nan,) * len(names)
        values = np.array([values or nothing for values in each], dtype=np.float64)
        has_values = np.array([values is not None for values in each], dtype=np.bool_)
        return values.reshape(-1, len(names)), has_values
    columns = decode_log(message, names, dimensions, np.ascontiguousarray(payloads[:, :length]))
    values = np.column_stack([columns[name] for name in names])
    return values, np.ones(count, dtype=np.bool_)


def _table(
    ticks: Ticks,
    part: slice,
    inputs: list[StepInput],
    outputs: list[StepOutput],
    schema: Any,
) -> Any:
    """Steps as the loop logs them."""
    columns: list[Any] = [
        ticks.t_ns[part],
        ticks.overruns[part],
        ticks.received[part],
        np.array([int(output.mode) for output in outputs], dtype=np.int8),
        ticks.flags[part],
        np.array([nan if x.applied_force_n is None else x.applied_force_n for x in inputs]),
        np.array([nan if x.temperature_c is None else x.temperature_c for x in inputs]),
    ]
    for strut in range(len(inputs[0].heights)):
        measured = [item.heights[strut] for item in inputs]
        columns.append(np.array([nan if x is None else x.height_m for x in measured]))
        columns.append(np.array([nan if x is None else float(x.t_ns) for x in measured]))
        published = [astuple(item.struts[strut]) if item.struts else _NOTHING for item in outputs]
        numbers = np.fromiter(chain.from_iterable(published), np.float64, 7 * len(published))
        columns += list(numbers.reshape(-1, 7).T)
    arrays = [_pa.array(column) for column in columns]
    return _pa.Table.from_arrays(arrays, schema=schema)


def _different(logged: Any, again: Any) -> NDArray[np.intp]:
    """Indices of logged steps that are not the same bit for bit."""
    count = min(logged.num_rows, again.num_rows)
    unequal = np.zeros(count, dtype=np.bool_)
    if count == 0:
        return np.flatnonzero(unequal)
    if logged.schema != again.schema:
        raise InputError("steps.arrow: its columns are not those of the run's struts")
    for name in logged.schema.names:
        a, b = (table.column(name).to_numpy()[:count] for table in (logged, again))
        unequal |= a.view(f"V{a.itemsize}") != b.view(f"V{b.itemsize}")
    return np.flatnonzero(unequal)
