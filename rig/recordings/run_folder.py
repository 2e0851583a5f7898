"""Recordings in the folders of runs: what the bench sent, on the time of the first height."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from can_dbc.addressing import Directory
from can_dbc.codec import decode_log
from can_dbc.database import Message
from can_dbc.errors import InputError
from can_dbc.protection import check_crc_log
from can_dbc.units import Dimension
from rig.bridge.incoming_messages import compile_follower_of
from rig.channels.channel import Channel
from rig.channels.measured_quantities import HEIGHT, LOAD_CELL_FORCE, TEMPERATURE
from rig.log.checksums import refuse_damage
from rig.log.reader import RunFolder
from rig.log.reader import read_run as read_run_folder
from rig.plan.load import plan_of_header
from rig.plan.plan import Plan
from rig.recordings.counted_times import counted_times_s
from rig.recordings.gaps import are_timed, find_gaps
from rig.recordings.recording import Array, RecordedInput, Recording, RecordingError

_OFF_GRID = 0.4
"""Cycles by which an arrival may be off the grid of its cycle time."""


def read_run(folder: Path) -> Recording:
    """What the bench sent in a run, on the time of the first strut's height.

    Frames with a wrong CRC or length are ignored; single missing heights are NaN, the other
    channels are linear between their samples.

    Raises:
        DamageError: Its frames or steps have changed since they were written.
        InputError: The run is damaged, or holds no height.
        RecordingError: It holds heights alone.
    """
    run = read_run_folder(folder)
    refuse_damage(folder, run.damage)
    plan = plan_of_header(folder, run.header)
    cell, temperature = map(plan.bench_channel, (LOAD_CELL_FORCE, TEMPERATURE))
    payloads = _payloads(run, plan.channels)
    heights = [_samples(payloads, channel) for channel in plan.heights]
    for channel, (t_s, _) in zip(plan.heights, heights, strict=True):
        if len(t_s) < 2:
            raise InputError(
                f"{folder}: holds no {_message(channel).name} with the height of strut "
                f"{channel.name}, expected a run in which the bench sent"
            )
    t_s = heights[0][0]
    half_s = 0.5 * float(np.median(np.diff(t_s)))
    inputs, cell_n = _inputs(payloads, plan, t_s), _resample(payloads, cell, t_s)
    if cell_n is None and not inputs:
        raise RecordingError(
            f"{folder}: has heights alone, expected signals.applied_force, signals.inputs or "
            "signals.load_cell_force in its configuration, and frames of it"
        )
    # The bus carries one load cell; with several struts its strut is not known.
    return Recording(
        folder.name,
        t_s,
        np.column_stack([_nearest(t_s, *height, half_s) for height in heights]),
        inputs,
        None if cell_n is None or len(heights) > 1 else cell_n[:, np.newaxis],
        _resample(payloads, temperature, t_s),
        delays_s=_delays_s(plan, cell),
    )


def _delays_s(plan: Plan, cell: Channel | None) -> dict[str, float]:
    """Configured delays of what a diagnosis reads, by the names that it has for the channels."""
    names = [strut.name for strut in plan.model.struts]
    delays = {f"{HEIGHT.column}:{names[it.strut]}": it.delay_ns for it in plan.heights}
    if cell is not None:
        delays[f"{LOAD_CELL_FORCE.column}:{names[-1]}"] = cell.delay_ns
    for item in plan.inputs:
        if item.channel is not None:
            delays[f"{item.channel.quantity.column}:{item.name}"] = item.channel.delay_ns
    return {name: delay_ns * 1e-9 for name, delay_ns in delays.items() if delay_ns}


def read_channel(run: RunFolder, channel: Channel) -> tuple[Array, Array]:
    """Sample times in s and values in SI of one channel of a run, both of shape (n,)."""
    return _samples(_payloads(run, [channel]), channel)


_Payloads = dict[str, tuple[NDArray[np.int64], NDArray[np.uint8]]]


def _message(channel: Channel) -> Message:
    if channel.message is None:
        raise ValueError(f"{channel.key}: expected a channel on a bus")
    return channel.message


def _payloads(run: RunFolder, channels: Iterable[Channel]) -> _Payloads:
    """Times and payloads of every received message, wrong lengths left out."""
    messages = sorted(
        {item.name: item for item in map(_message, channels)}.values(),
        key=lambda item: item.name,
    )
    directory = Directory(messages)
    times: list[list[int]] = [[] for _ in messages]
    data: list[list[bytes]] = [[] for _ in messages]
    for frame, direction in run.frames():
        index = directory.index_of(frame.arbitration_id, frame.is_extended)
        if index is None or direction != "R" or frame.is_error:
            continue
        if len(frame.data) == messages[index].length_bytes:
            times[index].append(frame.t_ns)
            data[index].append(frame.data)
    return {
        message.name: (
            np.array(times[index], dtype=np.int64),
            np.frombuffer(b"".join(data[index]), dtype=np.uint8).reshape(-1, message.length_bytes),
        )
        for index, message in enumerate(messages)
    }


def _samples(payloads: _Payloads, channel: Channel) -> tuple[Array, Array]:
    """Sample times in s and values of one channel."""
    message = _message(channel)
    t_ns, data = payloads[message.name]
    good = np.ones(len(data), dtype=bool)
    if message.protection is not None:
        good = check_crc_log(data, message.protection)
    signal = channel.signal
    values = decode_log(message, [signal], [channel.quantity.dimension], data)[signal]
    good &= np.isfinite(values)
    valid = channel.valid
    if valid is not None:
        validity = decode_log(message, [valid.signal], [Dimension.NUMBER], data)[valid.signal]
        good &= validity == valid.value
    counter = channel.counter
    if message.protection is not None:
        counter = message.protection.counter_signal
    if channel.time:
        stamps_s = decode_log(message, [channel.time], [Dimension.TIME], data)[channel.time]
        good &= np.isfinite(stamps_s)
        times_s = _stamped_times_s(t_ns[good], stamps_s[good], channel)
    else:
        times_s = None
        if counter and message.cycle_time_ns is not None:
            counts = decode_log(message, [counter], [Dimension.NUMBER], data)[counter][good]
            # It goes round behind its largest value, which a profile may forbid.
            modulus = int(counts.max(initial=0.0)) + 1
            times_s = counted_times_s(t_ns[good], counts, modulus, message.cycle_time_ns)
        if times_s is None:
            times_s = _grid_times_s(t_ns[good], message.cycle_time_ns)
    if times_s is None:
        good[good] = are_timed(t_ns[good])
        times_s = np.asarray(t_ns[good] * 1e-9, dtype=np.float64)
    t_s, first = np.unique(times_s, return_index=True)
    return t_s - channel.delay_ns * 1e-9, values[good][first]


def _stamped_times_s(t_ns: NDArray[np.int64], stamps_s: Array, channel: Channel) -> Array:
    """Times of sampling in s by the sender's time in the frames, as the bridge followed it."""
    follow = compile_follower_of(channel, _message(channel))
    times_ns: list[int] = []
    clock = None
    for arrival_ns, stamp_s in zip(t_ns.tolist(), stamps_s.tolist(), strict=True):
        if follow is not None:
            clock = follow(clock, arrival_ns, round(stamp_s * 1e9))
            times_ns.append(clock.due_ns)
    return np.array(times_ns) * 1e-9


def _grid_times_s(t_ns: NDArray[np.int64], cycle_ns: int | None) -> Array | None:
    """Times of sampling in s on the grid of the cycle time; None if the arrivals do not fit it."""
    if cycle_ns is None or len(t_ns) == 0:
        return None
    index = np.rint((t_ns - t_ns[0]) / cycle_ns)
    jitter_ns = t_ns - t_ns[0] - index * cycle_ns
    if float(np.max(np.abs(jitter_ns - np.median(jitter_ns)))) > _OFF_GRID * cycle_ns:
        return None
    return np.asarray((t_ns[0] + np.median(jitter_ns) + index * cycle_ns) * 1e-9, dtype=np.float64)


def _inputs(payloads: _Payloads, plan: Plan, t_s: Array) -> dict[str, RecordedInput]:
    """What drove the bench, at some times, by the names of the model's inputs."""
    inputs: dict[str, RecordedInput] = {}
    for item in plan.inputs:
        channel = item.channel
        values = _resample(payloads, channel, t_s)
        if channel is not None and values is not None:
            acceleration = _resample(payloads, item.acceleration, t_s)
            gaps = find_gaps(*_samples(payloads, channel))
            inputs[item.name] = RecordedInput(channel.quantity, values, acceleration, gaps)
    return inputs


def _resample(payloads: _Payloads, channel: Channel | None, t_s: Array) -> Array | None:
    """Values of a channel at other times, linear between its samples; None where it has none."""
    if channel is None:
        return None
    own_t_s, values = _samples(payloads, channel)
    return np.interp(t_s, own_t_s, values) if len(own_t_s) else None


def _nearest(t_s: Array, own_t_s: Array, values: Array, half_s: float) -> Array:
    """Values at the times of another message; NaN where none is near."""
    at = np.clip(np.searchsorted(own_t_s, t_s - half_s), 0, len(own_t_s) - 1)
    return np.where(np.abs(own_t_s[at] - t_s) <= half_s, values[at], np.nan)
