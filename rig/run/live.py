"""The bridge on a bus in real time, with or without a simulated bench at its other end."""

import contextlib
import signal
from collections.abc import Callable, Generator, Mapping, Sequence
from functools import partial
from pathlib import Path

from can_dbc.database import DEFAULT_DATABASE, load_database
from rig.bridge.bridge import Bridge
from rig.bridge.contract import Mode
from rig.bus.bus import Bus, BusConfig
from rig.bus.link import Link
from rig.bus.secoc import Authentication, Authenticator
from rig.machine.clock import Clock, RealClock, VirtualClock
from rig.machine.realtime import Granted, Request, realtime
from rig.plan.assembly import build_bridge
from rig.plan.config import RunConfig
from rig.plan.setup import Setup, load_authentication
from rig.run.logged_run import Ended, logged, on_signal
from rig.run.loop import Progress, Watch, unnoted, unwatched
from rig.run.ports import BenchOnBus, BusPort
from rig.run.trace import Trace
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.schema import BenchConfig

_BENCH_PORTION_NS = 20_000_000
"""Simulated time after which the bench looks at its bus, while it catches up."""

_SPINNING_SHARE = 5
"""At most this part of a period is spun away before a deadline."""


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


def live(
    ready: Setup,
    folder: Path,
    *,
    listen_only: bool = False,
    trace: Trace | None = None,
    forced: Sequence[Mapping[str, str]] = (),
    stop: Callable[[], bool],
    progress: Progress = unnoted,
    watch: Watch = unwatched,
) -> Ended:
    """Run on the configured bus in real time.

    Args:
        ready: Configuration, model and DBC.
        folder: Folder of the run; absent or empty.
        listen_only: Send nothing.
        trace: Where the parts of ticks that are late are kept; None keeps nothing.
        forced: Errors of the check that somebody passed over, for `run.yaml`.
        stop: Asked before each tick whether to end.
        progress: Called with time and mode of every tick.
        watch: Given a look five times a second.

    Raises:
        InputError: Something of the configuration is wrong, or the folder cannot be written.
        BusError: The bus cannot be opened.
    """
    bridge = build_bridge(ready)
    with on_time(ready.config) as (granted, clock):
        link = _link(ready, bridge, clock, listen_only=listen_only)
        port = BusPort(link)
        try:
            with on_signal(signal.SIGUSR1, port.acknowledge):
                return logged(
                    ready,
                    bridge,
                    port,
                    clock,
                    folder,
                    figures=link.figures,
                    granted=granted,
                    trace=trace,
                    forced=forced,
                    acknowledge=port.acknowledge,
                    stop=stop,
                    progress=progress,
                    watch=watch,
                )
        finally:
            link.close()


def _link(ready: Setup, bridge: Bridge, clock: Clock, *, listen_only: bool = False) -> Link:
    config = ready.config

    def open_bus() -> Bus:
        return Bus(
            config.bus.config(),
            bridge.filters,
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
    trace: Trace | None = None,
    stop: Callable[[], bool],
    progress: Progress = unnoted,
    watch: Watch = unwatched,
) -> Ended:
    """Run with a simulated bench at the other end of the configured bus.

    Args:
        ready: Configuration, model and DBC.
        bench_config: The bench.
        folder: Folder of the run.
        lockstep: Simulated time, as fast as the machine allows; otherwise real time.
        trace: Where the parts of ticks that are late are kept; None keeps nothing.
        stop: Asked before each tick whether to end.
        progress: Called with time and mode of every tick.
        watch: Given a look five times a second.

    Raises:
        InputError: Something of the configuration is wrong, or the folder cannot be written.
        BusError: The bus cannot be opened.
    """
    bridge = build_bridge(ready)
    bench = SimulatedBench(bench_config, ready.database)
    if not lockstep:
        # What is loaded at a bench's first use would hold the first ticks up.
        SimulatedBench(bench_config, ready.database).update(_BENCH_PORTION_NS)
    with contextlib.ExitStack() as stack:
        granted, clock = None, VirtualClock()
        if not lockstep:
            granted, clock = stack.enter_context(on_time(ready.config))
        link = _link(ready, bridge, clock)
        stack.callback(link.close)
        bench_bus = Bus(ready.config.bus.config(), epoch_ns=clock.epoch_ns)
        stack.callback(bench_bus.close)
        authenticator = _authenticator(ready, clock)
        port = BusPort(link)
        on_bus = BenchOnBus(bench, bench_bus, port, authenticator)
        return logged(
            ready,
            bridge,
            on_bus,
            clock,
            folder,
            figures=link.figures,
            granted=granted,
            trace=trace,
            begin=None if lockstep else partial(on_bus.begin, clock),
            while_waiting=(on_bus.send_up_to,),
            acknowledge=None if lockstep else port.acknowledge,
            stop=stop,
            progress=progress,
            watch=watch,
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
        stop: Asked at least every 0.1 s whether to end.
        progress: Called with the time.

    Returns:
        Number of frames sent.

    Raises:
        BusError: The bus cannot be opened.
        DatabaseError: The DBC is wrong.
    """
    bench = SimulatedBench(bench_config, load_database(dbc or DEFAULT_DATABASE))
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
            # Woken at least every 0.1 s, so that Ctrl-C takes effect between slow frames.
            now_ns = clock.wait_until(min(due_ns, clock.now_ns() + 100_000_000))
            # A machine that is too slow gets a slow bench, not a silent one that sends in bursts.
            frames, due_ns = bench.update(min(now_ns, due_ns + _BENCH_PORTION_NS))
            link.receive(now_ns)  # an interface that has gone is noticed here
            sent += len(link.send(frames))
            progress(now_ns, Mode.RUNNING)
    finally:
        link.close()
    return sent
