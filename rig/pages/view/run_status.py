"""State of a run's folder: content, progress and end of the run."""

import contextlib
import threading
import time
from collections.abc import Mapping
from pathlib import Path

from can_dbc.bus_load import frame_time_s
from can_dbc.database import load_database
from can_dbc.errors import InputError
from dart_model.spec import ModelSpec, load_model
from rig.bridge.values import Mode
from rig.log.file_names import DBC_FILE, EVENTS_FILE, MODEL_FILE, RUN_FILE
from rig.log.follower import FORCE_ERROR, RunFollower
from rig.log.reader import ConfigEntry, Ending, RunHeader, read_header
from rig.pages.mode_band import parse_events
from rig.pages.mode_words import LoggedEvent
from rig.pages.plotted_quantities import LOAD_CELL, MODE_COLUMN
from rig.pages.view.banner import Banner, make_banner

_SILENT_S = 2.0
"""Time without a write after which a run without an ending counts as killed."""

_MUCH_BYTES = 10_000_000
"""Unread bytes above which the page shows the state `reading`."""

_STEPS_AT_ONCE = 400_000
"""Steps that are read for one answer: a tenth of a second's work, so that the page shows the
progress."""


class WatchedRun:
    """A run's folder: absent, empty, being written, whole, cut off, or no run at all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.follower = RunFollower(folder)
        self.lock = threading.Lock()
        """Guards the follower."""
        self.header: RunHeader | None = None
        """Content of `run.yaml`; None before it exists."""
        self.model: ModelSpec | None = None
        """The model that ran; None before its copy exists."""
        self.frame_times_s: Mapping[tuple[int, bool], float] = {}
        """Time that a frame occupies the bus, by identifier and whether that is extended."""
        self.events: list[LoggedEvent] = []
        """Events so far."""
        self._events_read = 0
        self._stamp = -1.0
        self._error: str | None = None

    @property
    def epoch_ns(self) -> int | None:
        """Unix time of the run's start; None before its header exists."""
        return None if self.header is None else self.header["epoch_ns"]

    @property
    def config(self) -> ConfigEntry:
        """Configuration of the run; empty before its header exists."""
        return {} if self.header is None else self.header.get("config", {})

    @property
    def ending(self) -> Ending:
        """How the run ended; empty before it did."""
        return {} if self.header is None else self.header.get("ending") or {}

    def update(self) -> None:
        """Read what has been written since the last call."""
        path = self.folder / RUN_FILE
        try:
            stamp = path.stat().st_mtime
        except OSError:
            return
        if stamp != self._stamp:
            self._stamp, self._error = stamp, None
            try:
                header = read_header(self.folder)
                if self.follower.is_another or header["epoch_ns"] != self.epoch_ns:
                    # The folder holds another run.
                    self.follower = RunFollower(self.folder)
                    self.model, self.frame_times_s = None, {}
                    self.events, self._events_read = [], 0
                self.header = header
                self._read_copies()
            except InputError as error:
                self._error = str(error)
        if self._error is None:
            self.follower.update(_STEPS_AT_ONCE)
            self._read_events()

    def state(self) -> tuple[str, str]:
        """A word for the state of the run, and a sentence about it."""
        if self._error is not None:
            return "unreadable", self._error
        if self.header is None:
            return self._without_header()
        if self.follower.unread_bytes > _MUCH_BYTES:
            return "reading", f"Reading: {self.follower.share_read:.0%}"
        if "ending" in self.header or "capture" in self.header:
            return self._end_state(self.header)
        if self._age_s() < _SILENT_S:
            return "live", "Being written."
        return "killed", (
            "No longer written, and without an ending: it was killed. "
            f"`rig replay {self.folder}` computes the missing steps from its frames."
        )

    def has(self, column: str) -> bool:
        """Whether the run has a column that is shown."""
        return column != FORCE_ERROR or LOAD_CELL.column in self.follower.columns

    def banner(self) -> Banner:
        """What the banner of the run shows."""
        newest = self.follower.newest
        now = None
        if newest is not None:
            mode = newest[self.follower.columns.index(MODE_COLUMN)]
            now = Mode(int(mode)), float(newest[0]) * 1e-9
        return make_banner(self.state(), now, self.config, self.events)

    def _without_header(self) -> tuple[str, str]:
        if not self.folder.exists():
            return "absent", f"{self.folder}: no such folder yet; it is shown once it exists."
        if not self.folder.is_dir():
            return "unreadable", f"{self.folder}: is no folder, expected a run"
        return "absent", f"{self.folder}: holds no run yet; it is shown once it does."

    def _end_state(self, header: RunHeader) -> tuple[str, str]:
        capture = header.get("capture")
        if capture is not None:
            return "done", f"A window around a fault: {capture.get('why')}."
        status = str(header.get("ending", {}).get("status"))
        if not self.follower.steps:
            return "empty", f"Ended ({status}) without a single tick."
        words = {
            "done": "Ended in order.",
            "safe": "Ended in its safe state.",
            "waiting": "Ended without a valid height.",
        }
        return status, words.get(status, f"Ended: {status}.")

    def _age_s(self) -> float:
        """Time since the last write to a file of the run."""
        stamps = [0.0]
        with contextlib.suppress(OSError):  # the folder may be deleted meanwhile
            endings = (".log", ".arrow", ".yaml")
            entries = [entry for entry in self.folder.iterdir() if entry.suffix in endings]
            stamps += [entry.stat().st_mtime for entry in entries]
        return time.time() - max(stamps)

    def _read_events(self) -> None:
        """Take the events that were written since; the last line may still be on its way."""
        with contextlib.suppress(OSError), (self.folder / EVENTS_FILE).open("rb") as file:
            file.seek(self._events_read)
            lines = file.read()
            lines = lines[: lines.rfind(b"\n") + 1]
            self._events_read += len(lines)
            self.events += parse_events(lines)

    def _read_copies(self) -> None:
        model, dbc = self.folder / MODEL_FILE, self.folder / DBC_FILE
        if self.model is None and model.exists():
            self.model = load_model(model)
        if not self.frame_times_s and dbc.exists():
            bus = self.config.get("bus", {})
            bitrate, data_bitrate = bus.get("bitrate", 500_000), bus.get("data_bitrate")
            self.frame_times_s = {
                message.key: frame_time_s(message, bitrate, data_bitrate)
                for message in load_database(dbc).messages.values()
            }
