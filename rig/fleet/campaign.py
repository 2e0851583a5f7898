"""All runs of a fleet, on whatever executor there is.

Workers give rows back and write nothing; one writer appends them in parts. What is in a store is
not computed again, so that a campaign that was ended is gone on with by starting it again.
"""

import hashlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple

from can_dbc.errors import InputError
from can_dbc.yaml_file import read_text
from dart_model.spec import files_of, load_model
from rig.fleet import store
from rig.fleet.one_run import FleetModel, RunRow, evaluate_run, identity_of, row_without_result
from rig.fleet.sources import RunSource

PART_ROWS = 500
"""Rows that are held until they are written, at most."""

PART_S = 20.0
"""Longest time for which a row is held: what a killed writer loses."""


class CampaignProgress(NamedTuple):
    """How far a campaign is.

    Attributes:
        done: Runs that were evaluated now.
        failed: Those of them that failed.
        todo: Runs that had to be evaluated.
        skipped: Runs that were in the store already.
        worked_s: Time that workers computed.
    """

    done: int
    failed: int
    todo: int
    skipped: int
    elapsed_s: float
    worked_s: float

    @property
    def words(self) -> str:
        """The same in a sentence."""
        rate = self.done / self.elapsed_s if self.elapsed_s > 0.0 else 0.0
        return (
            f"{self.done} evaluated in {self.elapsed_s:.1f} s ({rate:.2f} a second), "
            f"{self.failed} of them failed; {self.skipped} were in the store"
        )


def load_fleet_model(file: Path) -> FleetModel:
    """A model from its file.

    Raises:
        InputError: It is wrong, or a file that it names cannot be read.
    """
    spec, text = load_model(file), read_text(file)
    found = hashlib.sha256(text.encode())
    for name in files_of(spec):
        try:
            found.update((spec.folder / name).read_bytes())
        except OSError as error:
            raise InputError(f"{spec.folder / name}: cannot be read ({error.strerror})") from error
    return FleetModel(text, str(file.parent.absolute()), found.hexdigest())


def run_campaign(
    sources: Sequence[RunSource],
    model: FleetModel,
    out: Path,
    make_executor: Callable[[], Executor],
    window: int,
    *,
    again: bool = False,
    progress: Callable[[CampaignProgress], None] = lambda _: None,
) -> CampaignProgress:
    """Evaluate what is not in the store yet.

    A worker that dies takes those with it that were being computed: they are tried again one by
    one, and the one that kills its worker a second time is a failed run.

    An executor is given `window` runs at a time, and made again when it broke. With `again`, runs
    that failed before are tried again. `progress` is called after each run.

    Raises:
        InputError: The store cannot be read or written.
    """
    store.sweep(out)
    evaluated = store.read_runs(out)
    keys = {key for key, _, _ in evaluated}
    known = {identity for _, identity, error in evaluated if not (again and error)}
    todo = [s for s in sources if identity_of(s, model.sha256) not in known]
    begun = last_s = time.monotonic()
    held: list[RunRow] = []
    now = CampaignProgress(0, 0, len(todo), len(sources) - len(todo), 0.0, 0.0)
    progress(now)
    if not todo:
        return now
    try:
        for row in _rows(todo, model, make_executor, window):
            if time.monotonic() - last_s > PART_S or len(held) >= PART_ROWS:
                store.append(out, held)
                held, last_s = [], time.monotonic()
            if row is None:
                continue
            # A copy is known from now on, and counted once: its values are there already.
            held.append(replace(row, values=()) if row.key in keys else row)
            keys.add(row.key)
            now = now._replace(
                done=now.done + 1,
                failed=now.failed + bool(row.error),
                elapsed_s=time.monotonic() - begun,
                worked_s=now.worked_s + (0.0 if math.isnan(row.took_s) else row.took_s),
            )
            progress(now)
    finally:
        store.append(out, held)  # Ctrl-C loses nothing that was computed.
    return now


def _rows(
    sources: Iterable[RunSource],
    model: FleetModel,
    make_executor: Callable[[], Executor],
    window: int,
) -> Iterator[RunRow | None]:
    """Rows in the order in which they are ready; None where none was for a while."""
    waiting = iter(sources)
    executor = make_executor()
    pending: dict[Future[RunRow], RunSource] = {}
    ready: SimpleQueue[Future[RunRow]] = SimpleQueue()
    try:
        while True:
            while len(pending) < window and (source := next(waiting, None)) is not None:
                future = _submit(executor, source, model)
                pending[future] = source
                future.add_done_callback(ready.put)
            if not pending:
                return
            try:
                future = ready.get(timeout=PART_S)
            except Empty:
                yield None
                continue
            source = pending.pop(future)
            try:
                row = future.result()
            except (BrokenExecutor, CancelledError):
                # No worker is left: those that were computed are under suspicion, one by one.
                suspects = [source, *pending.values()]
                _end(executor, pending)
                pending, ready = {}, SimpleQueue()
                for suspect in suspects:
                    yield _alone(suspect, model, make_executor)
                executor = make_executor()
                continue
            except Exception as error:  # of an engine elsewhere, e.g. a killed worker
                why = f"no worker gave it back: {type(error).__name__}: {error}"
                row = row_without_result(source, model, why)
            yield row
    finally:
        _end(executor, pending)


def _end(executor: Executor, pending: Iterable[Future[RunRow]]) -> None:
    """Leave an executor with what it was not yet given a worker for."""
    for future in pending:
        future.cancel()
    executor.shutdown(wait=False)


def _submit(executor: Executor, source: RunSource, model: FleetModel) -> Future[RunRow]:
    try:
        return executor.submit(evaluate_run, source, model)
    except BrokenExecutor as error:
        future: Future[RunRow] = Future()
        future.set_exception(error)
        return future
    except Exception as error:  # of an engine elsewhere
        raise InputError(f"the engine takes no more runs ({error})") from error


def _alone(source: RunSource, model: FleetModel, make_executor: Callable[[], Executor]) -> RunRow:
    """A run in a separate executor, which it may break."""
    executor = make_executor()
    try:
        return executor.submit(evaluate_run, source, model).result()
    except (BrokenExecutor, CancelledError):
        return row_without_result(source, model, "killed its worker, alone as well")
    finally:
        _end(executor, ())
