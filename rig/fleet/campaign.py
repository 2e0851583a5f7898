"""All runs of a fleet, on whatever executor there is.

Workers give rows back and write nothing; one writer appends them in parts. What is in a store is
not computed again, so that a campaign that was ended is gone on with by starting it again.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from rig.fleet import store
from rig.fleet.one_run import Row, Task, evaluated, identity_of, lost
from rig.fleet.sources import Source

PART_ROWS = 500
"""Rows that are held until they are written, at most."""

PART_S = 20.0
"""Longest time for which a row is held: what a killed writer loses."""


class Progress(NamedTuple):
    """How far a campaign is.

    Attributes:
        done: Runs that were evaluated now.
        failed: Those of them that failed.
        todo: Runs that had to be evaluated.
        skipped: Runs that were in the store already.
        elapsed_s: Time since the beginning.
        worked_s: Time that workers computed.
    """

    done: int
    failed: int
    todo: int
    skipped: int
    elapsed_s: float
    worked_s: float


class Model(NamedTuple):
    """A model as workers are given it.

    Attributes:
        text: The model file.
        folder: Folder of the files that it names.
    """

    text: str
    folder: str


def campaign(
    sources: Sequence[Source],
    model: Model,
    out: Path,
    make_executor: Callable[[], Executor],
    window: int,
    *,
    again: bool = False,
    progress: Callable[[Progress], None] = lambda _: None,
) -> Progress:
    """Evaluate what is not in the store yet.

    A worker that dies takes those with it that were being computed: they are tried again one by
    one, and the one that kills its worker a second time is a failed run.

    Args:
        sources: Runs.
        model: The model.
        out: The store.
        make_executor: Makes an executor; called again when one broke.
        window: Runs that are given to it at a time.
        again: Whether runs that failed before are tried again.
        progress: Called after each run.

    Raises:
        InputError: The store cannot be read or written.
    """
    store.sweep(out)
    known = store.identities(out, with_failed=not again)
    keys = store.keys(out)
    todo = [s for s in sources if identity_of(s, model.text) not in known]
    tasks = (Task(source, model.text, model.folder) for source in todo)
    begun = last_s = time.monotonic()
    held: list[Row] = []
    done = failed = 0
    worked_s = 0.0
    now = Progress(0, 0, len(todo), len(sources) - len(todo), 0.0, 0.0)
    progress(now)
    if not todo:
        return now
    try:
        for row in _rows(tasks, make_executor, window):
            done += 1
            failed += bool(row.error)
            worked_s += row.took_s if row.took_s == row.took_s else 0.0
            if row.key not in keys:
                keys.add(row.key)
                held.append(row)
            if len(held) >= PART_ROWS or time.monotonic() - last_s > PART_S:
                store.append(out, held)
                held, last_s = [], time.monotonic()
            now = now._replace(
                done=done, failed=failed, elapsed_s=time.monotonic() - begun, worked_s=worked_s
            )
            progress(now)
    finally:
        store.append(out, held)  # Ctrl-C loses nothing that was computed.
    return now


def _rows(
    tasks: Iterator[Task], make_executor: Callable[[], Executor], window: int
) -> Iterator[Row]:
    """Rows in the order in which they are ready."""
    executor = make_executor()
    pending: dict[Future[Row], Task] = {}
    ready: SimpleQueue[Future[Row]] = SimpleQueue()
    try:
        while True:
            while len(pending) < window and (task := next(tasks, None)) is not None:
                _submit(executor, task, pending, ready)
            if not pending:
                return
            future = ready.get()
            task = pending.pop(future)
            try:
                row = future.result()
            except (BrokenExecutor, CancelledError):
                # No worker is left: those that were computed are under suspicion, one by one.
                suspects = [task, *pending.values()]
                _end(executor, pending)
                pending, ready = {}, SimpleQueue()
                for suspect in suspects:
                    yield _alone(suspect, make_executor)
                executor = make_executor()
                continue
            except Exception as error:  # of an engine elsewhere, e.g. a killed worker
                row = lost(task, f"no worker gave it back: {type(error).__name__}: {error}")
            yield row
    finally:
        _end(executor, pending)


def _end(executor: Executor, pending: Iterable[Future[Row]]) -> None:
    """Leave an executor with what it was not yet given a worker for."""
    for future in pending:
        future.cancel()
    executor.shutdown(wait=False)


def _submit(
    executor: Executor,
    task: Task,
    pending: dict[Future[Row], Task],
    ready: "SimpleQueue[Future[Row]]",
) -> None:
    future: Future[Row]
    try:
        future = executor.submit(evaluated, task)
    except BrokenExecutor as error:
        future = Future()
        future.set_exception(error)
    pending[future] = task
    future.add_done_callback(ready.put)


def _alone(task: Task, make_executor: Callable[[], Executor]) -> Row:
    """A run in an executor of its own, which it may break."""
    executor = make_executor()
    try:
        return executor.submit(evaluated, task).result()
    except (BrokenExecutor, CancelledError):
        return lost(task, "killed its worker, alone as well")
    finally:
        _end(executor, ())
