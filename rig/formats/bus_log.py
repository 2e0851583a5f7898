"""Turns a bus log of another program into a run, as if the bridge had received it live."""

from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from can_dbc.addressing import Directory
from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.bridge.counts import Conditions
from rig.bus.link import LinkFigures
from rig.bus.log_files import read_log
from rig.formats.import_report import ImportReport
from rig.machine.clock import VirtualClock
from rig.plan.build import build_bridge
from rig.plan.plan import Plan
from rig.run.logged_run import Endpoint, run_with_log
from rig.run.loop import Progress, RunControl

_LONGEST_GAP_NS = 3_600_000_000_000
"""Longest time between two frames of one recording, an hour; more is another recording, or a wrong
clock."""


class _LogPort:
    """Frames of a foreign log, tick by tick. What the bridge sends is discarded."""

    def __init__(self, source: Path, directory: Directory, first_due_ns: int) -> None:
        self._source = source
        self._frames = read_log(source)
        self._directory = directory
        self.received = 0
        self.others = 0
        self.last_ns = 0
        self._waiting = self._next()
        self.first_ns = 0 if self._waiting is None else self._waiting.t_ns
        self._shift_ns = first_due_ns - self.first_ns

    @property
    def is_exhausted(self) -> bool:
        """Whether all frames were read."""
        return self._waiting is None

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        """Frames up to a tick."""
        frames: list[Frame] = []
        while (frame := self._waiting) is not None and frame.t_ns + self._shift_ns <= t_ns:
            # A log of several channels may be slightly out of order.
            self.last_ns = max(frame.t_ns, self.last_ns)
            frames.append(replace(frame, t_ns=self.last_ns + self._shift_ns))
            self.received += 1
            self._waiting = self._next()
        return frames, Conditions()

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Log nothing as sent."""
        return frames[:0]

    def _next(self) -> Frame | None:
        for _, frame in self._frames:
            if self._directory.index_of(frame.arbitration_id, frame.is_extended) is not None:
                if self.received and frame.t_ns - self.last_ns > _LONGEST_GAP_NS:
                    gap_s = (frame.t_ns - self.last_ns) * 1e-9
                    raise InputError(
                        f"{self._source}: {gap_s:.0f} s without a frame of the bench, "
                        "expected a log of one run: cut it there"
                    )
                return frame
            self.others += 1
        return None


def import_log(
    source: Path, plan: Plan, out: Path, progress: Progress = lambda _t, _mode: None
) -> ImportReport:
    """Turn a bus log of another program into a run, as if the bridge had received it live.

    Args:
        source: BLF, ASC, candump, TRC or MF4 log of a bus.
        plan: Plan with the signals to read.
        out: Folder of the run to write; absent or empty.
        progress: Called with time and mode of every tick.

    Raises:
        InputError: The log cannot be read, holds no frame of the configured signals, or the folder
            cannot be written.
    """
    bridge = build_bridge(plan)
    # Half a tick after a tick, so that the jitter of a bench as fast as the bridge gives each tick
    # one frame, and not two to one and none to the next.
    port = _LogPort(source, bridge.directory, plan.period_ns // 2)
    names = tuple(item.message.name for item in bridge.incoming)
    if port.is_exhausted:
        raise InputError(
            f"{source}: none of its {port.others} frames is one of {', '.join(names)}, "
            "expected a log of the bench that the configuration describes"
        )
    endless = plan.with_config(plan.config.model_copy(update={"duration_s": None}))
    endpoint = Endpoint(port, VirtualClock(), LinkFigures())
    control = RunControl(stop=lambda: port.is_exhausted, progress=progress)
    ended = run_with_log(endless, bridge, endpoint, out, control)
    duration_s = (port.last_ns - port.first_ns) * 1e-9
    counts = ended.state.counts
    return ImportReport(
        out,
        port.received,
        duration_s,
        port.received / duration_s if duration_s > 0.0 else 0.0,
        names,
        (
            f"meaning of the frames from {plan.database.path.name}; "
            f"{port.others} frames of other ids left out",
            "all frames taken as received, without error frames; the first one is at half a tick",
            f"estimates computed with model {plan.model.name} at {plan.config.rate_hz:g} Hz",
            f"{counts.lost} frames lost and {counts.refused} refused: counts in run.yaml say why",
        ),
    )
