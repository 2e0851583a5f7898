"""A bus that may disappear and return during a run."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

from msgspec.structs import replace

from can_dbc.frame import Frame
from rig.bus.bus import Bus, BusError, BusFullError
from rig.bus.controller import Controller, state_after
from rig.bus.secoc import Authenticator

FIRST_PAUSE_NS = 50_000_000
"""Pause before a lost interface is opened again; doubled at every failure."""

LONGEST_PAUSE_NS = 1_000_000_000

SENDING_FAILED_NS = 500_000_000
"""Time in which every frame may fail to be sent before the interface is opened again."""

_MOST_GAPS = 1000
_WALL_CLOCK_SET_NS = 2_000_000
"""Deviation of a stamp from the tick that reads it from which the system's clock is checked."""


class Gap(NamedTuple):
    """A time without a bus, from tick to tick, None if it never was back, and why."""

    from_ns: int
    to_ns: int | None
    why: str


@dataclass
class LinkFigures:
    """Faults of a bus during a run.

    Attributes:
        warnings: Times the controller reached its warning limit.
        passive: Times it became error-passive.
        unauthentic: Frames refused because no fresh value fits their authenticator.
        replayed: Frames refused because their freshness value is not newer than the last one, or
            too far from the own clock.
        gaps: Times without an interface, at most the first 1000.
    """

    error_frames: int = 0
    warnings: int = 0
    passive: int = 0
    bus_off: int = 0
    unsent: int = 0
    clock_steps: int = 0
    unauthentic: int = 0
    replayed: int = 0
    gaps: list[Gap] = field(default_factory=list[Gap])

    def as_dict(self) -> dict[str, object]:
        """For `run.yaml`."""
        gaps = [
            {
                "from_s": gap.from_ns * 1e-9,
                "to_s": None if gap.to_ns is None else gap.to_ns * 1e-9,
                "why": gap.why,
            }
            for gap in self.gaps
        ]
        return {**vars(self), "gaps": gaps}


class Link:
    """An open bus that is opened again when it is lost.

    Opening takes seconds at some interfaces, so a thread does it, and a tick only checks whether it
    is done.

    Args:
        open_bus: Opens the bus; called at once, and again whenever it was lost.
        epoch_now_ns: Unix time of the run's start by the system's clock as it is set now.
        executor: Runs `open_bus` when it was lost; a new thread by default.
        authenticator: Secures sent frames and accepts authentic ones alone; None does neither.

    Raises:
        BusError: The bus cannot be opened at the start.
    """

    def __init__(
        self,
        open_bus: Callable[[], Bus],
        epoch_now_ns: Callable[[], int],
        executor: Executor | None = None,
        authenticator: Authenticator | None = None,
    ) -> None:
        self.figures = LinkFigures()
        self.fault: str | None = None
        """Present fault; None if there is none."""
        self._open_bus = open_bus
        self._epoch_now_ns = epoch_now_ns
        self._authenticator = authenticator
        self._executor = executor or ThreadPoolExecutor(1, thread_name_prefix="bus")
        self._bus: Bus | None = open_bus()
        self._epoch_ns = self._bus.epoch_ns
        self._controller = Controller.ACTIVE
        self._last_ns = -1
        self._opening: Future[Bus] | None = None
        self._pause_ns = FIRST_PAUSE_NS
        self._retry_ns = 0
        self._unsent_since_ns: int | None = None

    def receive(self, t_ns: int) -> Sequence[Frame]:
        """Frames received since the last tick, none while the bus is lost.

        A frame's time is that of its arrival: after the last tick, and at the latest at this one.
        """
        bus = self._bus or self._reopen(t_ns)
        if bus is None:
            self._last_ns = t_ns
            return ()
        try:
            frames = bus.receive(t_ns - self._last_ns)
        except BusError as error:
            self._lose(t_ns, str(error))
            frames = []
        else:
            if self._pause_ns != FIRST_PAUSE_NS:
                self._end_gap(t_ns)
        last_ns, self._last_ns = self._last_ns, t_ns
        for index, frame in enumerate(frames):
            if not last_ns < frame.t_ns <= t_ns:
                frames[index] = replace(frame, t_ns=self._arrival_ns(frame.t_ns, last_ns, t_ns))
            if frame.is_error or self._controller:
                self._update_controller(frame)
        return frames if self._authenticator is None else self._authenticate(frames)

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Send; returns the frames that were sent."""
        bus = self._bus
        if bus is None or bus.listens_only:
            return ()
        secured = None if self._authenticator is None else self._authenticator.secure
        done = 0
        try:
            for frame in frames:
                bus.send(frame if secured is None else secured(frame))
                done += 1
        except BusError as error:
            self._record_send_failure(frames[done:], error)
            return frames[:done]
        if self._unsent_since_ns is not None and frames:
            self._unsent_since_ns = None
            self._report_controller()
        return frames

    @property
    def authentication_failures(self) -> int:
        """Frames refused so far because they are not authentic or not new."""
        return self.figures.unauthentic + self.figures.replayed

    def close(self) -> None:
        """Close the bus."""
        if self._opening is not None:
            self._opening.add_done_callback(_close_late)
        self._executor.shutdown(wait=False, cancel_futures=True)
        if self._bus is not None:
            self._bus.close()

    def _authenticate(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        authenticator, figures = self._authenticator, self.figures
        if authenticator is None:
            return frames
        accepted = authenticator.authenticate(frames)
        figures.unauthentic, figures.replayed = authenticator.unauthentic, authenticator.replayed
        return accepted

    def _arrival_ns(self, stamp_ns: int, last_ns: int, t_ns: int) -> int:
        """Time within the tick for a stamp outside of it."""
        if t_ns < stamp_ns < t_ns + _WALL_CLOCK_SET_NS:
            return t_ns
        epoch_ns = self._epoch_now_ns()
        step_ns = epoch_ns - self._epoch_ns
        if abs(step_ns) > _WALL_CLOCK_SET_NS:
            # The system's clock, which stamps the frames, was set; the run's clock was not.
            self.figures.clock_steps += 1
            self._epoch_ns = epoch_ns
            if self._bus is not None:
                self._bus.epoch_ns = epoch_ns
            stamp_ns -= step_ns
        # A frame read now arrived since the last tick, or waited in the queue behind a flood.
        return min(max(stamp_ns, last_ns + 1), t_ns)

    def _update_controller(self, frame: Frame) -> None:
        before, self._controller = self._controller, state_after(self._controller, frame)
        figures = self.figures
        figures.error_frames += frame.is_error
        if self._controller > before:
            figures.warnings += self._controller is Controller.WARNING
            figures.passive += self._controller is Controller.PASSIVE
            figures.bus_off += self._controller is Controller.BUS_OFF
        if self._controller is not before:
            self._report_controller()

    def _report_controller(self) -> None:
        faulty = self._controller >= Controller.PASSIVE
        self.fault = f"the controller is {self._controller.name}" if faulty else None

    def _record_send_failure(self, frames: Sequence[Frame], error: BusError) -> None:
        self.figures.unsent += len(frames)
        self.fault = str(error)
        if self._unsent_since_ns is None:
            self._unsent_since_ns = self._last_ns
        elif (
            not isinstance(error, BusFullError)
            and self._last_ns - self._unsent_since_ns > SENDING_FAILED_NS
        ):
            self._lose(self._last_ns, str(error))

    def _lose(self, t_ns: int, why: str) -> None:
        if self._bus is not None:
            self._bus.close()
            self._bus = None
        gaps = self.figures.gaps
        if self._pause_ns == FIRST_PAUSE_NS and len(gaps) < _MOST_GAPS:
            gaps.append(Gap(t_ns, None, why))
        self.fault = why
        self._retry_ns = t_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)

    def _reopen(self, t_ns: int) -> Bus | None:
        """The bus, if it could be opened; the gap ends only when a tick has read from it."""
        if self._opening is None:
            if t_ns >= self._retry_ns:
                self._opening = self._executor.submit(self._open_bus)
            return None
        if not self._opening.done():
            return None
        opening, self._opening = self._opening, None
        error = opening.exception()
        if error is None:
            self._bus = opening.result()
            self._bus.epoch_ns = self._epoch_ns
            return self._bus
        if not isinstance(error, BusError):
            raise error
        self._lose(t_ns, str(error))
        return None

    def _end_gap(self, t_ns: int) -> None:
        gaps = self.figures.gaps
        if gaps and gaps[-1].to_ns is None:
            gaps[-1] = gaps[-1]._replace(to_ns=t_ns)
        self._pause_ns = FIRST_PAUSE_NS
        self._unsent_since_ns = None
        self._controller = Controller.ACTIVE
        self.fault = None


def _close_late(opening: Future[Bus]) -> None:
    """Close a bus that was opened after the link was closed."""
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()
