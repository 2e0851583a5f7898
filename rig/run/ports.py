"""Where frames come from and go to while a run is live, and the state of the bus."""

from collections.abc import Sequence
from typing import cast

from can_dbc.frame import Frame
from rig.bridge.counts import NO_TIMING, Conditions, Levels, TimingFigures
from rig.bus.bus import Bus
from rig.bus.link import Link
from rig.bus.secoc import Authenticator
from rig.log.writer import RunWriter
from rig.machine.clock import Clock
from rig.run.loop import Port
from rig.run.operator import Operator
from rig.run.timing import Timing
from rig.simulated_bench.bench import SimulatedBench

_NO_CONDITIONS = Conditions()
_CATCHING_UP = 4
"""How often a simulated bench catches up before the first tick, each time in less time."""

_TIMING_EVERY_NS = 500_000_000
"""How often percentiles are taken of the timing, for the bus."""


class BusPort:
    """A port on a bus. Every tick reports a fault of the bus; it does not stop the loop."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.operator = Operator()
        self._waiting = self.operator.waiting
        self._refused = 0

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        """Frames that have come since the last tick."""
        link = self.link
        frames = link.receive(t_ns)
        failures = link.authentication_failures
        if link.fault is None and not self._waiting and failures == self._refused:
            return frames, _NO_CONDITIONS
        bus_fault = link.fault is not None or failures > self._refused
        self._refused = failures
        return frames, Conditions(request=self.operator.take(), bus_fault=bus_fault)

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Send; returns what was sent."""
        return self.link.send(frames)


class InformedPort:
    """A port whose conditions hold the state of the log too, and how well the rate is kept."""

    def __init__(self, port: Port, log: RunWriter, timing: Timing) -> None:
        self._port = port
        self._log = log
        self._timing = timing
        self._latest = NO_TIMING
        self._calm = _NO_CONDITIONS
        self._again_ns = _TIMING_EVERY_NS
        self.send = port.send

    def look(self, t_ns: int) -> None:
        """Take the percentiles again, if it is time; done in a tick it would delay that tick."""
        if t_ns >= self._again_ns:
            self._again_ns = t_ns + _TIMING_EVERY_NS
            self._latest = _figures(self._timing)
            self._calm = Conditions(timing=self._latest)

    @property
    def conditions(self) -> Conditions:
        """State of log and timing, without anything of the bus."""
        return self._calm._replace(log_fault=self._log.fault is not None)

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        """Frames of the port, with the state of log and timing."""
        frames, conditions = self._port.receive(t_ns)
        if conditions is _NO_CONDITIONS and self._log.fault is None:
            return frames, self._calm
        log_fault = self._log.fault is not None
        return frames, conditions._replace(log_fault=log_fault, timing=self._latest)


def _figures(timing: Timing) -> TimingFigures:
    gap_s = float(timing.extremes_ns[2]) * 1e-9
    return TimingFigures(_levels_s(timing.lateness_us()), _levels_s(timing.work_us()), gap_s)


def _levels_s(levels_us: dict[str, float]) -> Levels:
    """All zero before the first tick."""
    return cast("Levels", tuple(value * 1e-6 for value in levels_us.values()) or (0.0,) * 4)


class BenchOnBus:
    """A port with a simulated bench at the other end of its bus.

    While the loop waits the bench sends what is due up to the tick that is awaited, so that its own
    work delays no tick.
    """

    def __init__(
        self,
        bench: SimulatedBench,
        bench_bus: Bus,
        port: BusPort,
        authenticator: Authenticator | None,
    ) -> None:
        self._bench = bench
        self._bench_bus = bench_bus
        self._secured = None if authenticator is None else authenticator.secure
        self._port = port
        self._sent_ns = -1
        self.send = port.send

    def begin(self, clock: Clock) -> None:
        """Discard what the bench sent while the run was set up."""
        for _ in range(_CATCHING_UP):
            now_ns = clock.now_ns()
            self.send_up_to(now_ns)
            self._port.receive(now_ns)

    def send_up_to(self, t_ns: int) -> None:
        """Send what is due; at most once up to a time."""
        if t_ns <= self._sent_ns:
            return
        self._sent_ns = t_ns
        for frame in self._bench.update(t_ns)[0]:
            self._bench_bus.send(frame if self._secured is None else self._secured(frame))
        self._bench_bus.receive()  # the bench does not use what the bridge sends

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        """Frames that have come since the last tick."""
        self.send_up_to(t_ns)  # ticks that were missed
        return self._port.receive(t_ns)
