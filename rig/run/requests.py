"""Requests to a run that goes on, through its folder: gains, limits, acknowledgement.

Whoever may write into the folder may ask; nothing listens on a network. A request is a file, which
a thread of the run reads, checks and answers with another; the loop only takes what is ready.
"""

import contextlib
import json
import os
import threading
import time
import uuid
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, cast

from can_dbc.errors import InputError
from rig.bridge.bridge import Bridge
from rig.log.file_names import RUN_FILE
from rig.log.reader import read_header
from rig.machine.realtime import follow
from rig.plan.check import errors
from rig.plan.setup import Setup, setup_of_folder
from rig.run.changes import (
    Assignments,
    change_line,
    changed_bridge,
    logged_changes,
    reassigned,
)

_FOLDER = "requests"
_LOOK_S = 0.1
"""Time between two looks for requests, and for whether one still waits."""

_ANSWER_S = 5.0
"""How long whoever asks waits: many looks, and a tick of the slowest rate that is of use."""

_MOST_BYTES = 100_000

Answer = Mapping[str, Any]
"""`t_ns` of the first tick with the change; or `error`."""


class Requests:
    """The requests to a run.

    Args:
        folder: Folder of the run.
        ready: Its configuration.
        bridge: Its bridge.
        acknowledge: Acknowledges the safe state.
        log: Takes the line of a change.
        priority: Real-time priority of the loop, which the thread follows; 0 for none.
    """

    def __init__(
        self,
        folder: Path,
        ready: Setup,
        bridge: Bridge,
        acknowledge: Callable[[], None],
        log: Callable[[str], None],
        priority: int,
    ) -> None:
        self._folder = folder / _FOLDER
        self._ready, self._bridge = ready, bridge
        self._acknowledge, self._log = acknowledge, log
        self._priority = priority
        self._waiting: tuple[Bridge, Assignments] | None = None
        self._taken_ns = 0
        self._taken = threading.Event()
        self._ended = threading.Event()

    def changes(self, t_ns: int) -> Bridge | None:
        """The bridge from this tick on, if a change is ready; called by the loop."""
        waiting = self._waiting
        if waiting is None:
            return None
        bridge, assignments = waiting
        self._log(change_line(t_ns, assignments))
        self._waiting, self._taken_ns = None, t_ns
        self._taken.set()
        return bridge

    @contextlib.contextmanager
    def served(self) -> Generator[None]:
        """Requests are read while this lasts."""
        self._folder.mkdir(exist_ok=True)
        thread = threading.Thread(target=self._serve, name="requests")
        thread.start()
        try:
            yield
        finally:
            self._ended.set()
            thread.join()
            with contextlib.suppress(OSError):
                self._folder.rmdir()

    def _serve(self) -> None:
        follow(self._priority)
        while not self._ended.wait(_LOOK_S):
            with contextlib.suppress(OSError):  # a disk that is full, a folder that is gone
                self._serve_once()

    def _serve_once(self) -> None:
        # A list of names takes the interpreter from the loop for some microseconds only.
        names = os.listdir(self._folder)  # noqa: PTH208
        for path in [self._folder / name for name in sorted(names) if name.endswith(".request")]:
            answer = self._answered(path)
            path.unlink()
            _write(path.with_suffix(".answer"), answer)

    def _answered(self, path: Path) -> Answer:
        try:
            with path.open("rb") as file:
                content: Any = json.loads(file.read(_MOST_BYTES))
            if content == {"acknowledge": True}:
                self._acknowledge()
                return {"acknowledged": True}
            return self._changed(path, dict(content["set"]))
        except InputError as error:
            return {"error": str(error)}
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return {"error": f"{path.name}: is no request"}

    def _changed(self, path: Path, assignments: Assignments) -> Answer:
        ready = reassigned(self._ready, assignments, "set")
        bridge = changed_bridge(self._bridge, ready)
        self._taken.clear()
        self._waiting = bridge, assignments
        while not self._taken.wait(_LOOK_S):
            # Whoever asked may have gone: what nobody waits for any more is not done.
            if self._ended.is_set() or not path.exists():
                self._waiting = None
                if not self._taken.wait(_LOOK_S):
                    return {"error": "the run has ended, or nobody waits for the change any more"}
        self._ready, self._bridge = ready, bridge
        return {"t_ns": self._taken_ns}


def ask(folder: Path, content: Mapping[str, object], *, force: bool = False) -> Answer:
    """Ask a run that goes on, and wait for its answer.

    Args:
        folder: Folder of the run.
        content: ``{"set": assignments}`` or ``{"acknowledge": True}``.
        force: Ask although the check of the changed configuration finds an error.

    Raises:
        InputError: It is no run, it has ended, the check finds an error, or it refuses.
    """
    if "ending" in read_header(folder):
        raise InputError(f"{folder}: the run has ended, expected one that goes on")
    if "set" in content and not force:
        _refuse_errors(folder, cast("Assignments", content["set"]))
    place = folder / _FOLDER
    if not place.is_dir():
        raise InputError(f"{folder}: takes no requests, expected a run of `rig run`")
    path = place / f"{time.time_ns()}-{uuid.uuid4().hex}.request"
    answer = path.with_suffix(".answer")
    try:
        _write(path, content)
        for _ in range(round(_ANSWER_S / 0.02)):
            if answer.exists():
                found = cast("Answer", json.loads(answer.read_text("utf-8")))
                answer.unlink()
                if "error" in found:
                    raise InputError(str(found["error"]))
                return found
            time.sleep(0.02)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    with contextlib.suppress(OSError):
        path.unlink()
    raise InputError(f"{folder / RUN_FILE}: no answer in {_ANSWER_S:g} s: is the run still going?")


def _refuse_errors(folder: Path, assignments: Assignments) -> None:
    """Check the changed configuration as `rig run` does, here and not beside the loop."""
    try:
        ready = setup_of_folder(folder)
        for _, before in logged_changes(folder):
            ready = reassigned(ready, before, str(folder))
        wrong = errors(reassigned(ready, assignments, "set"))
    except (TypeError, AttributeError) as error:
        raise InputError("set: expected keys and values") from error
    if wrong:
        raise InputError(f"set: {wrong[0].what}: {wrong[0].text} (--force sets it all the same)")


def _write(path: Path, content: Mapping[str, object]) -> None:
    beside = path.with_suffix(".tmp")
    beside.write_text(json.dumps(content), "utf-8")
    beside.replace(path)
