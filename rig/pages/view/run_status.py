"""What is known of a run's folder, whatever state it is in."""

import contextlib
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from can_dbc.bus_load import frame_time_s
from can_dbc.database import load_database
from can_dbc.errors import InputError
from dart_model.spec import ModelSpec, load_model
from rig.log.file_names import DBC_FILE, MODEL_FILE, RUN_FILE
from rig.log.follower import RunFollower
from rig.log.reader import read_header

_SILENT_S = 2.0
"""Time after which a run that nobody ended and nobody writes has been killed."""

_MUCH_BYTES = 10_000_000
"""Bytes that are still to be read from which on the page says so."""

_STEPS_AT_ONCE = 400_000
"""Steps that one answer takes in: a tenth of a second's work, so that the page shows how far it
is."""


class WatchedRun:
    """A run's folder: absent, empty, being written, whole, cut off, or no run at all.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.follower = RunFollower(folder)
        self.lock = threading.Lock()
        """Held by whoever uses the follower."""
        self.header: Mapping[str, Any] = {}
        """Content of `run.yaml`; empty before it is there."""
        self.model: ModelSpec | None = None
        """The model that ran, once its copy is there."""
        self.frame_times_s: Mapping[tuple[int, bool], float] = {}
        """Time that a frame occupies the bus, by identifier and whether that is extended."""
        self._stamp = -1.0
        self._epoch_ns: object = None
        self._wrong: str | None = None

    def update(self) -> None:
        """Take in what has been written since the last time."""
        path = self.folder / RUN_FILE
        try:
            stamp = path.stat().st_mtime
        except OSError:
            return
        if stamp != self._stamp:
            self._stamp, self._wrong = stamp, None
            try:
                header = read_header(self.folder)
                if self.follower.is_another or header["epoch_ns"] != self._epoch_ns:
                    self._begin_anew()
                self.header, self._epoch_ns = header, header["epoch_ns"]
                self._read_copies()
            except InputError as error:
                self._wrong = str(error)
        if self._wrong is None:
            self.follower.update(_STEPS_AT_ONCE)

    def _begin_anew(self) -> None:
        """Forget what was known: the folder holds another run."""
        self.follower, self.model, self.frame_times_s = RunFollower(self.folder), None, {}

    def state(self) -> tuple[str, str]:
        """A word for the state of the run, and a sentence about it."""
        if self._wrong is not None:
            return "unreadable", self._wrong
        if not self.header:
            return self._without_header()
        if self.follower.unread_bytes > _MUCH_BYTES:
            return "reading", f"Reading: {self.follower.share_read:.0%}"
        if "ending" in self.header or "capture" in self.header:
            return self._ended()
        if self._age_s() < _SILENT_S:
            return "live", "Being written."
        return "killed", (
            "Not written any more, and nobody ended it: it was killed. "
            f"`rig replay {self.folder}` computes what is missing from the frames."
        )

    def _without_header(self) -> tuple[str, str]:
        if not self.folder.exists():
            return "absent", f"{self.folder}: no such folder yet; it is shown once it is there."
        if not self.folder.is_dir():
            return "unreadable", f"{self.folder}: is no folder, expected a run"
        return "absent", f"{self.folder}: holds no run yet; it is shown once it does."

    def _ended(self) -> tuple[str, str]:
        capture = cast("Mapping[str, Any] | None", self.header.get("capture"))
        if capture is not None:
            return "done", f"A window around a fault: {capture.get('why')}."
        status = str(cast("Mapping[str, Any]", self.header["ending"]).get("status"))
        if not self.follower.steps:
            return "empty", f"Ended ({status}) without a single tick."
        words = {"done": "Ended in order.", "safe": "Ended in its safe state."}
        return status, words.get(status, f"Ended: {status}.")

    def _age_s(self) -> float:
        """Time since something was last written."""
        stamps = [0.0]
        with contextlib.suppress(OSError):  # somebody may delete it meanwhile
            written = (".log", ".arrow", ".yaml")
            entries = [entry for entry in self.folder.iterdir() if entry.suffix in written]
            stamps += [entry.stat().st_mtime for entry in entries]
        return time.time() - max(stamps)

    def _read_copies(self) -> None:
        model, dbc = self.folder / MODEL_FILE, self.folder / DBC_FILE
        if self.model is None and model.exists():
            self.model = load_model(model)
        if not self.frame_times_s and dbc.exists():
            bus = cast("Mapping[str, Any]", self.header.get("config", {})).get("bus", {})
            bitrate, data_bitrate = bus.get("bitrate", 500_000), bus.get("data_bitrate")
            self.frame_times_s = {
                message.key: frame_time_s(message, bitrate, data_bitrate)
                for message in load_database(dbc).messages.values()
            }
