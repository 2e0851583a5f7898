"""Requests to a run in progress, through its folder: gains, limits, acknowledgement, markers.

Whoever may write into the folder may ask; nothing listens on a network. A request is a file, which
a thread of the run reads, checks and answers with another; the loop only takes what is ready.
"""

import contextlib
import json
import os
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import TypedDict, cast

from can_dbc.atomic_file import write_whole
from can_dbc.errors import InputError
from rig.bridge.bridge import Bridge
from rig.bridge.values import Request
from rig.log.file_names import RUN_FILE
from rig.log.reader import read_header
from rig.machine.realtime import follow
from rig.plan.load import plan_of_run
from rig.plan.plan import Plan
from rig.plan.preflight_checks import errors
from rig.run.changed_settings import (
    Assignments,
    assign,
    bridge_with_settings,
    change_line,
    read_changes,
)

_FOLDER = "requests"
_LOOK_S = 0.1
"""Time between two looks for requests, and for whether one still waits."""

_NO_REQUEST = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    AttributeError,
    ArithmeticError,
    RecursionError,
)
"""What a file that is no request may raise; none of them ends the thread that answers."""

_ANSWER_S = 5.0
"""Longest wait for an answer: many looks, and a tick of the slowest rate that is of use."""

_MOST_BYTES = 100_000
_LONGEST_NAME, _LONGEST_MARK = 100, 200
"""Characters of a name, and of a marker's text, that stand in the run's events."""


class Answer(TypedDict, total=False):
    """`t_ns` of the first tick with the change, or what was `requested` or `marked`; or `error`."""

    t_ns: int
    requested: str
    marked: str
    error: str


class Requests:
    """The requests to a run; changes and markers are logged by a function for each.

    The thread follows the loop's priority.
    """

    def __init__(
        self,
        folder: Path,
        plan: Plan,
        bridge: Bridge,
        ask_bridge: Callable[[Request, str], None],
        log_change: Callable[[str], None],
        log_event: Callable[[str], None],
        priority: int,
    ) -> None:
        self._folder = folder / _FOLDER
        self._plan, self._bridge = plan, bridge
        self._ask_bridge = ask_bridge
        self._log_change, self._log_event = log_change, log_event
        self._priority = priority
        self._waiting: tuple[Bridge, Assignments] | None = None
        self._marks: deque[tuple[str, str]] = deque()
        self._taken_ns = 0
        self._taken = threading.Event()
        self._ended = threading.Event()

    def changes(self, t_ns: int) -> Bridge | None:
        """The bridge from this tick on, if a change is ready; called by the loop."""
        while self._marks:
            text, by = self._marks.popleft()
            self._log_event(json.dumps({"t_s": t_ns * 1e-9, "mark": text, "by": by}) + "\n")
        waiting = self._waiting
        if waiting is None:
            return None
        bridge, assignments = waiting
        self._log_change(change_line(t_ns, assignments))
        self._waiting, self._taken_ns = None, t_ns
        self._taken.set()
        return bridge

    @contextlib.contextmanager
    def serve(self) -> Generator[None]:
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
            answer = self._answer(path)
            path.unlink()
            write_whole(path.with_suffix(".answer"), json.dumps(answer))

    def _answer(self, path: Path) -> Answer:
        try:
            with path.open("rb") as file:
                content = json.loads(file.read(_MOST_BYTES))
            if "request" in content:
                by = str(content["by"])[:_LONGEST_NAME]
                return self._pass_on(Request(content["request"]), by)
            if "mark" in content:
                return self._mark(str(content["mark"]), str(content["by"]))
            return self._change(path, dict(content["set"]))
        except InputError as error:
            return {"error": str(error)}
        except _NO_REQUEST:
            return {"error": f"{path.name}: is not a valid request"}

    def _pass_on(self, request: Request, by: str) -> Answer:
        if request is not Request.ACKNOWLEDGE and self._plan.config.supervision.arming != "manual":
            raise InputError(
                f"{request.value}: the run is armed by itself, expected `supervision.arming: "
                "manual` in its configuration"
            )
        self._ask_bridge(request, by)
        return {"requested": request.value}

    def _mark(self, text: str, by: str) -> Answer:
        text = text.strip()[:_LONGEST_MARK]
        if not text:
            raise InputError("mark: is empty, expected a text")
        self._marks.append((text, by[:_LONGEST_NAME]))
        return {"marked": text}

    def _change(self, path: Path, assignments: Assignments) -> Answer:
        plan = assign(self._plan, assignments, "set")
        bridge = bridge_with_settings(self._bridge, plan)
        self._taken.clear()
        self._waiting = bridge, assignments
        while not self._taken.wait(_LOOK_S):
            # A request that was withdrawn is not carried out.
            if self._ended.is_set() or not path.exists():
                self._waiting = None
                if not self._taken.wait(_LOOK_S):
                    return {"error": "the run has ended, or the request was withdrawn"}
        self._plan, self._bridge = plan, bridge
        return {"t_ns": self._taken_ns}


def ask(folder: Path, content: Mapping[str, object], *, force: bool = False) -> Answer:
    """Send a request to a running run, and wait for its answer.

    It contains ``{"set": assignments}``, ``{"request": "acknowledge"}`` (or ``arm``, ``disarm``) or
    ``{"mark": text}``, the last two with the name of who makes it ``by``; `force` sends it although
    the check of the changed configuration finds an error.

    Raises:
        InputError: It is no run, it has ended, the check finds an error, or it refuses.
    """
    if "ending" in read_header(folder):
        raise InputError(f"{folder}: the run has ended, expected one that is running")
    if "set" in content and not force:
        _refuse_errors(folder, cast("Assignments", content["set"]))
    requests = folder / _FOLDER
    if not requests.is_dir():
        raise InputError(
            f"{folder}: does not accept requests, expected a run started with `rig run`"
        )
    path = requests / f"{time.time_ns()}-{uuid.uuid4().hex}.request"
    answer = path.with_suffix(".answer")
    try:
        write_whole(path, json.dumps(content))
        for _ in range(round(_ANSWER_S / 0.02)):
            if answer.exists():
                content = cast("Answer", json.loads(answer.read_text("utf-8")))
                answer.unlink()
                if "error" in content:
                    raise InputError(str(content["error"]))
                return content
            time.sleep(0.02)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    with contextlib.suppress(OSError):
        path.unlink()
    raise InputError(
        f"{folder / RUN_FILE}: no answer in {_ANSWER_S:g} s: is the run still running?"
    )


def _refuse_errors(folder: Path, assignments: Assignments) -> None:
    """Check the changed configuration as `rig run` does, but not in the loop's process."""
    try:
        plan = plan_of_run(folder)
        for _, before in read_changes(folder):
            plan = assign(plan, before, str(folder))
        wrong = errors(assign(plan, assignments, "set"))
    except (TypeError, AttributeError, ArithmeticError) as error:
        raise InputError("set: expected keys and values") from error
    if wrong:
        raise InputError(f"set: {wrong[0].what}: {wrong[0].text} (--force sets it all the same)")
