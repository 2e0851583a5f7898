"""Requests of a fixed rate to the machine: priority, memory, core, timer and garbage collection.

Everything is requested and nothing is required: what the machine refuses is recorded, and the run
continues without it.
"""

import contextlib
import ctypes
import ctypes.util
import gc
import os
import sys
from collections.abc import Generator
from dataclasses import asdict, dataclass
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from can_dbc.yaml_file import Finite

_MCL_CURRENT_AND_FUTURE = 3
_PR_SET_TIMERSLACK = 29
_PR_SET_THP_DISABLE = 41
"""Number of the request in linux/prctl.h, which the C library's wrapper takes as it is."""

_SWITCH_INTERVAL_S = 1e-4
"""Longest time for which another thread (the log's) holds the interpreter while the loop waits."""


class Realtime(BaseModel):
    """Real-time conditions that are requested; a run works without any of them.

    Attributes:
        fifo_priority: Priority under SCHED_FIFO; 0 requests none.
        lock_memory: Lock all pages in memory.
        cpu: Core on which the loop runs; if absent, the scheduler chooses it.
        spin_s: Time for which the loop spins before a deadline, at most a fifth of the period; only
            if SCHED_FIFO was granted.
        freeze_garbage: Collect garbage before the run and not during it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    fifo_priority: Annotated[int, Field(ge=0, le=99)] = 50
    lock_memory: bool = True
    cpu: Annotated[int, Field(ge=0, le=65_535)] | None = None
    spin_s: Annotated[Finite, Field(ge=0, le=0.01)] = 0.0002
    freeze_garbage: bool = True


@dataclass(frozen=True)
class Granted:
    """Real-time conditions that the machine granted; without huge pages pages are small.

    The kernel would search memory for huge pages every ten seconds.
    """

    fifo: bool
    locked_memory: bool
    cpu: int | None
    timer_slack: bool
    small_pages: bool
    frozen_garbage: bool

    def as_dict(self) -> dict[str, object]:
        """For `run.yaml`."""
        return asdict(self)


@contextlib.contextmanager
def realtime(request: Realtime) -> Generator[Granted]:
    """Context with real-time conditions, as granted, which are released at its end."""
    libc = ctypes.CDLL(ctypes.util.find_library("c"), use_errno=True)
    affinity = os.sched_getaffinity(0)
    switch_interval_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    granted = Granted(
        fifo=_fifo(request.fifo_priority),
        locked_memory=request.lock_memory and libc.mlockall(_MCL_CURRENT_AND_FUTURE) == 0,
        cpu=_pin(request.cpu),
        timer_slack=libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0) == 0,
        small_pages=libc.prctl(_PR_SET_THP_DISABLE, 1, 0, 0, 0) == 0,
        frozen_garbage=request.freeze_garbage,
    )
    if request.freeze_garbage:
        gc.collect()
        gc.freeze()
        gc.disable()
    try:
        yield granted
    finally:
        if request.freeze_garbage:
            gc.enable()
            gc.unfreeze()
        if granted.locked_memory:
            libc.munlockall()
        if granted.fifo:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        if granted.cpu is not None:
            os.sched_setaffinity(0, affinity)
        libc.prctl(_PR_SET_TIMERSLACK, 0, 0, 0, 0)
        libc.prctl(_PR_SET_THP_DISABLE, 0, 0, 0, 0)
        sys.setswitchinterval(switch_interval_s)


def follow(priority: int) -> None:
    """Let the calling thread run just below the loop's real-time priority, where that is allowed.

    A thread that holds the interpreter and waits for the processor behind ordinary processes makes
    the loop wait with it, whatever the loop's own priority is. Without one nothing is done.
    """
    if priority > 1:
        _fifo(priority - 1)


def _fifo(priority: int) -> bool:
    if priority == 0:
        return False
    try:
        # What is started later must not inherit it: threads ask for their own.
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def _pin(cpu: int | None) -> int | None:
    if cpu is None:
        return None
    try:
        os.sched_setaffinity(0, {cpu})
    except (OSError, AttributeError):
        return None
    return cpu
