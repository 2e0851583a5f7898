"""When ticks come: a real clock with absolute deadlines, or a virtual one that never waits."""

import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Time of a run, in ns since its start."""

    @property
    def epoch_ns(self) -> int:
        """Unix time of the run's start."""
        ...

    def epoch_now_ns(self) -> int:
        """Unix time of the run's start by the system's clock as it is set now."""
        ...

    def now_ns(self) -> int:
        """Time of the run."""
        ...

    def wait_until(self, t_ns: int) -> int:
        """Wait for a time of the run; returns the time at which it woke up."""
        ...


class RealClock:
    """Monotonic time, immune to steps of the system's clock.

    Args:
        spin_ns: How long before a deadline to stop sleeping and spin. Only a thread with a
            real-time priority may spin: any other loses priority at the scheduler.
    """

    def __init__(self, spin_ns: int = 0) -> None:
        self._start_ns = time.monotonic_ns()
        self.epoch_ns = time.time_ns()
        self._spin_ns = spin_ns

    def epoch_now_ns(self) -> int:
        """Unix time of the run's start by the system's clock as it is set now."""
        return time.time_ns() - self.now_ns()

    def now_ns(self) -> int:
        """Time since the start of the run."""
        return time.monotonic_ns() - self._start_ns

    def wait_until(self, t_ns: int) -> int:
        """Sleep (on Linux against an absolute deadline), then spin if configured."""
        now = self.now_ns()
        if t_ns - now > self._spin_ns:
            time.sleep((t_ns - now - self._spin_ns) * 1e-9)
            now = self.now_ns()
        while now < t_ns:
            now = self.now_ns()
        return now


class VirtualClock:
    """Time that jumps to where it is awaited: a simulation as fast as the machine allows."""

    epoch_ns = 0

    def __init__(self) -> None:
        self._now_ns = 0

    def epoch_now_ns(self) -> int:
        """The same: a simulated clock is never set."""
        return self.epoch_ns

    def now_ns(self) -> int:
        """Last awaited time."""
        return self._now_ns

    def wait_until(self, t_ns: int) -> int:
        """Jump to `t_ns`, never back."""
        self._now_ns = max(self._now_ns, t_ns)
        return self._now_ns


class WrappedClock:
    """A clock that adds to the waits of another."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    @property
    def epoch_ns(self) -> int:
        """Unix time of the run's start."""
        return self._clock.epoch_ns

    def epoch_now_ns(self) -> int:
        """The same by the system's clock as it is set now."""
        return self._clock.epoch_now_ns()

    def now_ns(self) -> int:
        """Time of the run."""
        return self._clock.now_ns()

    def wait_until(self, t_ns: int) -> int:
        """Wait as the other clock does."""
        return self._clock.wait_until(t_ns)


class OccupiedClock(WrappedClock):
    """A clock whose waits begin with work, which so takes time that would be spent waiting.

    The work is given the time that is awaited.
    """

    def __init__(self, clock: Clock, occupation: Callable[[int], None]) -> None:
        super().__init__(clock)
        self._occupation = occupation

    def wait_until(self, t_ns: int) -> int:
        """Work, then wait."""
        self._occupation(t_ns)
        return super().wait_until(t_ns)
