"""`rig diagnose` of a finished run, in a process of its own."""

import contextlib
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, cast

from rig.diagnosis.outcome import DIAGNOSIS_FILE, REPORT_FILE
from rig.files.folders import free_folder

_COMMAND = (sys.executable, "-m", "rig", "diagnose")
_PROGRESS = re.compile(r" *(\d+) % (.+)")
_NICENESS = 19
"""Lowest: it takes what nobody else wants."""

_MOST_CHARACTERS = 400
"""Of what a process says last, if it fails."""


class Diagnosing:
    """The diagnosis of one run; its folder stands beside the run's.

    Args:
        folder: Folder of the run.
    """

    def __init__(self, folder: Path) -> None:
        self._run = folder.absolute()
        self._process: subprocess.Popen[str] | None = None
        self._out = self._run
        self._reader: threading.Thread | None = None
        self._lock = threading.Lock()
        self._what, self._share, self._said = "", 0.0, ""
        self._is_cancelled = False

    def start(self, model: str, held_out: Sequence[Path]) -> None:
        """Start it, unless it goes on already.

        Args:
            model: File or name of the nominal model.
            held_out: Folders of the held-out runs.
        """
        with self._lock:
            if self._process is not None and self._process.poll() is None:
                return
            self._out = free_folder(self._beside())
            self._what, self._share, self._said = "starting", 0.0, ""
            self._is_cancelled = False
            asked = ["--model", model, "--out", self._out]
            for other in held_out:
                asked += ["--held-out", other.absolute()]
            self._process = subprocess.Popen(  # noqa: S603 - names go as arguments, no shell
                [*_COMMAND, *map(str, asked), "--", str(self._run)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
            )
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICENESS)
        self._reader = threading.Thread(
            target=self._read, args=(self._process,), name="diagnosis", daemon=True
        )
        self._reader.start()

    def cancel(self) -> None:
        """End it, if it goes on; what it found so far is lost."""
        with self._lock:
            if self._process is not None and self._process.poll() is None:
                self._is_cancelled = True
                self._process.terminate()

    def state(self) -> Mapping[str, Any]:
        """What a page shows of it: `state`, and what belongs to that state."""
        process = self._process
        code = None if process is None else process.poll()
        # What it says last is read after it has ended.
        is_read = self._reader is None or not self._reader.is_alive()
        if process is not None and (code is None or not is_read):
            return {"state": "running", "what": self._what, "share": self._share}
        if process is not None and self._is_cancelled:
            return {"state": "cancelled"}
        if code:
            return {"state": "failed", "why": self._said or f"ended with {code}"}
        found = self.report()
        if found is None:
            return {"state": "none"}
        return {"state": "done", "verdict": _verdict(found), "folder": str(found)}

    def report(self) -> Path | None:
        """The newest folder beside the run with a report in it."""
        name = re.compile(re.escape(self._beside().name) + r"(-\d+)?")
        stamps: dict[Path, float] = {}
        for folder in self._run.parent.iterdir():
            if name.fullmatch(folder.name):
                with contextlib.suppress(OSError):  # it has none yet
                    stamps[folder] = (folder / REPORT_FILE).stat().st_mtime
        return max(stamps, key=lambda folder: stamps[folder], default=None)

    def _beside(self) -> Path:
        return self._run.with_name(f"{self._run.name}-diagnosis")

    def _read(self, process: subprocess.Popen[str]) -> None:
        with cast("IO[str]", process.stderr) as lines:
            for line in lines:
                found = _PROGRESS.fullmatch(line.rstrip("\n"))
                if found:
                    self._what, self._share = found[2], int(found[1]) / 100.0
                elif line.strip():
                    self._said = line.strip()[:_MOST_CHARACTERS]
        process.wait()


def _verdict(folder: Path) -> str:
    try:
        content = cast("dict[str, Any]", json.loads((folder / DIAGNOSIS_FILE).read_bytes()))
        return str(content["verdict"]).replace("_", " ")
    except (OSError, ValueError, KeyError, TypeError):
        return "not read"
