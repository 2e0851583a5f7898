"""Progress of a command that takes time, and its end by Ctrl-C or SIGTERM."""

import contextlib
import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable, Generator, Sequence
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from rig.bridge.values import Mode
    from rig.plan.plan import Plan
    from rig.run.loop import Look


_PLAIN_EVERY_NS = 10_000_000_000
"""Time between two lines on an output that is no terminal: ten seconds."""

_PLAIN_PROGRESS_S = 2.0
"""Time between two lines of long work."""

_REFRESH_NS = 200_000_000
"""Five times a second: as fast as a person reads."""


def _write(text: bytes) -> None:
    """Write to standard error if that does not block: the loop of a run calls it."""
    with contextlib.suppress(OSError):
        if select.select((), (2,), (), 0.0)[1]:
            os.write(2, text)


@contextlib.contextmanager
def stoppable() -> Generator[Callable[[], bool]]:
    """Whether Ctrl-C, SIGTERM or a closed terminal's SIGHUP came: they end a loop in order.

    A SIGHUP that is ignored, as under nohup, stays so.
    """
    is_requested = False

    def request(_number: int, _frame: FrameType | None) -> None:
        nonlocal is_requested
        is_requested = True

    hang_up = [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    with handle_signals(request, signal.SIGINT, signal.SIGTERM, *hang_up):
        yield lambda: is_requested


@contextlib.contextmanager
def handle_signals(
    handler: Callable[[int, FrameType | None], None], *numbers: int
) -> Generator[None]:
    """Handle signals by a function, then again as before."""
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, former in previous.items():
            signal.signal(number, former)


@contextlib.contextmanager
def progress_bar() -> Generator[Callable[[str, float], None]]:
    """A bar for long work such as a diagnosis; plain lines on an output that is no terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _plain_progress()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task("diagnosis", total=1.0, visible=False)

        def show(what: str, share: float) -> None:
            bars.update(task, description=what, completed=share, visible=share < 1.0)

        yield show


def _plain_progress() -> Callable[[str, float], None]:
    """Lines such as "  12 % 0:01:05 reading"; none for work of less than two seconds."""
    first_s = time.monotonic()
    due_s = first_s + _PLAIN_PROGRESS_S

    def show(what: str, share: float) -> None:
        nonlocal due_s
        now_s = time.monotonic()
        if now_s >= due_s:
            due_s = now_s + _PLAIN_PROGRESS_S
            elapsed = timedelta(seconds=int(now_s - first_s))
            _write(f"{100 * share:4.0f} % {elapsed} {what}\n".encode())

    return show


@contextlib.contextmanager
def status_line(
    duration_s: float | None, channels: Sequence[str] = (), devices: Sequence[str] = ()
) -> Generator[Callable[["Look"], None]]:
    """State, rate, lateness, force and losses of a run: one line that is rewritten on a terminal.

    Each update is a single write, because the loop of the run calls it.
    """
    is_terminal = sys.stderr.isatty()
    total = "" if duration_s is None else f" of {duration_s:g}"
    due_ns = 0 if is_terminal else _PLAIN_EVERY_NS
    last_ns = shown_ns = shown_ticks = 0

    def show(look: "Look") -> None:
        nonlocal due_ns, last_ns, shown_ns, shown_ticks
        # A run after another begins at zero again.
        is_due = look.t_ns >= due_ns or look.t_ns < last_ns
        last_ns = look.t_ns
        if not is_due:
            return
        due_ns = look.t_ns + (0 if is_terminal else _PLAIN_EVERY_NS)
        head = f"{look.t_ns * 1e-9:.1f}{total} s  {look.output.mode.name}{_cause_text(look)}"
        parts = [head, *_describe_faults(look, channels, devices)]
        # The rate since the last line.
        if look.t_ns > shown_ns and look.ticks > shown_ticks:
            parts.append(f"{(look.ticks - shown_ticks) / (look.t_ns - shown_ns) * 1e9:.0f} Hz")
        shown_ns, shown_ticks = look.t_ns, look.ticks
        # Of several struts, the one with the largest force: there is one line. One that is not
        # observed, such as a tyre, shows less.
        observed = [item for item in look.output.struts if item.innovation_m == item.innovation_m]
        strongest = sorted(observed or look.output.struts, key=lambda item: -abs(item.force_n))
        for strut in strongest[:1]:
            parts.append(f"force {strut.force_n:+7.1f} N")
            parts.append(f"height error {strut.innovation_m * 1e3:+7.3f} mm")
        if look.late_ns is not None:
            parts.append(f"missed {look.counts.overruns}")
        parts.append(f"lost {look.counts.lost}")
        if look.counts.refused:
            parts.append(f"refused {look.counts.refused}")
        if look.late_ns is not None:
            parts.append(f"late ≤ {look.late_ns * 1e-6:.2f} ms")
        parts += [f"virtual {strut.virtual_force_n:+7.1f} N" for strut in strongest]
        if is_terminal:
            width = shutil.get_terminal_size().columns - 1
            _write(f"\r{_fitting(parts, width):<{width}}".encode())
        else:
            _write(f"{'  '.join(parts)}\n".encode())

    try:
        yield show
    finally:
        if is_terminal:
            _write(b"\r\x1b[K")


def _cause_text(look: "Look") -> str:
    """Why the estimate is not valid, as the end of a phrase."""
    from rig.pages.mode_words import describe_cause

    words = describe_cause(look.cause) if look.cause else ""
    return f": {words}" if words else ""


def _fitting(parts: Sequence[str], width: int) -> str:
    """As many parts as a line has room for, the first ones first; the first is cut if need be."""
    line = parts[0][:width]
    for part in parts[1:]:
        longer = f"{line}  {part}"
        if len(longer) > width:
            break
        line = longer
    return line


def _describe_faults(look: "Look", channels: Sequence[str], devices: Sequence[str]) -> list[str]:
    """A log that is not written, devices at fault, each with the reason, and sensors left out."""
    parts = [] if look.log_fault is None else [f"NOT LOGGED: {look.log_fault}"]
    parts += [f"{devices[index]}: {why}" for index, why in look.device_faults]
    if look.output.left_out:
        parts.append(f"left out {', '.join(channels[index] for index in look.output.left_out)}")
    return parts


@contextlib.contextmanager
def progress_line(duration_s: float | None) -> Generator[Callable[[int, "Mode"], None]]:
    """Time and mode of a run: a line on a terminal, in a single write from the loop of the run."""
    is_terminal = sys.stderr.isatty()
    due_ns = 0
    total = "" if duration_s is None else f" of {duration_s:g} s"

    def show(t_ns: int, mode: "Mode") -> None:
        nonlocal due_ns
        if is_terminal and t_ns >= due_ns:
            due_ns = t_ns + _REFRESH_NS
            _write(f"\r{t_ns * 1e-9:9.1f} s{total}  {mode.name:<8}".encode())

    try:
        yield show
    finally:
        if is_terminal:
            _write(b"\r\x1b[K")


def listen_visibly(plan: "Plan", listen_s: float, run: Path) -> None:
    """Record a run that sends nothing, with a line of progress; Ctrl-C ends it in order.

    Raises:
        InputError: The bus cannot be opened, or the folder cannot be written.
    """
    from rig.run.loop import RunControl
    from rig.sensors.mounting import listen

    with stoppable() as stop, progress_line(listen_s) as progress:
        listen(plan, listen_s, run, RunControl(stop=stop, progress=progress))
