"""A run, put together: on a bus, or with a simulated bench."""

import contextlib
import hashlib
import platform
import shutil
import signal
import threading
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import cast

from can_dbc.database import DEFAULT_DATABASE, load_database
from can_dbc.frame import Frame
from dart_model.spec import copy_skeleton, dump_model
from dart_model.yaml_file import InputError
from rig.bench.schema import BenchConfig
from rig.bench.simulated import Bench
from rig.config import RunConfig, Setup, build_bridge, load_authentication
from rig.core.bridge import Bridge, BridgeState, TickResult
from rig.core.messages import NO_TIMING, Conditions, Levels, TimingFigures
from rig.core.types import Mode
from rig.io.bus import Bus, BusConfig
from rig.io.clock import Clock, OccupiedClock, RealClock, VirtualClock
from rig.io.link import Link, LinkFigures
from rig.io.realtime import Granted, Request, realtime
from rig.io.run_log import DBC_FILE, MODEL_FILE, RUN_FILE
from rig.io.run_writer import RunLog
from rig.io.secoc import Authentication, Authenticator
from rig.io.steps import Step
from rig.loop import Port, Progress, Timing, regular_ticks, run

_PACKAGES = ("rig", "dartpy", "python-can", "cantools", "numpy", "pyarrow", "autosar-e2e")
_NO_CONDITIONS = Conditions()
_BENCH_PORTION_NS = 20_000_000
_SPINNING_SHARE = 5
"""At most this part of a period is spun away before a deadline."""
_CATCHING_UP = 4
"""How often a simulated bench catches up before the first tick, each time in less time."""
_TIMING_TOLD_NS = 500_000_000
"""How often percentiles are taken of the timing, for the bus."""


@dataclass(frozen=True)
class Ended:
    """How a run ended.

    Attributes:
        folder: Its folder.
        state: Last state of the bridge.
        timing: How well the rate was kept.
        granted: What the machine granted.
        log_fault: What went wrong with the log, if anything.
        ticks: Number of ticks.
        period_ns: Time between two of them.
    """

    folder: Path
    state: BridgeState
    timing: Timing
    granted: Granted | None
    log_fault: str | None
    ticks: int
    period_ns: int

    def summary(self) -> dict[str, object]:
        """Every figure, for `summary.json`."""
        return {
            "mode": self.state.rig.mode.name,
            "ticks": self.ticks,
            "counts": self.state.counts._asdict(),
            "timing": self.timing.summary(),
            "granted": None if self.granted is None else self.granted.as_dict(),
            "log_fault": self.log_fault,
        }


class BusPort:
    """A port on a bus. A fault of the bus is told with every tick; it does not stop the loop."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self._acknowledged = False
        self._refused = 0

    def acknowledge(self) -> None:
        """Acknowledge the safe state at the next tick."""
        self._acknowledged = True

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        """Frames that have come since the last tick."""
        link = self.link
        frames = link.receive(t_ns)
        if link.fault is None and not self._acknowledged and link.refused == self._refused:
            return frames, _NO_CONDITIONS
        bus_fault = link.fault is not None or link.refused > self._refused
        self._refused = link.refused
        acknowledged, self._acknowledged = self._acknowledged, False
        return frames, Conditions(acknowledged=acknowledged, bus_fault=bus_fault)

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Send; returns what was sent."""
        return self.link.send(frames)


class _Told:
    """A port whose conditions tell of the log too, and of how well the rate is kept."""

    def __init__(self, port: Port, log: RunLog, timing: Timing) -> None:
        self._port = port
        self._log = log
        self._timing = timing
        self._told = NO_TIMING
        self._calm = _NO_CONDITIONS
        self._again_ns = _TIMING_TOLD_NS
        self.send = port.send

    def look(self, t_ns: int) -> None:
        """Take the percentiles anew, if it is time; done in a tick it would delay that tick."""
        if t_ns >= self._again_ns:
            self._again_ns = t_ns + _TIMING_TOLD_NS
            self._told = _figures(self._timing)
            self._calm = Conditions(timing=self._told)

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        frames, conditions = self._port.receive(t_ns)
        if conditions is _NO_CONDITIONS and self._log.fault is None:
            return frames, self._calm
        log_fault = self._log.fault is not None
        return frames, conditions._replace(log_fault=log_fault, timing=self._told)


def _figures(timing: Timing) -> TimingFigures:
    gap_s = float(timing.extremes_ns[2]) * 1e-9
    return TimingFigures(_levels_s(timing.lateness_us()), _levels_s(timing.work_us()), gap_s)


def _levels_s(levels_us: dict[str, float]) -> Levels:
    """All zero before the first tick."""
    return cast("Levels", tuple(value * 1e-6 for value in levels_us.values()) or (0.0,) * 4)


class _BenchOnBus:
    """A port with a simulated bench at the other end of its bus.

    While the loop waits the bench sends what is due up to the tick that is awaited, so that its own
    work delays no tick.
    """

    def __init__(
        self, bench: Bench, bench_bus: Bus, port: BusPort, authenticator: Authenticator | None
    ) -> None:
        self._bench = bench
        self._bench_bus = bench_bus
        self._secured = None if authenticator is None else authenticator.secured
        self._port = port
        self._sent_ns = -1
        self.send = port.send

    def begin(self, clock: Clock) -> None:
        """Let what the bench sent while the run was set up be gone before the first tick."""
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
        self._bench_bus.receive()  # the bench has no use for what the bridge says

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        self.send_up_to(t_ns)  # ticks that were missed
        return self._port.receive(t_ns)


def _header(
    ready: Setup, epoch_ns: int, granted: Granted | None, folder: Path
) -> dict[str, object]:
    files = {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest()
        for name in (MODEL_FILE, DBC_FILE)
    }
    return {
        "schema": 1,
        "epoch_ns": epoch_ns,
        "config": ready.config.model_dump(mode="json"),
        "config_source": str(ready.source),
        "files_sha256": files,
        "versions": {
            **{name: version(name) for name in _PACKAGES},
            "python": platform.python_version(),
            "system": platform.platform(),
        },
        "granted": None if granted is None else granted.as_dict(),
    }


def _copy_inputs(ready: Setup, folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / MODEL_FILE).write_text(dump_model(ready.model), "utf-8")
        shutil.copyfile(ready.database.path, folder / DBC_FILE)
        copy_skeleton(ready.model, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error


def _nothing() -> None:
    """Begin without ado."""


def logged(
    ready: Setup,
    bridge: Bridge,
    port: Port,
    clock: Clock,
    folder: Path,
    *,
    figures: LinkFigures,
    granted: Granted | None = None,
    begin: Callable[[], None] = _nothing,
    stop: Callable[[], bool],
    progress: Progress,
) -> Ended:
    """Run on a port and log it.

    Args:
        ready: Configuration, model and DBC.
        bridge: The bridge built from them.
        port: Where frames come from and go to.
        clock: When ticks come.
        folder: Folder of the run; absent or empty.
        figures: What becomes of the bus behind the port, for `run.yaml`.
        granted: What the machine granted; None for simulated time, which then waits for the disk.
        begin: Called when all is set up, before the first tick.
        stop: Asked before each tick whether to end.
        progress: Told of every tick.

    Raises:
        InputError: The folder cannot be written.
    """
    config = ready.config
    if (folder / RUN_FILE).exists():
        raise InputError(f"{folder}: holds a run already, expected an empty folder")
    _copy_inputs(ready, folder)
    header = _header(ready, clock.epoch_ns, granted, folder)
    log = RunLog(
        folder,
        header,
        list(config.observers),
        clock.epoch_ns,
        config.bus.channel,
        paced=granted is not None,
        priority=config.realtime.fifo_priority if granted is not None and granted.fifo else 0,
        rotation=config.log.rotation(),
        window=config.log.window(),
        graver=_graver,
    )
    count = None if config.duration_s is None else _ticks(config.duration_s, config.rate_hz)
    timing, ticks, status = Timing.empty(), 0, "failed"
    state = bridge.init(0)

    def sink(
        received: Sequence[Frame], sent: Sequence[Frame], result: TickResult, step: Step
    ) -> None:
        nonlocal ticks
        log.add(received, sent, step)
        ticks += 1
        progress(step.t_ns, result.output.mode)

    try:
        begin()
        told = _Told(port, log, timing)
        waiting = OccupiedClock(clock, told.look)
        due = regular_ticks(waiting, config.period_ns, count, stop, timing)
        with _on_signal(signal.SIGUSR2, lambda: log.trigger("user")):
            state = run(bridge, state, due, told, sink)
        status = "safe" if state.rig.mode is Mode.SAFE else "done"
    finally:
        log.close(
            lambda: {
                "ending": {
                    "status": status,
                    "ticks": ticks,
                    "counts": state.counts._asdict(),
                    "timing": timing.summary(),
                    "bus": figures.as_dict(),
                    "log_fault": log.trouble,
                    "dropped_steps": log.dropped,
                }
            }
        )
    return Ended(folder, state, timing, granted, log.trouble, ticks, config.period_ns)


@contextlib.contextmanager
def on_time(config: RunConfig) -> Generator[tuple[Granted, RealClock]]:
    """Ask the machine for what a fixed rate needs.

    Args:
        config: What is asked for.

    Yields:
        What was granted, and the clock to wait on; it spins only where SCHED_FIFO was granted.
    """
    asked = config.realtime
    request = Request(asked.fifo_priority, asked.lock_memory, asked.cpu, asked.freeze_garbage)
    with realtime(request) as granted:
        # From a real-time thread that never leaves its core Linux takes it for 50 ms in every
        # second.
        spin_ns = min(round(asked.spin_s * 1e9), config.period_ns // _SPINNING_SHARE)
        yield granted, RealClock(spin_ns if granted.fifo else 0)


def _ticks(duration_s: float, rate_hz: float) -> int:
    return max(1, round(duration_s * rate_hz))


def live(
    ready: Setup,
    folder: Path,
    *,
    listen_only: bool = False,
    stop: Callable[[], bool],
    progress: Progress,
) -> Ended:
    """Run on the configured bus in real time.

    Raises:
        InputError: Something of the configuration is wrong, or the folder cannot be written.
        BusError: The bus cannot be opened.
    """
    bridge = build_bridge(ready)
    with on_time(ready.config) as (granted, clock):
        link = _link(ready, bridge, clock, listen_only=listen_only)
        port = BusPort(link)
        try:
            with _on_signal(signal.SIGUSR1, port.acknowledge):
                return logged(
                    ready,
                    bridge,
                    port,
                    clock,
                    folder,
                    figures=link.figures,
                    granted=granted,
                    stop=stop,
                    progress=progress,
                )
        finally:
            link.close()


@contextlib.contextmanager
def _on_signal(number: signal.Signals, action: Callable[[], None]) -> Generator[None]:
    """Do something when a signal comes, where this thread can be told of signals.

    SIGUSR1 acknowledges the safe state, SIGUSR2 captures a window of the log.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(number, lambda _number, _frame: action())
    try:
        yield
    finally:
        signal.signal(number, before)


def _graver(before: int, now: int) -> str | None:
    """Name of a mode that the log captures a window around, when the bridge comes into it."""
    return Mode(now).name.lower() if now != before and now in (Mode.HOLD, Mode.SAFE) else None


def _link(ready: Setup, bridge: Bridge, clock: Clock, *, listen_only: bool = False) -> Link:
    config = ready.config

    def open_bus() -> Bus:
        return Bus(
            config.bus.config(),
            bridge.heard,
            listen_only=listen_only,
            epoch_ns=clock.epoch_ns,
        )

    authenticator = _authenticator(ready, clock)
    return Link(open_bus, clock.epoch_now_ns, authenticator=authenticator)


def _authenticator(ready: Setup, clock: Clock) -> Authenticator | None:
    how = load_authentication(ready)
    return None if how is None else Authenticator(how, clock.epoch_ns)


def with_bench(
    ready: Setup,
    bench_config: BenchConfig,
    folder: Path,
    *,
    lockstep: bool,
    stop: Callable[[], bool],
    progress: Progress,
) -> Ended:
    """Run with a simulated bench at the other end of the configured bus.

    Args:
        ready: Configuration, model and DBC.
        bench_config: The bench.
        folder: Folder of the run.
        lockstep: Simulated time, as fast as the machine allows; otherwise real time.
        stop: Asked before each tick whether to end.
        progress: Told of every tick.

    Raises:
        InputError: Something of the configuration is wrong, or the folder cannot be written.
        BusError: The bus cannot be opened.
    """
    bridge = build_bridge(ready)
    bench = Bench(bench_config, ready.database)
    if not lockstep:
        # What is loaded at a bench's first use would hold the first ticks up.
        Bench(bench_config, ready.database).update(_BENCH_PORTION_NS)
    with contextlib.ExitStack() as stack:
        granted, clock = None, VirtualClock()
        if not lockstep:
            granted, clock = stack.enter_context(on_time(ready.config))
        link = _link(ready, bridge, clock)
        stack.callback(link.close)
        bench_bus = Bus(ready.config.bus.config(), epoch_ns=clock.epoch_ns)
        stack.callback(bench_bus.close)
        authenticator = _authenticator(ready, clock)
        on_bus = _BenchOnBus(bench, bench_bus, BusPort(link), authenticator)
        return logged(
            ready,
            bridge,
            on_bus,
            OccupiedClock(clock, on_bus.send_up_to),
            folder,
            figures=link.figures,
            granted=granted,
            begin=_nothing if lockstep else partial(on_bus.begin, clock),
            stop=stop,
            progress=progress,
        )


def run_bench(
    bench_config: BenchConfig,
    bus_config: BusConfig,
    dbc: Path | None,
    *,
    authentication: Authentication | None = None,
    duration_s: float | None,
    stop: Callable[[], bool],
    progress: Progress,
) -> int:
    """Run a simulated bench on a bus in real time.

    Args:
        bench_config: The bench.
        bus_config: The bus.
        dbc: What its messages mean; the package's own if None.
        authentication: How its frames are secured; not at all if None.
        duration_s: Length; until asked to stop if None.
        stop: Asked before each frame whether to end.
        progress: Told of the time.

    Returns:
        Number of frames sent.

    Raises:
        BusError: The bus cannot be opened.
        DatabaseError: The DBC is wrong.
    """
    bench = Bench(bench_config, load_database(dbc or DEFAULT_DATABASE))
    end_ns = None if duration_s is None else round(duration_s * 1e9)
    sent, due_ns = 0, 0
    clock = RealClock()
    link = Link(
        lambda: Bus(bus_config, (), epoch_ns=clock.epoch_ns),
        clock.epoch_now_ns,
        authenticator=authentication and Authenticator(authentication, clock.epoch_ns),
    )
    try:
        while not stop() and (end_ns is None or due_ns < end_ns):
            # Woken at least every 0.1 s, so that Ctrl-C is heard between slow frames.
            now_ns = clock.wait_until(min(due_ns, clock.now_ns() + 100_000_000))
            # A machine that is too slow gets a slow bench, not a silent one that sends in bursts.
            frames, due_ns = bench.update(min(now_ns, due_ns + _BENCH_PORTION_NS))
            link.receive(now_ns)  # an interface that has gone tells so here
            sent += len(link.send(frames))
            progress(now_ns, Mode.RUNNING)
    finally:
        link.close()
    return sent
