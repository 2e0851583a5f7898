"""Answers the page: on loopback only, each question by itself, in a thread of its own.

A page asks for a stretch when it has drawn the last one, so that a stalled one slows nobody, and
one that lost its connection only asks again. The server keeps no state of a page.
"""

import json
import secrets
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, cast
from urllib.parse import parse_qs, urlsplit

import numpy as np

from can_dbc.errors import InputError
from dart_model.spec import ModelSpec
from rig.diagnosis.outcome import REPORT_FILE
from rig.log.file_names import MODEL_FILE
from rig.pages import charts
from rig.pages.view import visible_stretch as closely
from rig.pages.view.diagnosis_job import Diagnosing
from rig.pages.view.run_status import WatchedRun
from rig.run.requests import ask
from rig.run.timing import read_histograms

HOST = "127.0.0.1"

_MOST_POINTS, _MOST_COLUMNS = 4000, 64
"""Of one answer: a wide screen, and several times what the page asks for; it bounds the memory."""

_MOST_ASKED_BYTES = 10_000
"""Of one change: hundreds of keys."""

_HTTP_PORT = 80
"""Which a browser leaves out of the host's name."""
_HERE = Path(__file__).parent
_STYLES, _SCRIPTS = (*charts.STYLES, _HERE / "page.css"), (*charts.SCRIPTS, _HERE / "page.js")

_FILES: Mapping[str, tuple[Path, str]] = {
    "/": (_HERE / "page.html", "text/html; charset=utf-8"),
    **{f"/{path.name}": (path, "text/css; charset=utf-8") for path in _STYLES},
    **{f"/{path.name}": (path, "text/javascript; charset=utf-8") for path in _SCRIPTS},
}

_POLICY: dict[str, str] = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
}

_REPORTS_POLICY = {
    # It brings its own script; in an origin of its own that reads nothing of the page.
    "Content-Security-Policy": "sandbox allow-scripts allow-popups; default-src 'none'; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
}

_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class _WrongQuestionError(Exception):
    """A question that has no answer; its text is for whoever asked."""


class ViewServer(ThreadingHTTPServer):
    """The server of a page.

    Args:
        folders: Folders of runs.
        models: Models whose laws are drawn beside those of the runs, by file or name.
        port: Port on loopback; 0 for a free one.
        token: What a page must know to change a run; None lets nobody change one.

    Raises:
        InputError: The port is taken.
    """

    daemon_threads = True

    def __init__(
        self,
        folders: Sequence[Path],
        models: Mapping[str, ModelSpec],
        port: int,
        token: str | None = None,
    ) -> None:
        self.token = token
        self.runs = tuple(WatchedRun(folder) for folder in folders)
        self.diagnoses = tuple(Diagnosing(folder) for folder in folders)
        self.models = models
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise InputError(
                f"--port {port}: {error.strerror}, expected a port that is free"
            ) from error

    @property
    def address(self) -> str:
        """Where a browser finds the page."""
        return f"http://{HOST}:{self.server_address[1]}/"

    def server_close(self) -> None:
        """End; nobody waits for a diagnosis any more."""
        super().server_close()
        for diagnosis in getattr(self, "diagnoses", ()):
            diagnosis.cancel()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that went away in the middle of an answer is no news."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    def serving(self) -> threading.Thread:
        """Serve in a thread, until `shutdown`."""
        thread = threading.Thread(target=self.serve_forever, args=(0.1,), name="view", daemon=True)
        thread.start()
        return thread


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "rig", ""
    disable_nagle_algorithm = True

    @property
    def _view(self) -> ViewServer:
        return cast("ViewServer", self.server)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the base's name
        """Nothing: twenty questions a second are no news."""

    def do_GET(self) -> None:
        """Answer a question."""
        asked = urlsplit(self.path)
        if not self._is_asked_here():
            return
        if asked.path in _FILES:
            path, kind = _FILES[asked.path]
            self._send(HTTPStatus.OK, path.read_bytes(), kind)
            return
        answer = _ANSWERS.get(asked.path)
        if answer is None:
            self._send(HTTPStatus.NOT_FOUND, b"no such page", "text/plain")
            return
        try:
            content, kind, policy = answer(self._view, _Question(asked.query))
        except _WrongQuestionError as error:
            self._send(HTTPStatus.BAD_REQUEST, str(error).encode(), "text/plain; charset=utf-8")
        except (OSError, ValueError, ArithmeticError) as error:
            # A run's files may go while they are read; the other runs are still to be seen.
            why = f"{type(error).__name__}: {error}"
            self._send(HTTPStatus.INTERNAL_SERVER_ERROR, why.encode(), "text/plain; charset=utf-8")
        else:
            self._send(HTTPStatus.OK, content, kind, policy)

    def do_POST(self) -> None:
        """Do what is asked, for a page that knows the token."""
        if not self._is_asked_here():
            return
        token, given = self._view.token, self.headers.get("X-Rig-Token", "")
        if token is None or not secrets.compare_digest(token.encode(), given.encode()):
            self._send(HTTPStatus.FORBIDDEN, b"read only", "text/plain")
            return
        asked = urlsplit(self.path)
        action = _ACTIONS.get(asked.path)
        if action is None:
            self._send(HTTPStatus.NOT_FOUND, b"no such action", "text/plain")
            return
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal()) or int(length) > _MOST_ASKED_BYTES:
            self._send(HTTPStatus.BAD_REQUEST, b"too long", "text/plain")
            return
        try:
            given: Any = json.loads(self.rfile.read(int(length)))
            content = action(self._view, _Question(asked.query), dict(given))
        except InputError as error:
            content = {"error": str(error)}  # what the run says no to is an answer too
        except (_WrongQuestionError, OSError, ValueError, TypeError, RecursionError) as error:
            self._send(HTTPStatus.BAD_REQUEST, str(error).encode(), "text/plain; charset=utf-8")
            return
        self._send(HTTPStatus.OK, *_json(content))

    def _is_asked_here(self) -> bool:
        # A page of another site must not read through a name that it points at this machine.
        port = self._view.server_address[1]
        hosts = [f"{name}:{port}" for name in (HOST, "localhost")]
        hosts += [HOST, "localhost"] if port == _HTTP_PORT else []
        site = self.headers.get("Sec-Fetch-Site", "none")
        if self.headers.get("Host") in hosts and site in ("same-origin", "none"):
            return True
        self._send(HTTPStatus.FORBIDDEN, b"another host", "text/plain")
        return False

    def _send(
        self, status: HTTPStatus, content: bytes, kind: str, policy: dict[str, str] = _POLICY
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        if status is not HTTPStatus.OK:
            # What was not read of a question must not be taken for the next one.
            self.send_header("Connection", "close")
        for name, value in (policy | _HEADERS).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)


class _Question:
    """What a page asks for, by name."""

    def __init__(self, query: str) -> None:
        self._given = parse_qs(query)

    def text(self, name: str) -> str:
        return self._given.get(name, [""])[0]

    def number(self, name: str) -> float:
        try:
            value = float(self.text(name))
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise _WrongQuestionError(f"{name}: {self.text(name)!r}: expected a number")
        return value

    def index(self, view: ViewServer) -> int:
        return _index(view, self.number("run"))

    def run(self, view: ViewServer) -> WatchedRun:
        return view.runs[self.index(view)]

    def stretch(self) -> tuple[float, float]:
        begin_s, end_s = self.number("begin"), self.number("end")
        if not begin_s < end_s:
            raise _WrongQuestionError(f"begin: {begin_s:g}: expected less than end")
        return begin_s, end_s


def _index(view: ViewServer, number: object) -> int:
    if number not in range(len(view.runs)):
        shown = f"{number:g}" if isinstance(number, float) else repr(number)
        raise _WrongQuestionError(f"run: {shown}: expected 0 to {len(view.runs) - 1}")
    return int(cast("float", number))


Answer = tuple[bytes, str, dict[str, str]]


def _json(content: Any) -> Answer:
    # No number that JSON does not have gets here: what is not finite is None or was left out.
    return json.dumps(content, allow_nan=False).encode(), "application/json", _POLICY


def _runs(view: ViewServer, _question: _Question) -> Answer:
    return _json([_described(view, run) for run in view.runs])


def _described(view: ViewServer, run: WatchedRun) -> dict[str, Any]:
    with run.lock:
        run.update()
        state, words = run.state()
        config = cast("Mapping[str, Any]", run.header.get("config", {}))
        ending = cast("Mapping[str, Any]", run.header.get("ending") or {})
        return {
            "name": run.folder.name or str(run.folder),
            "folder": str(run.folder),
            "state": state,
            "words": words,
            "model": run.model.name if run.model is not None else None,
            "struts": [strut.name for strut in run.model.struts] if run.model is not None else [],
            "rate_hz": config.get("rate_hz"),
            "epoch_ns": str(run.header.get("epoch_ns", "")),
            "columns": list(run.follower.columns),
            "span_s": run.follower.span_s,
            "steps": run.follower.steps,
            "counts": ending.get("counts"),
            "diverged": ending.get("diverged"),
            "observers": config.get("observers", {}),
            "supervision": config.get("supervision", {}),
            "models": list(view.models),
        }


def _stretch(view: ViewServer, question: _Question) -> Answer:
    """Columns of a stretch: a head in JSON, then times in doubles and columns in floats.

    With `follow` the stretch ends with the newest step.
    """
    run = question.run(view)
    begin_s, end_s = question.stretch()
    points = int(min(max(question.number("points"), 1), _MOST_POINTS))
    names = [name for name in question.text("columns").split(",") if name][:_MOST_COLUMNS]
    with run.lock:
        run.update()
        if question.text("follow"):
            begin_s, end_s = run.follower.span_s[1] - (end_s - begin_s), run.follower.span_s[1]
        found = run.follower.window(names, begin_s, end_s, points)
        head = {
            "span_s": run.follower.span_s,
            "state": run.state()[0],
            "begin_s": begin_s,
            "end_s": end_s,
            "count": len(found.t_s),
            "steps": found.steps,
        }
    text = json.dumps(head).encode()
    text += b" " * (-(len(text) + 4) % 8)
    columns = found.values.astype(np.float32).tobytes()
    content = len(text).to_bytes(4, "little") + text + found.t_s.tobytes() + columns
    return content, "application/octet-stream", _POLICY


def _closely(view: ViewServer, question: _Question) -> Answer:
    run = question.run(view)
    begin_s, end_s = question.stretch()
    strut = question.text("strut")
    with run.lock:
        rows = closely.rows_between(run.follower, begin_s, end_s)
        # With several struts the log does not say whose force the cell measured.
        is_only = run.model is not None and len(run.model.struts) == 1
        models = {"model": run.model} if run.model is not None else {}
        return _json(
            {
                "longest_s": closely.LONGEST_S,
                "planes": closely.planes(run.follower, rows, strut, with_cell=is_only),
                "laws": closely.laws({**models, **view.models}, run.follower, rows, strut),
                "spectrum": closely.spectrum(run.follower, rows, strut),
                "bus": closely.bus_load(
                    run.folder, run.header.get("epoch_ns", 0), run.frame_times_s, end_s
                ),
                "timing": read_histograms(run.folder),
            }
        )


def _diagnosis(view: ViewServer, question: _Question) -> Answer:
    return _json(view.diagnoses[question.index(view)].state())


def _report(view: ViewServer, question: _Question) -> Answer:
    folder = view.diagnoses[question.index(view)].report()
    if folder is None:
        raise _WrongQuestionError("no report of this run")
    return (folder / REPORT_FILE).read_bytes(), "text/html; charset=utf-8", _REPORTS_POLICY


_ANSWERS: Mapping[str, Callable[[ViewServer, _Question], Answer]] = {
    "/runs": _runs,
    "/stretch": _stretch,
    "/closely": _closely,
    "/diagnosis": _diagnosis,
    "/report": _report,
}

_Given = dict[str, Any]


def _set(view: ViewServer, question: _Question, given: _Given) -> Mapping[str, Any]:
    return ask(question.run(view).folder, given)


def _diagnose(view: ViewServer, question: _Question, given: _Given) -> Mapping[str, Any]:
    """Start a diagnosis; `held_out` are numbers of runs, `model` one of the view's or empty."""
    index = question.index(view)
    others = [_index(view, number) for number in given.get("held_out", [])]
    states = {i: _state(view.runs[i]) for i in range(len(view.runs))}
    for i in (index, *others):
        if states[i] in ("absent", "empty", "live", "reading", "unreadable"):
            raise InputError(
                f"{view.runs[i].folder}: is {states[i]}, expected a run that has ended"
            )
    if "live" in states.values():
        raise InputError("a run goes on: a diagnosis beside it could make its ticks late")
    model = given.get("model") or str(view.runs[index].folder / MODEL_FILE)
    if given.get("model") and model not in view.models:
        raise InputError(f"model: {model}: expected one that `rig view` was given")
    view.diagnoses[index].start(model, [view.runs[i].folder for i in others])
    return view.diagnoses[index].state()


def _state(run: WatchedRun) -> str:
    with run.lock:
        run.update()
        return run.state()[0]


def _cancel(view: ViewServer, question: _Question, _given: _Given) -> Mapping[str, Any]:
    diagnosis = view.diagnoses[question.index(view)]
    diagnosis.cancel()
    return diagnosis.state()


_ACTIONS: Mapping[str, Callable[[ViewServer, _Question, _Given], Mapping[str, Any]]] = {
    "/set": _set,
    "/diagnose": _diagnose,
    "/cancel": _cancel,
}
