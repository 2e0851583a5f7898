"""A run of the bridge on any port, logged to its folder."""

import contextlib
import platform
import shutil
import signal
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from dart_model.spec import copy_files, dump_model, files_of
from rig.bridge.bridge import Bridge, BridgeState, TickResult
from rig.bridge.counts import Conditions
from rig.bridge.values import Mode
from rig.bus.link import LinkFigures
from rig.files.folders import claim
from rig.files.hashes import hash_files
from rig.log.file_names import CHANGES_FILE, DBC_FILE, EVENTS_FILE, HISTOGRAMS_FILE, MODEL_FILE
from rig.log.reader import RUN_SCHEMA, ConfigEntry, RunHeader
from rig.log.step_columns import LogColumns, Step, request_of
from rig.log.writer import LogOptions, RunWriter
from rig.machine.clock import Clock, OccupiedClock
from rig.machine.installed_versions import version_of
from rig.machine.machine_state import MachineReader
from rig.machine.realtime import Granted
from rig.plan.plan import Plan
from rig.run.change_requests import Requests
from rig.run.changed_settings import Changes, no_changes
from rig.run.loop import SHOWN_EVERY_NS, Look, Port, RunControl, Sink, regular_ticks, run
from rig.run.machine_events import MachineEvents
from rig.run.mode_events import ModeEvents
from rig.run.operator import Asked, Operator
from rig.run.ports import InformedPort
from rig.run.timing import Timing
from rig.run.trace import Trace
from rig.run.watchdog import Watchdog

_MOST_REPORTS = 1000
"""Changes of the devices' state that `run.yaml` lists; the counts go on."""

_LAST_FRAMES = 3
"""Frames of each message at the end of a run, one a tick: one of them may be lost on the bus."""

_LONGEST_RAMP_NS = 5_000_000_000
"""After this time a run that has ended publishes the safe output, wherever its ramp has come."""

_STATUS = {Mode.SAFE: "safe", Mode.WAITING: "waiting"}
"""Mode at the end -> how `run.yaml` says that the run ended, where it was not as it should be."""

_PACKAGES = ("rig", "dartpy", "python-can", "cantools", "numpy", "pyarrow", "autosar-e2e")


@dataclass(frozen=True)
class Ended:
    """How a run ended; of the model's last divergence strut and time, and what the log lacks.

    Attributes:
        cause: Since when and why it was in its last mode, as in its events; empty if RUNNING.
    """

    folder: Path
    state: BridgeState
    timing: Timing
    granted: Granted | None
    log_fault: str | None
    ticks: int
    ticks_in_mode: Mapping[Mode, int]
    period_ns: int
    diverged: Mapping[str, object] | None
    dropped_steps: int
    cause: Mapping[str, object]

    def summary(self) -> dict[str, object]:
        """Every figure, for `summary.json`."""
        return {
            "mode": self.state.mode.name,
            "ticks": self.ticks,
            "counts": self.state.counts._asdict(),
            "diverged": self.diverged,
            "timing": self.timing.summary(),
            "granted": None if self.granted is None else self.granted.as_dict(),
            "log_fault": self.log_fault,
            "dropped_steps": self.dropped_steps,
        }


def _no_setup() -> None:
    """Nothing to do before the first tick."""


def _no_beat(_state: BridgeState) -> None:
    """Nothing that has to know of a tick."""


@dataclass(frozen=True)
class Endpoint:
    """What a run has instead of a bench: where frames come from and go to, and when.

    Attributes:
        granted: What the machine granted; None for simulated time, which then waits for the disk.
        begin: Called when all is set up, before the first tick.
        while_waiting: Called before each wait with the time that is awaited.
        operator: Where requests of operators arrive; with it, the run accepts them, and changes.
        watchdog: Sends the safe output when the loop cannot.
        machine: Reads the state of the machine, whose changes are noted; None notes none.
    """

    port: Port
    clock: Clock
    figures: LinkFigures
    granted: Granted | None = None
    begin: Callable[[], None] = _no_setup
    while_waiting: Sequence[Callable[[int], None]] = ()
    operator: Operator | None = None
    watchdog: Watchdog | None = None
    machine: MachineReader | None = None


def run_with_log(
    plan: Plan,
    bridge: Bridge,
    endpoint: Endpoint,
    folder: Path,
    control: RunControl,
    *,
    trace: Trace | None = None,
) -> Ended:
    """Run on a port and log it; parts of late ticks are kept in `trace`.

    Raises:
        InputError: The folder is not empty, another run is beginning in it, or it cannot be
            written.
    """
    with claim(folder):
        _copy_inputs(plan, folder)
        running = _LoggedRun(plan, bridge, endpoint, folder, control)
    try:
        if endpoint.watchdog is not None:
            endpoint.watchdog.start()
        endpoint.begin()
        running.run(trace)
    finally:
        running.close()
    if trace is not None:
        trace.write(folder)
    return running.outcome()


class _LoggedRun:
    """A run while it is going on; its folder has the inputs in it."""

    def __init__(
        self, plan: Plan, bridge: Bridge, endpoint: Endpoint, folder: Path, control: RunControl
    ) -> None:
        config, granted = plan.config, endpoint.granted
        self._plan, self._bridge, self._endpoint = plan, bridge, endpoint
        self._folder, self._control = folder, control
        self._timing = Timing.empty()
        self._columns = LogColumns(plan.strut_names, plan.channels, plan.virtual_columns)
        self._priority = config.realtime.fifo_priority if granted and granted.fifo else 0
        self._machine = (
            None
            if endpoint.machine is None
            else MachineEvents(endpoint.machine, endpoint.clock.now_ns)
        )
        self._log = RunWriter(
            folder,
            _header(plan, endpoint.clock.epoch_ns, granted, folder, control),
            self._columns.names,
            config.bus.channel,
            None if granted is None else self._priority,
            LogOptions(
                config.log.rotation(),
                config.log.window(),
                _capture_name,
                None if granted is None else (HISTOGRAMS_FILE, self._timing.histograms),
                watch=None if self._machine is None else (EVENTS_FILE, self._machine.look),
                sync_s=None if granted is None else config.log.sync_s,
            ),
        )
        self._reports = _FaultReports([device.name for device in plan.devices])
        self._state = bridge.init(0)
        self._ticks, self._shown_ns, self._status = 0, 0, "failed"
        self._last_frames: list[Frame] = []
        self._events = ModeEvents(
            partial(self._log.note, EVENTS_FILE),
            plan.strut_names,
            [device.name for device in plan.devices],
        )
        self._asked: Asked | None = None

    def run(self, trace: Trace | None) -> None:
        plan, endpoint, clock = self._plan, self._endpoint, self._endpoint.clock
        informed = InformedPort(endpoint.port, self._log, self._timing)
        source: Port = informed
        sink: Sink = self._keep
        if trace is not None:
            clock = trace.clock(clock)
            source, sink = trace.port(informed, self._log), trace.sink(sink)
        for occupation in (*endpoint.while_waiting, informed.look):
            clock = OccupiedClock(clock, occupation)
        duration_s, rate_hz = plan.config.duration_s, plan.config.rate_hz
        count = None if duration_s is None else max(1, round(duration_s * rate_hz))
        due = regular_ticks(clock, plan.period_ns, count, self._control.stop, self._timing)
        with contextlib.ExitStack() as around:
            around.enter_context(on_signal(signal.SIGUSR2, lambda: self._log.trigger("user")))
            changes = self._changes(around)
            beat = _no_beat if endpoint.watchdog is None else endpoint.watchdog.write
            ticks = run(self._bridge, due, source, sink, self._columns, changes)
            try:
                for state in ticks:
                    self._state = state
                    beat(state)
                    self._events.update(state, self._asked)
            finally:
                self._publish_end(informed.conditions)
        self._status = _STATUS.get(self._state.mode, "done")

    def close(self) -> None:
        self._log.close(self._ending, self._last_frames)

    def outcome(self) -> Ended:
        return Ended(
            self._folder,
            self._state,
            self._timing,
            self._endpoint.granted,
            self._log.trouble,
            self._ticks,
            dict(self._events.ticks),
            self._plan.period_ns,
            self._divergence(),
            self._log.dropped,
            self._events.cause_of(self._state.supervised),
        )

    def _keep(
        self, received: Sequence[Frame], sent: Sequence[Frame], result: TickResult, step: Step
    ) -> None:
        """Log a tick and show it."""
        self._log.add(received, sent, step)
        t_ns = step.t_ns
        self._reports.note(t_ns, result.device_faults)
        operator = self._endpoint.operator
        self._asked = operator.last if operator and request_of(step.flags) else None
        self._ticks += 1
        self._control.progress(t_ns, result.output.mode)
        if t_ns >= self._shown_ns:
            self._shown_ns = t_ns + SHOWN_EVERY_NS
            is_paced = self._endpoint.granted is not None
            late_ns = int(self._timing.extremes_ns[0]) if is_paced else None
            passed = self._ticks + result.counts.overruns
            self._control.watch(
                Look(
                    passed * self._plan.period_ns,
                    self._ticks,
                    result.output,
                    result.counts,
                    late_ns,
                    result.device_faults,
                    self._log.fault,
                    self._events.cause_of(self._state.supervised),
                )
            )

    def _publish_end(self, conditions: Conditions) -> None:
        """Publish the safe output, whatever has ended the loop, as the last that is on the bus."""
        endpoint, state = self._endpoint, self._state
        t_ns = state.supervised.t_ns
        latest_ns = t_ns + _LONGEST_RAMP_NS
        last = 0
        while last < _LAST_FRAMES:
            t_ns += self._plan.period_ns
            endpoint.clock.wait_until(t_ns)
            if endpoint.watchdog is not None:
                endpoint.watchdog.write(state)
            if t_ns > latest_ns:
                state = self._bridge.stop_ramp(state)
            state, frames = self._bridge.end(state, t_ns, conditions)
            self._last_frames += endpoint.port.send(frames)
            last += self._bridge.is_at_rest(state)

    def _changes(self, around: contextlib.ExitStack) -> Changes:
        """Changes that are requested while the run is going on."""
        operator = self._endpoint.operator
        if operator is None:
            return no_changes
        log_change, log_event = (partial(self._log.note, it) for it in (CHANGES_FILE, EVENTS_FILE))
        requests = Requests(
            self._folder,
            self._plan,
            self._bridge,
            operator.ask,
            log_change,
            log_event,
            self._priority,
        )
        around.enter_context(requests.serve())

        def changes(t_ns: int) -> Bridge | None:
            changed = requests.changes(t_ns)
            if changed is not None:
                self._bridge = changed
            return changed

        return changes

    def _ending(self) -> dict[str, object]:
        """The last section of `run.yaml`."""
        watchdog = self._endpoint.watchdog
        return {
            "ending": {
                "status": self._status,
                "ticks": self._ticks,
                "mode": self._state.mode.name,
                "time_in_mode_s": {
                    mode.name: ticks * self._plan.period_ns * 1e-9
                    for mode, ticks in self._events.ticks.items()
                    if ticks
                },
                "counts": self._state.counts._asdict(),
                "diverged": self._divergence(),
                "timing": self._timing.summary(),
                "bus": self._endpoint.figures.as_dict(),
                "log_fault": self._log.trouble,
                "dropped_steps": self._log.dropped,
                "devices": self._reports.listed,
                "watchdog": watchdog and watchdog.describe(),
                "machine": None if self._machine is None else self._machine.summary(),
            }
        }

    def _divergence(self) -> dict[str, object] | None:
        """Strut and time of the model's last divergence."""
        divergence = self._state.supervised.diverged
        if divergence is None:
            return None
        strut = self._plan.struts[divergence.strut].name
        return {"strut": strut, "t_s": divergence.t_ns * 1e-9}


def _header(
    plan: Plan, epoch_ns: int, granted: Granted | None, folder: Path, control: RunControl
) -> RunHeader:
    files = {
        name: hash_files([folder / name]) for name in (MODEL_FILE, DBC_FILE, *files_of(plan.model))
    }
    header: RunHeader = {
        "schema": RUN_SCHEMA,
        "epoch_ns": epoch_ns,
        "config": cast("ConfigEntry", plan.config.model_dump(mode="json")),
        "config_source": str(plan.source),
        "files_sha256": files,
        "versions": {
            **{name: version_of(name) for name in _PACKAGES},
            "python": platform.python_version(),
            "system": platform.platform(),
        },
        "granted": None if granted is None else granted.as_dict(),
    }
    if control.forced:
        header["forced"] = [dict(finding) for finding in control.forced]
    return header


def _copy_inputs(plan: Plan, folder: Path) -> None:
    try:
        (folder / MODEL_FILE).write_text(dump_model(plan.model), "utf-8")
        shutil.copyfile(plan.database.path, folder / DBC_FILE)
        copy_files(plan.model, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error


class _FaultReports:
    """Faults of devices and their times, for `run.yaml`."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._last: tuple[tuple[int, str], ...] = ()
        self.listed: list[dict[str, object]] = []

    def note(self, t_ns: int, device_faults: tuple[tuple[int, str], ...]) -> None:
        """Note the faults at a tick, where they differ from those before."""
        if device_faults == self._last:
            return
        self._last = device_faults
        if len(self.listed) < _MOST_REPORTS:
            wrong = {self._names[index]: why for index, why in device_faults}
            self.listed.append({"t_s": t_ns * 1e-9, "wrong": wrong})


def _capture_name(before: int, now: int) -> str | None:
    """Name of a mode that the log captures a window around, when the bridge enters it."""
    return Mode(now).name.lower() if now != before and now in (Mode.HOLD, Mode.SAFE) else None


@contextlib.contextmanager
def on_signal(number: signal.Signals, action: Callable[[], None]) -> Generator[None]:
    """Call an action when a signal arrives, where this thread receives signals.

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
