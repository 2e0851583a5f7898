"""A run of the bridge on any port, logged to its folder."""

import contextlib
import hashlib
import platform
import shutil
import signal
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from dart_model.spec import copy_files, dump_model
from rig.bridge.bridge import Bridge, BridgeState, TickResult
from rig.bridge.contract import Mode
from rig.bridge.log_columns import Record, columns
from rig.bus.link import LinkFigures
from rig.files.folders import refuse_full
from rig.log.file_names import CHANGES_FILE, DBC_FILE, HISTOGRAMS_FILE, MODEL_FILE
from rig.log.reader import RUN_SCHEMA
from rig.log.steps import Step
from rig.log.writer import LogOptions, RunWriter
from rig.machine.clock import Clock, OccupiedClock
from rig.machine.realtime import Granted
from rig.plan.assembly import sensors
from rig.plan.setup import Setup
from rig.run.changes import Changes, unchanged
from rig.run.loop import (
    SHOWN_EVERY_NS,
    Look,
    Port,
    Progress,
    Sink,
    Watch,
    regular_ticks,
    run,
    unnoted,
    unwatched,
)
from rig.run.ports import InformedPort
from rig.run.requests import Requests
from rig.run.timing import Timing
from rig.run.trace import Trace

_MOST_REPORTS = 1000
"""Changes of the devices' state that `run.yaml` lists; the counts go on."""

_PACKAGES = ("rig", "dartpy", "python-can", "cantools", "numpy", "pyarrow", "autosar-e2e")


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
        diverged: Strut and time of the model's last divergence, if there was one.
    """

    folder: Path
    state: BridgeState
    timing: Timing
    granted: Granted | None
    log_fault: str | None
    ticks: int
    period_ns: int
    diverged: Mapping[str, object] | None

    def summary(self) -> dict[str, object]:
        """Every figure, for `summary.json`."""
        return {
            "mode": self.state.core.mode.name,
            "ticks": self.ticks,
            "counts": self.state.counts._asdict(),
            "diverged": self.diverged,
            "timing": self.timing.summary(),
            "granted": None if self.granted is None else self.granted.as_dict(),
            "log_fault": self.log_fault,
        }


def _header(
    ready: Setup, epoch_ns: int, granted: Granted | None, folder: Path
) -> dict[str, object]:
    files = {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest()
        for name in (MODEL_FILE, DBC_FILE)
    }
    return {
        "schema": RUN_SCHEMA,
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
        copy_files(ready.model, folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error


def _loop_priority(ready: Setup, granted: Granted | None) -> int | None:
    """Real-time priority of a loop that waits for a clock, 0 for none; None of any other."""
    if granted is None:
        return None
    return ready.config.realtime.fifo_priority if granted.fifo else 0


def logged(
    ready: Setup,
    bridge: Bridge,
    port: Port,
    clock: Clock,
    folder: Path,
    *,
    figures: LinkFigures,
    granted: Granted | None = None,
    trace: Trace | None = None,
    forced: Sequence[Mapping[str, str]] = (),
    begin: Callable[[], None] | None = None,
    while_waiting: Sequence[Callable[[int], None]] = (),
    stop: Callable[[], bool],
    acknowledge: Callable[[], None] | None = None,
    progress: Progress = unnoted,
    watch: Watch = unwatched,
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
        trace: Where the parts of ticks that are late are kept; None keeps nothing.
        forced: Errors of the check that somebody passed over, for `run.yaml`.
        begin: Called when all is set up, before the first tick.
        while_waiting: Called before each wait with the time that is awaited.
        stop: Asked before each tick whether to end.
        acknowledge: Acknowledges the safe state; with it, the run takes requests to change it.
        progress: Called with time and mode of every tick.
        watch: Given a look five times a second.

    Raises:
        InputError: The folder cannot be written.
    """
    config = ready.config
    refuse_full(folder)
    _copy_inputs(ready, folder)
    header = _header(ready, clock.epoch_ns, granted, folder)
    header |= {"forced": [dict(finding) for finding in forced]} if forced else {}
    timing, further = Timing.empty(), sensors(ready)
    record = Record(config.signals.measured, len(further))
    priority = _loop_priority(ready, granted)
    log = RunWriter(
        folder,
        header,
        columns(list(config.observers), config.signals.measured, further),
        config.bus.channel,
        priority,
        LogOptions(
            config.log.rotation(),
            config.log.window(),
            _capture_name,
            None if granted is None else (HISTOGRAMS_FILE, timing.histograms),
        ),
    )
    count = None if config.duration_s is None else _ticks(config.duration_s, config.rate_hz)
    ticks, shown_ns, status = 0, 0, "failed"
    state, reports = bridge.init(0), _Reports(list(config.devices))

    def sink(
        received: Sequence[Frame], sent: Sequence[Frame], result: TickResult, step: Step
    ) -> None:
        nonlocal ticks, shown_ns
        log.add(received, sent, step)
        reports.note(step.t_ns, result.troubles)
        ticks += 1
        progress(step.t_ns, result.output.mode)
        if step.t_ns >= shown_ns:
            shown_ns = step.t_ns + SHOWN_EVERY_NS
            late_ns = int(timing.extremes_ns[0]) if granted is not None else None
            seen = (result.output, result.counts, late_ns, result.troubles)
            watch(Look(step.t_ns, ticks, *seen))

    try:
        if begin is not None:
            begin()
        informed = InformedPort(port, log, timing)
        source: Port = informed
        keep: Sink = sink
        if trace is not None:
            clock, source, keep = trace.clock(clock), trace.port(informed, log), trace.sink(sink)
        waiting = _occupied(clock, (*while_waiting, informed.look))
        due = regular_ticks(waiting, config.period_ns, count, stop, timing)
        with contextlib.ExitStack() as around:
            around.enter_context(on_signal(signal.SIGUSR2, lambda: log.trigger("user")))
            changes: Changes = unchanged
            if acknowledge is not None:
                note = partial(log.note, CHANGES_FILE)
                requests = Requests(folder, ready, bridge, acknowledge, note, priority or 0)
                around.enter_context(requests.served())
                changes = requests.changes
            state = run(bridge, state, due, source, keep, record, changes)
        status = "safe" if state.core.mode is Mode.SAFE else "done"
    finally:
        diverged = _divergence(ready, state)
        log.close(
            lambda: {
                "ending": {
                    "status": status,
                    "ticks": ticks,
                    "counts": state.counts._asdict(),
                    "diverged": diverged,
                    "timing": timing.summary(),
                    "bus": figures.as_dict(),
                    "log_fault": log.trouble,
                    "dropped_steps": log.dropped,
                    "devices": reports.listed,
                }
            }
        )
    if trace is not None:
        trace.write(folder)
    return Ended(folder, state, timing, granted, log.trouble, ticks, config.period_ns, diverged)


def _occupied(clock: Clock, occupations: Sequence[Callable[[int], None]]) -> Clock:
    """A clock that does something before each wait."""
    for occupation in occupations:
        clock = OccupiedClock(clock, occupation)
    return clock


class _Reports:
    """What was wrong with devices, from when on, for `run.yaml`."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._last: tuple[tuple[int, str], ...] = ()
        self.listed: list[dict[str, object]] = []

    def note(self, t_ns: int, troubles: tuple[tuple[int, str], ...]) -> None:
        """What is wrong at a tick; kept where it is something else than before."""
        if troubles == self._last:
            return
        self._last = troubles
        if len(self.listed) < _MOST_REPORTS:
            wrong = {self._names[place]: why for place, why in troubles}
            self.listed.append({"t_s": t_ns * 1e-9, "wrong": wrong})


def _divergence(ready: Setup, state: BridgeState) -> dict[str, object] | None:
    found = state.core.diverged
    if found is None:
        return None
    return {"strut": ready.model.struts[found.strut].name, "t_s": found.t_ns * 1e-9}


def _ticks(duration_s: float, rate_hz: float) -> int:
    return max(1, round(duration_s * rate_hz))


def _capture_name(before: int, now: int) -> str | None:
    """Name of a mode that the log captures a window around, when the bridge comes into it."""
    return Mode(now).name.lower() if now != before and now in (Mode.HOLD, Mode.SAFE) else None


@contextlib.contextmanager
def on_signal(number: signal.Signals, action: Callable[[], None]) -> Generator[None]:
    """Do something when a signal comes, where this thread receives signals.

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
