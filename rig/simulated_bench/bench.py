"""The simulated bench on the bus: its sensors, and the frames that it sends.

`SimulatedBench.update(now_ns)` returns the frames that are due and the time of the next ones, so
that the caller owns the clock: a virtual one in lockstep, the real one otherwise. The bench
receives nothing: its motion is the same whatever the bridge does.
"""

import heapq
import math
from typing import NamedTuple

import numpy as np

from can_dbc.codec import Encoder, compile_encoder, si_range, si_round
from can_dbc.database import Database, Message, alive_counter
from can_dbc.frame import Frame
from can_dbc.protection import compile_protector
from can_dbc.units import Dimension
from rig.simulated_bench.assembly import assemble
from rig.simulated_bench.equations_of_motion import RECORD_COLUMNS
from rig.simulated_bench.schema import (
    BenchConfig,
    BenchConfigError,
    HeightSensor,
    LoadCell,
    Transmission,
)
from rig.simulated_bench.trajectory import BenchState, advance_records, regular_grid

RECORDS_AHEAD = 4
"""Records computed in one go: few enough not to delay a loop, enough to share the overhead."""

SHORTEST_GRID_NS = 10_000
"""Smallest common divisor of all periods that is accepted."""


class _Channel(NamedTuple):
    """One measured quantity: its column of a record, its offset, its noise and its source."""

    signal: str
    dimension: Dimension
    column: int
    offset: float
    noise_std: float
    noise: np.random.Generator

    def measure(self, record: list[float]) -> float:
        """The quantity, with offset and noise."""
        value = record[self.column] + self.offset
        if self.noise_std > 0.0:
            value += self.noise_std * self.noise.standard_normal()
        return value


class _Sender:
    """One message: its sensors, its counter, and the delay and loss of its frames."""

    def __init__(self, config: BenchConfig, index: int, database: Database) -> None:
        self.transmission = config.transmissions[index]
        self.message = database.message(self.transmission.message)
        self.period_ns = self.transmission.period_ns or _cycle_time_ns(self.message, index)
        self.next_sample_ns = 0
        self.saturated_frames = 0
        sources = np.random.SeedSequence([config.seed, index]).spawn(6)
        self._jitter, self._loss, *noises = [np.random.default_rng(source) for source in sources]
        self._channels = _channels(config, self.transmission, noises)
        self._modulus = self._first_s = self._round_s = 0.0
        further: list[tuple[str, Dimension]] = []
        if (name := self.transmission.counter) is not None:
            self._modulus = alive_counter(self.message, name).modulus
            further.append((name, Dimension.NUMBER))
        if (name := self.transmission.time) is not None:
            self._first_s, _ = si_range(self.message, name, Dimension.TIME)
            self._round_s = si_round(self.message, name, Dimension.TIME)
            further.append((name, Dimension.TIME))
        signals = [*((channel.signal, channel.dimension) for channel in self._channels), *further]
        names, dimensions = zip(*signals, strict=True)
        self._encode: Encoder = compile_encoder(self.message, names, dimensions)
        protection = self.message.protection
        self._protect = None if protection is None else compile_protector(protection)
        self._counter = 0
        self._last_sent_ns = 0

    def send(self, record: list[float], start_ns: int) -> Frame | None:
        """Build the frame of one sample; None if it is lost on the way."""
        values = [channel.measure(record) for channel in self._channels]
        if self._modulus:
            values.append(self._counter % self._modulus)
        if self._round_s:
            values.append(self._first_s + self.next_sample_ns * 1e-9 % self._round_s)
        data, saturated = self._encode(values)
        self.saturated_frames += bool(saturated)
        if self._protect is not None:
            data = self._protect(data, self._counter)
        self._counter += 1
        late_ns = self.transmission.latency_ns
        late_ns += round(self._jitter.random() * self.transmission.jitter_ns)
        # One sender's frames leave in the order in which they were queued.
        self._last_sent_ns = max(self.next_sample_ns + late_ns, self._last_sent_ns)
        self.next_sample_ns += self.period_ns
        if self._loss.random() < self.transmission.loss_probability:
            return None
        return Frame(
            start_ns + self._last_sent_ns,
            self.message.arbitration_id,
            bytes(data),
            is_extended=self.message.is_extended,
            is_fd=self.message.is_fd,
        )


class SimulatedBench:
    """A bench that moves by its own laws and reports on the bus.

    It starts at `start_ns` of the caller's clock.

    Raises:
        BenchConfigError: The bench sends nothing, or its periods have no useful common divisor.
        ValueError: The database lacks a message or signal that the configuration names.
    """

    def __init__(self, config: BenchConfig, database: Database, start_ns: int = 0) -> None:
        if not config.transmissions:
            raise BenchConfigError("transmissions is empty, expected one or more messages")
        self.config = config
        self._start_ns = start_ns
        self._senders = [_Sender(config, i, database) for i in range(len(config.transmissions))]
        period_ns = math.gcd(*(sender.period_ns for sender in self._senders))
        if period_ns < SHORTEST_GRID_NS:
            raise BenchConfigError(
                f"transmissions: the periods' common divisor is {period_ns} ns, "
                f"expected at least {SHORTEST_GRID_NS} ns"
            )
        self._period_ns = period_ns
        self._grid = regular_grid(config, period_ns)
        self._assembly = assemble(config)
        self._motion = BenchState(0, self._assembly.start)
        self._queue: list[tuple[int, int, int, Frame]] = []
        self._queued = 0
        self._advance()

    @property
    def saturated_frames(self) -> int:
        """Number of frames with a value outside its signal's range."""
        return sum(sender.saturated_frames for sender in self._senders)

    def update(self, now_ns: int) -> tuple[list[Frame], int]:
        """The frames that were sent up to a time on the caller's clock.

        Returns:
            The frames in the order of their transmission, each stamped with its time, and the
            earliest time at which another can be due.
        """
        elapsed_ns = now_ns - self._start_ns
        while (sender := self._next_sender()).next_sample_ns <= elapsed_ns:
            frame = sender.send(self._record(sender.next_sample_ns), self._start_ns)
            if frame is not None:
                self._queued += 1
                entry = (frame.t_ns, frame.arbitration_id, self._queued, frame)
                heapq.heappush(self._queue, entry)
        frames: list[Frame] = []
        while self._queue and self._queue[0][0] <= now_ns:
            frames.append(heapq.heappop(self._queue)[3])
        return frames, self._next_due_ns()

    def _record(self, elapsed_ns: int) -> list[float]:
        """Record of a time that is not before that of the last call."""
        index = elapsed_ns // self._period_ns
        while index >= self._motion.records:
            self._advance()
        # Counted from the end: the newest record is the last.
        record: list[float] = self._records[index - self._motion.records].tolist()
        return record

    def _advance(self) -> None:
        self._motion, self._records = advance_records(
            self._assembly, self._grid, self._motion, RECORDS_AHEAD
        )

    def _next_sender(self) -> _Sender:
        return min(self._senders, key=lambda sender: sender.next_sample_ns)

    def _next_due_ns(self) -> int:
        due_ns = self._start_ns + min(
            sender.next_sample_ns + sender.transmission.latency_ns for sender in self._senders
        )
        return min(due_ns, self._queue[0][0]) if self._queue else due_ns


def _cycle_time_ns(message: Message, index: int) -> int:
    if not message.cycle_time_ns:
        raise BenchConfigError(
            f"transmissions.{index}.period_ns is missing and the database gives {message.name} "
            "no cycle time, expected a period"
        )
    return message.cycle_time_ns


def _channels(
    config: BenchConfig, sent: Transmission, noises: list[np.random.Generator]
) -> list[_Channel]:
    struts = [strut.name for strut in config.struts]
    extra = RECORD_COLUMNS * len(struts)
    sensors = (
        (sent.height, Dimension.LENGTH, 0),
        (sent.applied_force, Dimension.FORCE, extra),
        (sent.strut_force, Dimension.FORCE, 2),
        (sent.temperature, Dimension.TEMPERATURE, extra + 2),
    )
    channels: list[_Channel] = []
    # Each quantity has its own source, so that one sensor's noise does not depend on another's.
    for (sensor, dimension, column), noise in zip(sensors, noises, strict=True):
        if sensor is not None:
            is_of_strut = isinstance(sensor, HeightSensor | LoadCell)
            first = RECORD_COLUMNS * struts.index(sensor.strut) if is_of_strut else 0
            at = first + column
            channels.append(
                _Channel(sensor.signal, dimension, at, sensor.offset, sensor.noise_std, noise)
            )
    return channels
