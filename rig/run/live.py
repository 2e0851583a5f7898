"""The bridge on a bus in real time, with or without a simulated bench at its other end."""

import contextlib
import os
import signal
from collections.abc import Generator
from dataclasses import replace
from functools import partial
from pathlib import Path

from can_dbc.database import DEFAULT_DATABASE, load_database
from rig.bridge.bridge import Bridge
from rig.bridge.values import Mode, Request
from rig.bus.bus import Bus, BusConfig
from rig.bus.link import Link
from rig.bus.secoc import Authentication, Authenticator
from rig.machine.clock import Clock, RealClock, VirtualClock
from rig.machine.machine_state import MachineReader
from rig.machine.realtime import Granted, realtime
from rig.plan.build import build_bridge
from rig.plan.config import RunConfig
from rig.plan.plan import Plan
from rig.run.logged_run import Ended, Endpoint, on_signal, run_with_log
from rig.run.loop import RunControl
from rig.run.ports import BenchOnBus, BusPort
from rig.run.trace import Trace
from rig.run.watchdog import Watchdog, can_watch
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.schema import BenchConfig

_DEFAULT_CONTROL = RunControl()

_BENCH_PORTION_NS = 20_000_000
"""Simulated time after which the bench reads its bus, while it catches up."""

_MOST_READINGS = 1000
"""Readings of the bus before the first tick, which a bus that is never empty must not delay."""

_SPINNING_SHARE = 5
"""At most this part of a period is spun away before a deadline."""


@contextlib.contextmanager
def real_time(config: RunConfig) -> Generator[tuple[Granted, RealClock]]:
    """Context with what a fixed rate needs of the machine: what was granted, and the clock to use.

    The clock spins only where SCHED_FIFO was granted.
    """
    settings = config.realtime
    with realtime(settings) as granted:
        # From a real-time thread that never leaves its core Linux takes it for 50 ms in every
        # second.
        spin_ns = min(round(settings.spin_s * 1e9), config.period_ns // _SPINNING_SHARE)
        yield granted, RealClock(spin_ns if granted.fifo else 0)


def live(
    plan: Plan,
    folder: Path,
    control: RunControl = _DEFAULT_CONTROL,
    *,
    listen_only: bool = False,
    trace: Trace | None = None,
) -> Ended:
    """Run on the configured bus in real time; parts of late ticks are kept in `trace`.

    Raises:
        InputError: The configuration is wrong, or the folder cannot be written.
        BusError: The bus cannot be opened.
    """
    with contextlib.ExitStack() as stack:
        watchdog = None
        if can_watch(plan.config, listen_only=listen_only):
            watchdog = Watchdog(plan, folder)
            stack.callback(watchdog.stop)
        bridge = build_bridge(plan)
        granted, clock = stack.enter_context(real_time(plan.config))
        link = _open_link(plan, bridge, clock, listen_only=listen_only)
        stack.callback(link.close)
        port = BusPort(link)
        endpoint = Endpoint(
            port,
            clock,
            link.figures,
            granted,
            begin=partial(_drain_queue, link, clock),
            operator=port.operator,
            watchdog=watchdog,
            machine=_machine(),
        )
        acknowledge = partial(port.operator.ask, Request.ACKNOWLEDGE, "SIGUSR1")
        stack.enter_context(on_signal(signal.SIGUSR1, acknowledge))
        return run_with_log(plan, bridge, endpoint, folder, control, trace=trace)


def _machine() -> MachineReader:
    """Reads the state of the machine, with the cores on which the loop may run."""
    return MachineReader(tuple(sorted(os.sched_getaffinity(0))))


def _drain_queue(link: Link, clock: Clock) -> None:
    """Discard what has come since the bus was opened: the first tick would take it for new."""
    for _ in range(_MOST_READINGS):
        if not link.receive(clock.now_ns()):
            return


def _open_link(plan: Plan, bridge: Bridge, clock: Clock, *, listen_only: bool = False) -> Link:
    authenticator = _authenticator(plan.authentication, clock)
    return Link(
        lambda: Bus(
            plan.config.bus, bridge.filters, listen_only=listen_only, epoch_ns=clock.epoch_ns
        ),
        clock.epoch_now_ns,
        authenticator=authenticator,
    )


def _authenticator(authentication: Authentication | None, clock: Clock) -> Authenticator | None:
    return None if authentication is None else Authenticator(authentication, clock.epoch_ns)


def with_bench(
    plan: Plan,
    bench_config: BenchConfig,
    folder: Path,
    control: RunControl = _DEFAULT_CONTROL,
    *,
    lockstep: bool,
    trace: Trace | None = None,
) -> Ended:
    """Run with a simulated bench at the other end of the configured bus.

    In lockstep time is simulated, as fast as the machine allows; otherwise it is real.

    Raises:
        InputError: The configuration is wrong, or the folder cannot be written.
        BusError: The bus cannot be opened.
    """
    bridge = build_bridge(plan)
    bench = SimulatedBench(bench_config, plan.database)
    if not lockstep:
        # What is loaded at a bench's first use would delay the first ticks.
        SimulatedBench(bench_config, plan.database).update(_BENCH_PORTION_NS)
    with contextlib.ExitStack() as stack:
        granted, clock = None, VirtualClock()
        if not lockstep:
            granted, clock = stack.enter_context(real_time(plan.config))
        link = _open_link(plan, bridge, clock)
        stack.callback(link.close)
        bench_bus = Bus(plan.config.bus, epoch_ns=clock.epoch_ns)
        stack.callback(bench_bus.close)
        authenticator = _authenticator(plan.authentication, clock)
        port = BusPort(link)
        on_bus = BenchOnBus(bench, bench_bus, port, authenticator)
        endpoint = Endpoint(on_bus, clock, link.figures, while_waiting=(on_bus.send_up_to,))
        if not lockstep:
            endpoint = replace(
                endpoint,
                granted=granted,
                begin=partial(on_bus.begin, clock),
                operator=port.operator,
                machine=_machine(),
            )
        return run_with_log(plan, bridge, endpoint, folder, control, trace=trace)


def run_bench(
    bench_config: BenchConfig,
    bus_config: BusConfig,
    dbc: Path | None,
    control: RunControl = _DEFAULT_CONTROL,
    *,
    authentication: Authentication | None = None,
    duration_s: float | None = None,
) -> int:
    """Run a simulated bench on a bus in real time; gives the number of frames that it sent.

    Without a DBC the package's own is used; without a length the bench runs until `control`, asked
    at least every 0.1 s, stops it.

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
        authenticator=_authenticator(authentication, clock),
    )
    try:
        while not control.stop() and (end_ns is None or due_ns < end_ns):
            # Woken at least every 0.1 s, so that Ctrl-C takes effect between slow frames.
            now_ns = clock.wait_until(min(due_ns, clock.now_ns() + 100_000_000))
            # A machine that is too slow gets a slow bench, not a silent one that sends in bursts.
            frames, due_ns = bench.update(min(now_ns, due_ns + _BENCH_PORTION_NS))
            link.receive(now_ns)  # an interface that has gone is noticed here
            sent += len(link.send(frames))
            control.progress(now_ns, Mode.RUNNING)
    finally:
        link.close()
    return sent
