"""Record of a run's modes: `events.jsonl`, a line a change, and the time in each mode."""

import json
from collections.abc import Callable, Sequence
from math import isfinite

from rig.bridge.bridge import BridgeState
from rig.bridge.mode_supervisor import Cause, SupervisedState
from rig.bridge.values import Mode, Request
from rig.run.operator import Asked

_MOST_EVENTS = 100_000
"""Lines of `events.jsonl`: a mode that flutters at every tick must not fill the disk."""


class ModeEvents:
    """Notes changes of the mode, as they happen.

    Args:
        note: Writes a line.
        struts: Names of the struts.
        devices: Names of the devices.
    """

    def __init__(
        self, note: Callable[[str], None], struts: Sequence[str], devices: Sequence[str]
    ) -> None:
        self._note = note
        self._struts, self._devices = struts, devices
        self._mode = Mode.INIT
        self._cause: Cause | None = None
        self._events = 0
        self._since_s = 0.0
        self.ticks = dict.fromkeys(Mode, 0)
        """Ticks in each mode."""

    def update(self, state: BridgeState, asked: Asked | None = None) -> None:
        """Note what the state after a tick shows, and what was requested at the tick."""
        supervised = state.supervised
        mode, cause = supervised.mode, supervised.cause
        self.ticks[mode] += 1
        if asked is not None:
            self._write_request(asked, supervised)
        if mode is not self._mode or _kind_of(cause) != _kind_of(self._cause):
            self._write(state, cause)
            if mode is not self._mode:
                self._since_s = supervised.t_ns / 1e9
            self._mode, self._cause = mode, cause

    def cause_of(self, supervised: SupervisedState) -> dict[str, object]:
        """Why a mode is what it is, as a line of the events; empty while it is RUNNING."""
        if supervised.mode is Mode.RUNNING:
            return {}
        return {"t_s": self._since_s, **self._text(supervised.cause)}

    def _write_request(self, asked: Asked, supervised: SupervisedState) -> None:
        line: dict[str, object] = {
            "t_s": supervised.t_ns / 1e9,
            "request": asked.request.value,
            "by": asked.by,
        }
        if asked.request is Request.ACKNOWLEDGE and supervised.mode is Mode.SAFE:
            line["refused"] = True
            line["first_cause"] = self._text(supervised.first_cause)
        self._write_line(line)

    def _write(self, state: BridgeState, cause: Cause | None) -> None:
        supervised = state.supervised
        line: dict[str, object] = {
            "t_s": supervised.t_ns / 1e9,
            "from": self._mode.name,
            "to": supervised.mode.name,
            **self._text(cause),
        }
        first = supervised.first_cause
        if first is not None and first is not cause:
            line["first_cause"] = self._text(first)
        self._write_line(line)

    def _write_line(self, line: dict[str, object]) -> None:
        self._events += 1
        if self._events <= _MOST_EVENTS:
            self._note(json.dumps(line) + "\n")

    def _text(self, cause: Cause | None) -> dict[str, object]:
        """A cause by names and in SI."""
        if cause is None:
            return {}
        text: dict[str, object] = {"cause": cause.event.value}
        if cause.strut >= 0:
            text["strut"] = self._struts[cause.strut]
        if cause.device >= 0:
            text["device"] = self._devices[cause.device]
        if cause.quantity:
            text["quantity"] = cause.quantity
            # JSON has no number for what is none.
            text["value"] = cause.value if isfinite(cause.value) else str(cause.value)
            if isfinite(cause.limit):
                text["limit"] = cause.limit
        return text


def _kind_of(cause: Cause | None) -> tuple[object, ...]:
    """What distinguishes causes: one that returns within a tick that catches up is the same."""
    return () if cause is None else (cause.event, cause.strut, cause.quantity, cause.device)
