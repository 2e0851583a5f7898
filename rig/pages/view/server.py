"""Server of the live page: on loopback only, one thread a connection, and not many of them.

A page requests a stretch when it has drawn the last one, so that a stalled page slows no other, and
a page that lost its connection repeats its request. The server keeps no state of a page.
"""

import contextlib
import io
import json
import re
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, cast
from urllib.parse import SplitResult, parse_qs, urlsplit

import numpy as np

from can_dbc.errors import InputError
from dart_model.spec import ModelSpec
from rig.diagnosis.outcome import REPORT_FILE
from rig.log.file_names import MODEL_FILE
from rig.pages import charts
from rig.pages.mode_band import list_events
from rig.pages.view import visible_stretch
from rig.pages.view.diagnosis_job import DiagnosisJob
from rig.pages.view.live_page import live_page
from rig.pages.view.run_status import WatchedRun
from rig.run.change_requests import ask
from rig.run.timing import read_histograms

HOST = "127.0.0.1"

_MOST_POINTS, _MOST_COLUMNS = 4000, 64
"""Limits of one answer, which bound its memory: several times what the page requests."""

_MOST_REQUEST_BYTES = 10_000
"""Limit of one change: hundreds of keys."""

_MOST_CONNECTIONS = 32
"""Connections that are served at once: a browser opens six."""

_MOST_WAITING = 128
"""Connections that the system keeps until they are looked at; the next one has to try again."""

_REQUEST_S, _ANSWER_S = 30.0, 30.0
"""Longest time from an answer to the end of the next request, and for a page to take an answer."""

_LENGTH = re.compile(r"[0-9]{1,9}")

_HTTP_PORT = 80
"""Port that a browser leaves out of the host's name."""
_HERE = Path(__file__).parent
_STYLES = (*charts.STYLES, _HERE / "page.css")
_SCRIPTS = (*charts.SCRIPTS, *(_HERE / name for name in ("glance.js", "arrange.js", "page.js")))

_HTML = "text/html; charset=utf-8"
_CSV = "text/csv; charset=utf-8"
_FILES: Mapping[str, tuple[Path, str]] = {
    **{f"/{path.name}": (path, "text/css; charset=utf-8") for path in _STYLES},
    **{f"/{path.name}": (path, "text/javascript; charset=utf-8") for path in _SCRIPTS},
}

_POLICY: dict[str, str] = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
}

_REPORTS_POLICY = {
    # A report holds its script; sandboxed without an origin, it reads nothing of the page.
    "Content-Security-Policy": "sandbox allow-scripts allow-popups; default-src 'none'; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
}

_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class _RequestError(Exception):
    """A request that cannot be answered; its text goes to the page."""


class ViewServer(ThreadingHTTPServer):
    """The server of a page.

    Args:
        folders: Folders of runs.
        models: Further models whose laws are drawn, by file or name.
        port: Port on loopback; 0 for a free one.
        token: Secret that allows a page to change a run; with None no page can.

    Raises:
        InputError: The port is taken.
    """

    daemon_threads = True
    request_queue_size = _MOST_WAITING

    def __init__(
        self,
        folders: Sequence[Path],
        models: Mapping[str, ModelSpec],
        port: int,
        token: str | None = None,
    ) -> None:
        self.token = token
        self.runs = tuple(WatchedRun(folder) for folder in folders)
        self.diagnoses = tuple(DiagnosisJob(folder) for folder in folders)
        self.models = models
        self._connections = threading.BoundedSemaphore(_MOST_CONNECTIONS)
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise InputError(
                f"--port {port}: {error.strerror}, expected a port that is free"
            ) from error

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server_address[1]}/"

    def process_request(
        self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any
    ) -> None:
        """Serve a connection in a thread of its own, if one more may be served."""
        if not self._connections.acquire(blocking=False):
            _answer_busy(cast("socket.socket", request))
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._connections.release()
            raise

    def process_request_thread(
        self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any
    ) -> None:
        """Serve a connection until it ends."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._connections.release()

    def server_close(self) -> None:
        """End the server and its diagnoses."""
        super().server_close()
        for diagnosis in getattr(self, "diagnoses", ()):
            diagnosis.cancel()
            diagnosis.wait()

    def handle_error(
        self, request: socket.socket | tuple[bytes, socket.socket], client_address: object
    ) -> None:
        """Report an error, unless a browser closed its connection during an answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    def start_thread(self) -> threading.Thread:
        """Serve in a thread, until `shutdown`."""
        thread = threading.Thread(target=self.serve_forever, args=(0.1,), name="view", daemon=True)
        thread.start()
        return thread


def _answer_busy(connection: socket.socket) -> None:
    """Answer a connection that is one too many, whatever it requests."""
    connection.setblocking(False)
    with contextlib.suppress(OSError):
        connection.sendall(
            b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1\r\nConnection: close\r\n"
            b"Content-Length: 0\r\n\r\n"
        )


class _Requests(io.RawIOBase):
    """The bytes of a connection; a request has a limited time, however its bytes are spread."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._end_s = 0.0

    def begin(self) -> None:
        """Begin to wait for the next request."""
        self._end_s = time.monotonic() + _REQUEST_S

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        left_s = self._end_s - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError
        self._connection.settimeout(left_s)
        return self._connection.recv_into(buffer)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "rig", ""
    disable_nagle_algorithm = True

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self._requests = _Requests(self.connection)
        self.rfile = io.BufferedReader(self._requests)

    def handle_one_request(self) -> None:
        self._requests.begin()
        super().handle_one_request()

    @property
    def _view(self) -> ViewServer:
        return cast("ViewServer", self.server)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the base's name
        """Print nothing: a page makes twenty requests a second."""

    def do_GET(self) -> None:
        """Answer a request."""
        if not self._check_host():
            return
        if self._has_body():
            self._send(HTTPStatus.BAD_REQUEST, b"expected a request without a body", "text/plain")
            return
        url = self._url()
        if url.path == "/":
            self._send(HTTPStatus.OK, live_page().encode(), _HTML)
            return
        if url.path in _FILES:
            path, kind = _FILES[url.path]
            self._send(HTTPStatus.OK, path.read_bytes(), kind)
            return
        answer = _ANSWERS.get(url.path)
        if answer is None:
            self._send(HTTPStatus.NOT_FOUND, b"no such page", "text/plain")
            return
        try:
            content, kind, policy = answer(self._view, _Query(url.query))
        except _RequestError as error:
            self._send(HTTPStatus.BAD_REQUEST, str(error).encode(), "text/plain; charset=utf-8")
        except (OSError, ValueError, ArithmeticError) as error:
            # The files of a run may be deleted while they are read; the other runs remain visible.
            why = f"{type(error).__name__}: {error}"
            self._send(HTTPStatus.INTERNAL_SERVER_ERROR, why.encode(), "text/plain; charset=utf-8")
        else:
            self._send(HTTPStatus.OK, content, kind, policy)

    def do_POST(self) -> None:
        """Carry out an action, for a page that has the token."""
        if not self._check_host():
            return
        token, sent = self._view.token, self.headers.get("X-Rig-Token", "")
        if token is None or not secrets.compare_digest(token.encode(), sent.encode()):
            self._send(HTTPStatus.FORBIDDEN, b"read only", "text/plain")
            return
        url = self._url()
        action = _ACTIONS.get(url.path)
        if action is None:
            self._send(HTTPStatus.NOT_FOUND, b"no such action", "text/plain")
            return
        length = self.headers.get("Content-Length", "")
        if not _LENGTH.fullmatch(length) or int(length) > _MOST_REQUEST_BYTES:
            why = f"Content-Length: expected a number up to {_MOST_REQUEST_BYTES}"
            self._send(HTTPStatus.BAD_REQUEST, why.encode(), "text/plain")
            return
        try:
            body = json.loads(self.rfile.read(int(length)))
            content = action(self._view, _Query(url.query), dict(body))
        except InputError as error:
            content = {"error": str(error)}  # a refused change is an answer too
        except (_RequestError, OSError, ValueError, TypeError, RecursionError) as error:
            self._send(HTTPStatus.BAD_REQUEST, str(error).encode(), "text/plain; charset=utf-8")
            return
        self._send(HTTPStatus.OK, *_json(content))

    def _url(self) -> SplitResult:
        """What is requested; nothing that there is, where it is no address."""
        try:
            return urlsplit(self.path)
        except ValueError:
            return urlsplit("")

    def _check_host(self) -> bool:
        """Whether the request is for this server and comes from its page; if not, refuse it."""
        # A page of another site could point a host name at this machine.
        port = self._view.server_address[1]
        hosts = [f"{name}:{port}" for name in (HOST, "localhost")]
        hosts += [HOST, "localhost"] if port == _HTTP_PORT else []
        site = self.headers.get("Sec-Fetch-Site", "none")
        if self.headers.get("Host") in hosts and site in ("same-origin", "none"):
            return True
        self._send(HTTPStatus.FORBIDDEN, b"another host", "text/plain")
        return False

    def _has_body(self) -> bool:
        """Whether a body follows, of whatever length: it would be taken for the next request."""
        lengths = self.headers.get_all("Content-Length", [])
        return "Transfer-Encoding" in self.headers or any(length != "0" for length in lengths)

    def _send(
        self, status: HTTPStatus, content: bytes, kind: str, policy: dict[str, str] = _POLICY
    ) -> None:
        self.connection.settimeout(_ANSWER_S)
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        if status is not HTTPStatus.OK:
            # The unread rest of a request must not be taken for the next one.
            self.send_header("Connection", "close")
        for name, value in (policy | _HEADERS).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)


_LARGEST_NUMBER = 1e9
"""Of a request: an index, or a time in s, which ns are made of."""


class _Query:
    """Arguments of a request, by name."""

    def __init__(self, query: str) -> None:
        self._values = parse_qs(query)

    def text(self, name: str) -> str:
        return self._values.get(name, [""])[0]

    def number(self, name: str) -> float:
        try:
            value = float(self.text(name))
        except ValueError:
            value = float("nan")
        if not abs(value) <= _LARGEST_NUMBER:
            raise _RequestError(
                f"{name}: {self.text(name)[:40]!r}: expected a number up to {_LARGEST_NUMBER:g}"
            )
        return value

    def index(self, view: ViewServer) -> int:
        return _index(view, self.number("run"))

    def run(self, view: ViewServer) -> WatchedRun:
        return view.runs[self.index(view)]

    def stretch(self) -> tuple[float, float]:
        begin_s, end_s = self.number("begin"), self.number("end")
        if not begin_s < end_s:
            raise _RequestError(f"begin: {begin_s:g}: expected less than end")
        return begin_s, end_s


def _index(view: ViewServer, number: object) -> int:
    if number not in range(len(view.runs)):
        text = f"{number:g}" if isinstance(number, float) else repr(number)
        raise _RequestError(f"run: {text}: expected 0 to {len(view.runs) - 1}")
    return int(cast("float", number))


Answer = tuple[bytes, str, dict[str, str]]


def _json(content: object) -> Answer:
    # Numbers that are not finite, which JSON does not have, are None or left out before.
    return json.dumps(content, allow_nan=False).encode(), "application/json", _POLICY


def _runs(view: ViewServer, _query: _Query) -> Answer:
    return _json([_describe_run(view, run) for run in view.runs])


def _describe_run(view: ViewServer, run: WatchedRun) -> dict[str, object]:
    with run.lock:
        run.update()
        state, words = run.state()
        config = run.config
        ending = run.ending
        return {
            "name": run.folder.name or str(run.folder),
            "folder": str(run.folder),
            "state": state,
            "words": words,
            "banner": run.banner()._asdict(),
            "model": run.model.name if run.model is not None else None,
            "struts": [strut.name for strut in run.model.struts] if run.model is not None else [],
            "rate_hz": config.get("rate_hz"),
            "epoch_ns": "" if run.epoch_ns is None else str(run.epoch_ns),
            "columns": [name for name in run.follower.columns if run.has(name)],
            "span_s": run.follower.span_s,
            "steps": run.follower.steps,
            "counts": ending.get("counts"),
            "diverged": ending.get("diverged"),
            "observers": config.get("observers", {}),
            "supervision": config.get("supervision", {}),
            "models": list(view.models),
        }


def _stretch(view: ViewServer, query: _Query) -> Answer:
    """Columns of a stretch: a head in JSON, then times as doubles and columns as floats.

    With `follow` the stretch ends with the newest step.
    """
    run = query.run(view)
    begin_s, end_s = query.stretch()
    points = int(min(max(query.number("points"), 1), _MOST_POINTS))
    names = [name for name in query.text("columns").split(",") if name][:_MOST_COLUMNS]
    with run.lock:
        run.update()
        if query.text("follow"):
            begin_s, end_s = run.follower.span_s[1] - (end_s - begin_s), run.follower.span_s[1]
        window = run.follower.window(names, begin_s, end_s, points)
        head = {
            "span_s": run.follower.span_s,
            "state": run.state()[0],
            "banner": run.banner()._asdict(),
            "latest": visible_stretch.latest(run.follower, query.text("strut"), end_s),
            "last": visible_stretch.last_values(run.follower, names, end_s),
            "begin_s": begin_s,
            "end_s": end_s,
            "count": len(window.t_s),
            "steps": window.steps,
        }
    text = json.dumps(head).encode()
    text += b" " * (-(len(text) + 4) % 8)
    columns = window.values.astype(np.float32).tobytes()
    content = len(text).to_bytes(4, "little") + text + window.t_s.tobytes() + columns
    return content, "application/octet-stream", _POLICY


def _closely(view: ViewServer, query: _Query) -> Answer:
    run = query.run(view)
    begin_s, end_s = query.stretch()
    strut = query.text("strut")
    with run.lock:
        rows = visible_stretch.rows_between(run.follower, begin_s, end_s)
        # With several struts the log does not say whose force the cell measured.
        is_only = run.model is not None and len(run.model.struts) == 1
        models = {"model": run.model} if run.model is not None else {}
        events, _ = list_events(run.events, with_strut=not is_only)
        return _json(
            {
                "longest_s": visible_stretch.LONGEST_S,
                "planes": visible_stretch.planes(run.follower, rows, strut, with_cell=is_only),
                "laws": visible_stretch.laws({**models, **view.models}, run.follower, rows, strut),
                "spectrum": visible_stretch.spectrum(run.follower, rows, strut),
                "bus": visible_stretch.bus_load(
                    run.folder, run.epoch_ns or 0, run.frame_times_s, end_s
                ),
                "timing": read_histograms(run.folder),
                "events": [event._asdict() for event in events],
            }
        )


def _csv(view: ViewServer, query: _Query) -> Answer:
    """Every cycle of a stretch as CSV, times in s and columns in SI units."""
    run = query.run(view)
    begin_s, end_s = query.stretch()
    names = [name for name in query.text("columns").split(",") if name][:_MOST_COLUMNS]
    with run.lock:
        run.update()
        return visible_stretch.csv_of(run.follower, begin_s, end_s, names).encode(), _CSV, _POLICY


def _diagnosis(view: ViewServer, query: _Query) -> Answer:
    return _json(view.diagnoses[query.index(view)].state())


def _report(view: ViewServer, query: _Query) -> Answer:
    folder = view.diagnoses[query.index(view)].newest_folder()
    if folder is None:
        raise _RequestError("no report of this run")
    return (folder / REPORT_FILE).read_bytes(), _HTML, _REPORTS_POLICY


_ANSWERS: Mapping[str, Callable[[ViewServer, _Query], Answer]] = {
    "/runs": _runs,
    "/stretch": _stretch,
    "/closely": _closely,
    "/csv": _csv,
    "/diagnosis": _diagnosis,
    "/report": _report,
}

_Body = dict[str, Any]


def _set(view: ViewServer, query: _Query, body: _Body) -> Mapping[str, object]:
    of_page = {"by": "page"} if {"request", "mark"} & body.keys() else {}
    return ask(query.run(view).folder, {**body, **of_page})


def _diagnose(view: ViewServer, query: _Query, body: _Body) -> Mapping[str, object]:
    """Start a diagnosis; `held_out` are indices of runs, `model` one of the view's or empty."""
    index = query.index(view)
    others = [_index(view, number) for number in body.get("held_out", [])]
    states = {i: _state(view.runs[i]) for i in range(len(view.runs))}
    for i in (index, *others):
        if states[i] in ("absent", "empty", "live", "reading", "unreadable"):
            raise InputError(
                f"{view.runs[i].folder}: is {states[i]}, expected a run that has ended"
            )
    if "live" in states.values():
        raise InputError("a run is live: a diagnosis at the same time could make its ticks late")
    model = body.get("model") or str(view.runs[index].folder / MODEL_FILE)
    if body.get("model") and model not in view.models:
        raise InputError(f"model: {model}: expected one that `rig view` was given")
    view.diagnoses[index].start(model, [view.runs[i].folder for i in others])
    return view.diagnoses[index].state()


def _state(run: WatchedRun) -> str:
    with run.lock:
        run.update()
        return run.state()[0]


def _cancel(view: ViewServer, query: _Query, _body: _Body) -> Mapping[str, object]:
    diagnosis = view.diagnoses[query.index(view)]
    diagnosis.cancel()
    return diagnosis.state()


_ACTIONS: Mapping[str, Callable[[ViewServer, _Query, _Body], Mapping[str, object]]] = {
    "/set": _set,
    "/diagnose": _diagnose,
    "/cancel": _cancel,
}
