"""A process that sends the safe output when the loop stands still, or when its process dies.

It shares a page of memory with the loop, which writes to it at every tick, and a pipe that the
system closes with the loop's process. It has a connection to the bus of its own, which not every
interface allows for.
"""

import contextlib
import json
import mmap
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypedDict

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.bridge.bridge import BridgeState
from rig.bridge.counts import Conditions, Counts, Report
from rig.bridge.mode_supervisor import CAUSE_NUMBERS, Event
from rig.bridge.outgoing_messages import Outgoing, compile_outgoing
from rig.bridge.values import Mode, StepOutput, StrutOutput
from rig.bus.bus import SHARED_INTERFACES, Bus, BusError
from rig.bus.secoc import Authentication, Authenticator
from rig.machine.child_processes import PYTHON
from rig.plan.config import RunConfig
from rig.plan.load import plan_of_run
from rig.plan.plan import Plan

_EVERY_S = 0.01
"""Time between two looks at the loop, and between two frames of a message."""

_FRAMES = 10
"""Frames of each message after the loop's process has died: a receiver that has lost the sequence
of the counter has it again by then."""

_READY_S = 300.0
"""Longest wait for the process to be ready. A second is usual; an emulated machine takes minutes to
import what it uses."""

_READY, _END = "ready", b"end"


class _Order(TypedDict):
    """What the process is given: the run's folder, the shared memory, and the key if there is one.

    The key comes through a pipe: no other process can read it.
    """

    folder: str
    memory: int
    authentication: dict[str, int | str] | None


def can_watch(config: RunConfig, *, listen_only: bool) -> bool:
    """Whether a run on a bus has a watchdog."""
    is_shared = config.bus.interface in SHARED_INTERFACES and os.name == "posix"
    return config.supervision.watchdog and is_shared and not listen_only


class Beat(NamedTuple):
    """What the loop writes at every tick.

    Attributes:
        ticks: Ticks so far; then the frames that were sent of each message.
        forces_n: Force of each strut that was valid last.
    """

    ticks: "memoryview[int]"
    forces_n: "memoryview[float]"

    @staticmethod
    def on(memory: mmap.mmap, messages: int) -> "Beat":
        """The shared memory, for a number of outgoing messages."""
        view = memoryview(memory)
        end = 8 * (1 + messages)
        return Beat(view[:end].cast("q"), view[end:].cast("d"))

    @staticmethod
    def size_of(messages: int, struts: int) -> int:
        """Bytes that it takes."""
        return 8 * (1 + messages + struts)

    def write(self, state: BridgeState) -> None:
        """Note a tick."""
        ticks = self.ticks
        for index, sending in enumerate(state.sendings, start=1):
            ticks[index] = sending.number
        for index, strut in enumerate(state.supervised.last_valid):
            self.forces_n[index] = strut.force_n
        ticks[0] += 1


class Watchdog:
    """The process, as the run sees it."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        self._plan, self._folder = plan, folder
        messages, struts = len(plan.outgoing), len(plan.struts)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed in `stop`
        self._file.truncate(Beat.size_of(messages, struts))
        self._memory = mmap.mmap(self._file.fileno(), 0)
        self._beat = Beat.on(self._memory, messages)
        self.write = self._beat.write
        orders, self._orders = os.pipe()
        self._answers, answering = os.pipe()
        # Now: what it imports takes as long as the run's own setting up.
        self._process = subprocess.Popen(  # noqa: S603 - a module of rig's
            [*PYTHON, "-m", __name__],
            stdin=orders,
            stdout=answering,
            pass_fds=(self._file.fileno(),),
            # Ctrl-C in a terminal is for the run.
            start_new_session=True,
        )
        os.close(orders)
        os.close(answering)

    def start(self) -> None:
        """Let it watch, and wait until it is ready; the run's folder has its inputs.

        Raises:
            BusError: It cannot open the bus, or does not get ready.
        """
        order: _Order = {
            "folder": str(self._folder.resolve()),
            "memory": self._file.fileno(),
            "authentication": _as_values(self._plan.authentication),
        }
        self._write(json.dumps(order).encode())
        ready, _, _ = select.select([self._answers], [], [], _READY_S)
        answer = os.read(self._answers, 1000).decode() if ready else f"not ready in {_READY_S:g} s"
        if answer != _READY:
            self._process.kill()
            self._process.wait()
            raise BusError(
                f"the watchdog could not be started: {answer.strip() or 'it has ended'} "
                "(supervision.watchdog: false runs without it)"
            )

    def _write(self, text: bytes) -> None:
        with contextlib.suppress(BrokenPipeError):  # it has ended, which shows elsewhere
            os.write(self._orders, text)

    def describe(self) -> str:
        """Whether it still watches, for `run.yaml`."""
        code = self._process.poll()
        return "watched" if code is None else f"ended before the run, exit code {code}"

    def stop(self) -> None:
        """End it."""
        self._write(_END)
        self._process.wait()
        os.close(self._orders)
        os.close(self._answers)
        for view in self._beat:
            view.release()
        self._memory.close()
        self._file.close()


def safe_frames(
    outgoing: Sequence[Outgoing], beat: Beat, sent: int, t_ns: int, *, is_last: bool
) -> list[Frame]:
    """Every message once with the safe output, after `sent` others of them.

    Counters continue from the loop's; counts of the status are not known here, and 0.
    """
    forces_n = beat.forces_n if is_last else [0.0] * len(beat.forces_n)
    struts = tuple([StrutOutput(n, 0.0, False, 0.0, 0.0, 0.0, 0.0) for n in forces_n])
    output = StepOutput(Mode.SAFE, struts, (), CAUSE_NUMBERS[Event.TICKS_MISSING])
    reports = (
        Report(output, Counts(), Counts(), Conditions(), number + sent) for number in beat.ticks[1:]
    )
    return [item.frame(report, t_ns)[0] for item, report in zip(outgoing, reports, strict=True)]


class Wake(NamedTuple):
    """A look at the pipe: its time, and what came through it; nothing if it was closed."""

    t_ns: int
    received: bytes | None


def watch(
    beat: Beat, safe_after_ns: int, wait: Callable[[], Wake], send: Callable[[int], None]
) -> int | None:
    """Send the safe output as long as the loop stands still; returns when its process ends.

    Args:
        beat: What the loop writes.
        safe_after_ns: Time without a tick from which the loop stands still.
        wait: Waits a little, and looks.
        send: Sends every message once, after a number of others since the loop's last tick.

    Returns:
        How often it has sent since the last tick if the process died in a run, None if it ended.
    """
    ticks, since_ns, sent = 0, 0, 0
    while True:
        look, now = wait(), beat.ticks[0]
        if now != ticks:
            ticks, since_ns, sent = now, look.t_ns, 0
        if look.received is not None:
            return None if look.received or not ticks else sent
        if ticks and look.t_ns - since_ns > safe_after_ns:
            send(sent)
            sent += 1


def _as_values(authentication: Authentication | None) -> dict[str, int | str] | None:
    if authentication is None:
        return None
    values = {name: getattr(authentication, name) for name in authentication.__dataclass_fields__}
    return {**values, "key": authentication.key.hex()}


def _secure(values: dict[str, int | str] | None) -> Callable[[Frame], Frame]:
    """What authenticates a frame, stamped with Unix time."""
    if values is None:
        return lambda frame: frame
    numbers = {name: int(value) for name, value in values.items() if name != "key"}
    key = bytes.fromhex(str(values["key"]))
    return Authenticator(Authentication(key=key, **numbers), 0).secure


def main() -> None:
    """Watch the run that is described on standard input."""
    # The end of the run ends it, and nothing else.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # The loop's core is its own.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    pipe = sys.stdin.fileno()
    given = os.read(pipe, 100_000)
    if given in (b"", _END):  # the run was not begun
        return
    order: _Order = json.loads(given)
    try:
        plan = plan_of_run(Path(order["folder"]))
        outgoing = [compile_outgoing(item.message, item.signals) for item in plan.outgoing]
        bus = Bus(plan.config.bus, ())
    except InputError as error:
        print(error, flush=True)
        return
    memory = mmap.mmap(order["memory"], 0)
    beat = Beat.on(memory, len(outgoing))
    secure = _secure(order["authentication"])
    supervision = plan.config.supervision
    is_last = supervision.safe_output == "last"

    def wait() -> Wake:
        ready, _, _ = select.select([pipe], [], [], _EVERY_S)
        return Wake(time.monotonic_ns(), os.read(pipe, 100) if ready else None)

    def send(sent: int) -> None:
        for frame in safe_frames(outgoing, beat, sent, time.time_ns(), is_last=is_last):
            try:
                bus.send(secure(frame))
            except BusError:  # nothing else can be done about it
                continue

    print(_READY, end="", flush=True)
    sent = watch(beat, supervision.safe_after_ns, wait, send)
    if sent is not None:
        for further in range(_FRAMES):
            send(sent + further)
            time.sleep(_EVERY_S)
    bus.close()


if __name__ == "__main__":
    main()
