"""What a machine does to a run besides its load: suspension, a clock that is set, slower cores."""

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

_OF_A_CORE = {"scaling_governor": "governor", "scaling_max_freq": "max_frequency_khz"}
_OF_ALL_CORES = {"cpufreq/boost": "boost", "intel_pstate/no_turbo": "no_turbo"}
"""Files of the kernel -> their names in a run's record."""


class ClockOffset(NamedTuple):
    """How far a clock is ahead of another; within bounds, since one is read after the other."""

    low_ns: int
    high_ns: int

    def shift_ns(self, before: "ClockOffset") -> int:
        """By how much it has moved since before; 0 where it need not have."""
        if self.low_ns <= before.high_ns and before.low_ns <= self.high_ns:
            return 0
        return (sum(self) - sum(before)) // 2


@dataclass(frozen=True)
class MachineState:
    """State of a machine at one time.

    Attributes:
        suspended: What the clock that counts suspension is ahead of the one that does not.
        wall: What the wall clock is ahead of the one that counts suspension.
        frequency: What limits the frequency of some cores; empty where the kernel does not say.
    """

    suspended: ClockOffset
    wall: ClockOffset
    frequency: Mapping[str, str]


@dataclass(frozen=True)
class MachineReader:
    """Reads the state of a machine.

    Attributes:
        cpus: Cores whose frequency matters.
        folder: The kernel's account of the cores.
        clock_ns: Time of one of the system's clocks.
    """

    cpus: tuple[int, ...]
    folder: Path = Path("/sys/devices/system/cpu")
    clock_ns: Callable[[int], int] = time.clock_gettime_ns

    def read(self) -> MachineState:
        """The state now."""
        return MachineState(
            self._offset(time.CLOCK_BOOTTIME, time.CLOCK_MONOTONIC),
            self._offset(time.CLOCK_REALTIME, time.CLOCK_BOOTTIME),
            self._frequency(),
        )

    def _offset(self, clock: int, reference: int) -> ClockOffset:
        begin_ns = self.clock_ns(reference)
        now_ns = self.clock_ns(clock)
        return ClockOffset(now_ns - self.clock_ns(reference), now_ns - begin_ns)

    def _frequency(self) -> dict[str, str]:
        paths = {name: [self.folder / file] for file, name in _OF_ALL_CORES.items()}
        for file, name in _OF_A_CORE.items():
            paths[name] = [self.folder / f"cpu{cpu}" / "cpufreq" / file for cpu in self.cpus]
        found = {name: sorted(set(_read_all(files))) for name, files in paths.items()}
        return {name: ", ".join(texts) for name, texts in found.items() if texts}


def _read_all(paths: list[Path]) -> list[str]:
    """What is in files, without those that cannot be read."""
    texts: list[str] = []
    for path in paths:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            texts.append(path.read_text("ascii").strip())
    return texts
