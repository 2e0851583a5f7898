"""A command that takes time: how far it is, and how it is asked to end."""

import contextlib
import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable, Generator, Sequence
from types import FrameType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from rig.bridge.contract import Mode
    from rig.run.loop import Look


_PLAIN_EVERY_NS = 10_000_000_000
"""Time between two lines where they cannot be written over: ten seconds."""

_PLAIN_PROGRESS_S = 2.0
"""Time between two lines of long work."""

_REFRESH_NS = 200_000_000
"""Five times a second: as fast as a person reads."""


def _say(text: bytes) -> None:
    """Write to standard error, where that neither waits nor fails: the loop itself calls it."""
    with contextlib.suppress(OSError):
        if select.select((), (2,), (), 0.0)[1]:
            os.write(2, text)


@contextlib.contextmanager
def stoppable() -> Generator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM ask the loop to end in order instead of breaking it off."""
    asked = False

    def ask(_number: int, _frame: FrameType | None) -> None:
        nonlocal asked
        asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def progress_bar() -> Generator[Callable[[str, float], None]]:
    """A bar for the diagnosis, which has no tick to miss; plain lines where that cannot be."""
    shown = Console(stderr=True)
    if not shown.is_terminal:
        yield _plain_progress()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=shown, transient=True) as bars:
        task = bars.add_task("diagnosis", total=1.0, visible=False)

        def show(what: str, share: float) -> None:
            bars.update(task, description=what, completed=share, visible=share < 1.0)

        yield show


def _plain_progress() -> Callable[[str, float], None]:
    """Lines such as "  12 % reading"; none for work that takes less than two seconds."""
    due_s = time.monotonic() + _PLAIN_PROGRESS_S

    def show(what: str, share: float) -> None:
        nonlocal due_s
        now_s = time.monotonic()
        if now_s >= due_s:
            due_s = now_s + _PLAIN_PROGRESS_S
            _say(f"{100 * share:4.0f} % {what}\n".encode())

    return show


@contextlib.contextmanager
def status_line(
    duration_s: float | None, sensors: Sequence[str] = (), devices: Sequence[str] = ()
) -> Generator[Callable[["Look"], None]]:
    """State, rate, lateness, force and losses of a run, in place, or lines where that cannot be.

    A single write, because the loop itself calls it.

    Args:
        duration_s: Length of the run; None if it has none.
        sensors: Names of the further sensors.
        devices: Names of the devices.
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
        # What is wrong stands first: a narrow terminal cuts the end.
        text = f"{look.t_ns * 1e-9:8.1f}{total} s  {look.output.mode.name:<7}"
        # Since the last line: what the run keeps now.
        if look.t_ns > shown_ns and look.ticks > shown_ticks:
            text += f"  {(look.ticks - shown_ticks) / (look.t_ns - shown_ns) * 1e9:.0f} Hz"
        shown_ns, shown_ticks = look.t_ns, look.ticks
        text += f"  lost {look.counts.lost}"
        if look.counts.refused:
            text += f"  refused {look.counts.refused}"
        text += _of_sensors(look, sensors, devices)
        if look.late_ns is not None:
            text += f"  missed {look.counts.overruns}  late ≤ {look.late_ns * 1e-6:.2f} ms"
        # The largest force stands for all struts: a line is no table.
        for strut in sorted(look.output.struts, key=lambda item: -abs(item.force_n))[:1]:
            text += f"  force {strut.force_n:+7.1f} N"
            text += f"  innovation {strut.innovation_m * 1e3:+7.3f} mm"
            text += f"  virtual {strut.virtual_force_n:+7.1f} N"
        if is_terminal:
            width = shutil.get_terminal_size().columns - 1
            _say(f"\r{text[:width]:<{width}}".encode())
        else:
            _say(f"{text.strip()}\n".encode())

    try:
        yield show
    finally:
        if is_terminal:
            _say(b"\r\x1b[K")


def _of_sensors(look: "Look", sensors: Sequence[str], devices: Sequence[str]) -> str:
    """What is not used now, and why."""
    text = "".join(f"  {devices[place]}: {why}" for place, why in look.troubles)
    if look.output.left_out:
        text += f"  left out {', '.join(sensors[place] for place in look.output.left_out)}"
    return text


@contextlib.contextmanager
def progress_line(duration_s: float | None) -> Generator[Callable[[int, "Mode"], None]]:
    """One line that is rewritten; a single write, because the loop itself calls it."""
    shown = sys.stderr.isatty()
    due_ns = 0
    total = "" if duration_s is None else f" of {duration_s:g} s"

    def show(t_ns: int, mode: "Mode") -> None:
        nonlocal due_ns
        if shown and t_ns >= due_ns:
            due_ns = t_ns + _REFRESH_NS
            _say(f"\r{t_ns * 1e-9:9.1f} s{total}  {mode.name:<8}".encode())

    try:
        yield show
    finally:
        if shown:
            _say(b"\r\x1b[K")
