"""Where the runs of a fleet are computed: processes of this machine, or a cluster of Dask."""

import importlib
import os
import signal
import sys
from collections.abc import Callable, Generator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import NamedTuple

from can_dbc.errors import InputError
from rig.machine.child_processes import spawn_context

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_AHEAD = 4
"""Runs that are given to each worker ahead of time, so that none waits for the next one."""


class Engine(NamedTuple):
    """What makes an executor, in words too, and the runs that it is given at a time."""

    words: str
    make: Callable[[], Executor]
    window: int


def processes(jobs: int | None) -> Engine:
    """Processes of this machine: `jobs`, or one for each core that this program may use."""
    count = jobs or _cores()
    for name in _THREADS:  # Workers are as many as cores; theirs would be in the way.
        os.environ.setdefault(name, "1")
    make = partial(
        ProcessPoolExecutor,
        count,
        mp_context=spawn_context(),
        # Ctrl-C is the parent's: it ends in order, and with it its workers.
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_IGN),
    )
    return Engine(f"{count} processes", make, _AHEAD * count)


def _cores() -> int:
    """Those that this program may use, where the system says so."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def dask(address: str) -> Generator[Engine]:
    """A cluster that runs already, known by its scheduler; its workers need rig as well.

    Raises:
        InputError: Dask is not installed, or there is no scheduler.
    """
    try:
        library = importlib.import_module("distributed")
    except ModuleNotFoundError as error:
        raise InputError(
            "distributed is not installed, expected `pip install dask[distributed]`"
        ) from error
    try:
        client = library.Client(address, timeout="10s", set_as_default=False)
    except Exception as error:  # of any of the libraries under it
        raise InputError(f"--dask {address}: no scheduler there ({error})") from error
    threads = sum(client.nthreads().values())
    if not threads:
        raise InputError(f"--dask {address}: a scheduler without workers")
    words = f"Dask at {address}, {threads} threads of workers"
    try:
        yield Engine(words, partial(client.get_executor, pure=False), _AHEAD * threads)
    finally:
        client.close()
