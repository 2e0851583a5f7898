"""Diagnosis of a finished run, in a separate process."""

import contextlib
import json
import re
import threading
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

from rig.diagnosis.outcome import DIAGNOSIS_FILE, REPORT_FILE
from rig.files.folders import free_folder
from rig.machine.child_processes import spawn_context
from rig.pages.view.diagnosis_worker import DiagnosisFailure, DiagnosisProgress, run_diagnosis

_STARTING = DiagnosisProgress("starting", 0.0)


class DiagnosisJob:
    """The diagnosis of a run's folder; its own folder is next to it."""

    def __init__(self, folder: Path) -> None:
        self._run = folder.absolute()
        self._process: SpawnProcess | None = None
        self._reader: threading.Thread | None = None
        self._lock = threading.Lock()
        self._progress, self._reason = _STARTING, ""
        self._is_cancelled = False

    def start(self, model: str, held_out: Sequence[Path]) -> None:
        """Start the diagnosis, unless it is running; `model` is a file or a name."""
        with self._lock:
            if self._is_running():
                return
            self._progress, self._reason, self._is_cancelled = _STARTING, "", False
            out = free_folder(self._first_folder())
            others = [path.absolute() for path in held_out]
            context = spawn_context()
            receiver, sender = context.Pipe(duplex=False)
            with sender:  # the worker keeps its copy alone, so that its end closes the pipe
                self._process = context.Process(
                    target=run_diagnosis,
                    args=(self._run, model, others, out, sender),
                    daemon=True,
                )
                self._process.start()
            self._reader = threading.Thread(
                target=self._read, args=(self._process, receiver), name="diagnosis", daemon=True
            )
            self._reader.start()

    def cancel(self) -> None:
        """End the diagnosis, if it is running; its results so far are lost."""
        with self._lock:
            if self._process is not None and self._is_running():
                self._is_cancelled = True
                self._process.terminate()

    def state(self) -> Mapping[str, object]:
        """State for the page: `state`, and what belongs to that state."""
        if self._is_running():
            return {"state": "running", **self._progress._asdict()}
        if self._is_cancelled:
            return {"state": "cancelled"}
        if self._process is not None and self._process.exitcode:
            reason = f"the process ended with exit code {self._process.exitcode}"
            return {"state": "failed", "why": self._reason or reason}
        folder = self.newest_folder()
        if folder is None:
            return {"state": "none"}
        return {"state": "done", "verdict": _read_verdict(folder), "folder": str(folder)}

    def wait(self) -> int | None:
        """Wait for the end of the diagnosis; returns its exit code, or None if none was started."""
        if self._reader is not None:
            self._reader.join()
        return None if self._process is None else self._process.exitcode

    def newest_folder(self) -> Path | None:
        """The newest folder of a diagnosis of the run that holds a report."""
        name = re.compile(re.escape(self._first_folder().name) + r"(-\d+)?")
        stamps: dict[Path, float] = {}
        for folder in self._run.parent.iterdir():
            if name.fullmatch(folder.name):
                with contextlib.suppress(OSError):  # it has none yet
                    stamps[folder] = (folder / REPORT_FILE).stat().st_mtime
        return max(stamps, key=lambda folder: stamps[folder], default=None)

    def _first_folder(self) -> Path:
        return self._run.with_name(f"{self._run.name}-diagnosis")

    def _is_running(self) -> bool:
        # The reader alone waits for the process: of two threads that wait for one child, the
        # system gives the exit code to one, and reports to the other that there is no child.
        return self._reader is not None and self._reader.is_alive()

    def _read(self, process: SpawnProcess, receiver: Connection) -> None:
        with receiver, contextlib.suppress(EOFError, OSError):
            while True:
                message: object = receiver.recv()
                if isinstance(message, DiagnosisProgress):
                    self._progress = message
                elif isinstance(message, DiagnosisFailure):
                    self._reason = message.reason
        process.join()


def _read_verdict(folder: Path) -> str:
    try:
        return json.loads((folder / DIAGNOSIS_FILE).read_bytes())["verdict"].replace("_", " ")
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return "not readable"
