"""Publishes runs through Foxglove's SDK, for layouts in Foxglove or Lichtblick.

Steps are published as JSON, one topic a run, with their time after the epoch of the first run, so
that finished runs are superimposed. The protocol has no token: a client can change nothing, and any
page in a browser of this machine may connect and read.
"""

import importlib
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError, missing_package
from rig.pages.view.run_status import WatchedRun
from rig.run.changed_settings import read_changes

if TYPE_CHECKING:
    from foxglove import Channel, Parameter
    from foxglove.websocket import PlaybackControlRequest, PlaybackState

HOST = "127.0.0.1"

_STEPS_AT_ONCE = 20_000
"""Steps that are published in one call: half a second's work."""

_BACKLOG = 2 * _STEPS_AT_ONCE
"""Messages that are queued for a slow client before the oldest are dropped."""

_PUBLISH_EVERY_S = 0.05
"""Time between two calls of `publish`: twenty a second are smooth."""

_PLAYBACK_DELAY_NS = 200_000_000
"""Time from the first subscription to the beginning of the playback."""

_PARAMETERS_EVERY_NS = 1_000_000_000
"""Time between two checks for changes by `rig set`: a second."""


class Playback(NamedTuple):
    """State of the playback of finished runs.

    Attributes:
        position_ns: Time after the runs' beginning, at `since_ns`.
        since_ns: Time of the clock.
        speed: Time of the runs over the clock's.
        is_playing: Whether it is running.
    """

    position_ns: int
    since_ns: int
    speed: float = 1.0
    is_playing: bool = False

    def at(self, now_ns: int, end_ns: int) -> "Playback":
        """The state at a later time; it stops at the end."""
        position_ns = self.position_ns
        if self.is_playing:
            position_ns += round((now_ns - self.since_ns) * self.speed)
        is_playing = self.is_playing and position_ns < end_ns
        return Playback(min(position_ns, end_ns), now_ns, self.speed, is_playing)


class Topic:
    """A run, and the number of its steps that have been published."""

    def __init__(self, run: WatchedRun, name: str, new_channel: "Callable[..., Channel]") -> None:
        self.run, self.name, self._new_channel = run, name, new_channel
        self._channel: Channel | None = None
        self._paths: tuple[tuple[str, ...], ...] = ()
        self._published = 0

    @property
    def epoch_ns(self) -> int | None:
        """Epoch of the run; None before it has begun."""
        return self.run.epoch_ns

    @property
    def is_subscribed(self) -> bool:
        """Whether a client has subscribed."""
        return self._channel is not None and bool(self._channel.has_sinks())

    def read(self) -> str:
        """Read new steps; returns the state of the run."""
        self.run.update()
        if self._channel is None and self.run.follower.columns:
            self._paths = tuple(tuple(name.split(".")) for name in self.run.follower.columns)
            self._channel = self._new_channel(f"/{self.name}", schema=_schema(self._paths))
        return self.run.state()[0]

    def publish(self, epoch_ns: int, until_ns: int | None) -> None:
        """Publish the steps that have not been: up to a time of the run, or all."""
        follower = self.run.follower
        end = min(follower.steps, self._published + _STEPS_AT_ONCE)
        if self._channel is None or end <= self._published:
            return
        if until_ns is not None:
            end = min(end, follower.between(0.0, until_ns * 1e-9)[1])
        rows = follower.rows(self._published, end)
        if until_ns is not None:
            rows = rows[rows[:, 0] <= until_ns]
        for row in rows:
            self._channel.log(_message(self._paths, row), log_time=epoch_ns + int(row[0]))
        self._published += len(rows)

    def seek(self, t_ns: int) -> None:
        """Continue from a time."""
        follower = self.run.follower
        begin, end = follower.between(t_ns * 1e-9, t_ns * 1e-9)
        rows = follower.rows(begin, end)
        self._published = begin + int(np.searchsorted(rows[:, 0], t_ns))

    def skip(self) -> None:
        """Leave out all steps so far, for which there was no subscriber."""
        self._published = self.run.follower.steps

    def parameters(self) -> dict[str, object]:
        """Numbers and texts of the configuration, with the changes during the run."""
        parameters = dict(_flat(self.name, self.run.config))
        for _, changes in read_changes(self.run.folder):
            parameters |= {f"{self.name}.{key}": value for key, value in changes.items()}
        return parameters


class FoxgloveView:
    """A server of Foxglove's protocol, on loopback.

    Runs that have ended when it starts are played from their beginning after the first
    subscription, and a client may pause, seek and change the speed. If one of them is still being
    written, new steps are published at once.

    Args:
        folders: Folders of runs.
        port: Port on loopback; 0 for a free one.

    Raises:
        InputError: The SDK is not installed, the port is taken, or none of the runs can be read.
    """

    def __init__(self, folders: Sequence[Path], port: int) -> None:
        self._sdk = _sdk()
        context = self._sdk.Context()
        channel = partial(self._sdk.Channel, context=context)
        names = _names(folders)
        self._topics = [
            Topic(WatchedRun(folder), name, channel)
            for folder, name in zip(folders, names, strict=True)
        ]
        states = [_read_all(topic) for topic in self._topics]
        for topic, state in zip(self._topics, states, strict=True):
            if state == "unreadable":
                raise InputError(topic.run.state()[1])
        self._is_live = any(state in ("live", "absent") for state in states)
        if self._is_live:
            for topic in self._topics:
                topic.skip()
        self._end_ns = round(1e9 * max(topic.run.follower.span_s[1] for topic in self._topics))
        self._playback = Playback(0, 0)
        self._has_begun = False
        self._subscribed_ns: int | None = None
        self._lock = threading.Lock()
        epoch_ns = self._epoch_ns()
        span = None if self._is_live or epoch_ns is None else (epoch_ns, epoch_ns + self._end_ns)
        try:
            self._server = self._sdk.start_server(
                name="rig view",
                host=HOST,
                port=port,
                capabilities=[self._sdk.Capability.Parameters],
                server_listener=_listener(self._sdk, self),
                playback_time_range=span,
                message_backlog_size=_BACKLOG,
                context=context,
            )
        except RuntimeError as error:
            raise InputError(f"--port {port}: {error}, expected a port that is free") from error
        self._parameters, self._parameters_ns = self._all_parameters(), 0

    @property
    def address(self) -> str:
        """Address to which a client connects."""
        return f"ws://{HOST}:{self._server.port}"

    def close(self) -> None:
        """End the server."""
        self._server.stop()

    def publish_until(self, stop: Callable[[], bool]) -> None:
        """Publish until `stop` returns true, then end the server."""
        while not stop():
            self.publish(time.monotonic_ns())
            time.sleep(_PUBLISH_EVERY_S)
        self.close()

    def play(self, request: "PlaybackControlRequest") -> "PlaybackState":
        """Carry out a client's request to the playback; a thread of the SDK calls it."""
        with self._lock:
            epoch_ns, before = cast("int", self._epoch_ns()), self._playback
            position_ns = before.position_ns
            if request.seek_time is not None:
                position_ns = min(max(0, request.seek_time - epoch_ns), self._end_ns)
                for topic in self._topics:
                    topic.seek(position_ns)
            speed = request.playback_speed
            self._playback = Playback(
                position_ns,
                before.since_ns,
                speed if math.isfinite(speed) and speed > 0.0 else before.speed,
                request.playback_command == self._sdk.websocket.PlaybackCommand.Play,
            )
            self._has_begun = True
            return self._state(epoch_ns, request.seek_time is not None, request.request_id)

    def parameters(self, names: Sequence[str]) -> "list[Parameter]":
        """Parameters by name, or all of them."""
        values = self._all_parameters()
        return [
            self._sdk.Parameter(name, value=values[name])
            for name in names or values
            if name in values
        ]

    def publish(self, now_ns: int) -> None:
        """Publish the steps and parameters that are due.

        Args:
            now_ns: Time of a clock that never jumps.
        """
        epoch_ns = self._epoch_ns()
        if epoch_ns is None:
            for topic in self._topics:
                topic.read()
            return
        if self._is_live:
            for topic in self._topics:
                topic.read()
                if topic.is_subscribed:
                    topic.publish(epoch_ns, None)
                else:
                    topic.skip()
            self._publish_parameters(now_ns)
        else:
            with self._lock:
                self._play(now_ns, epoch_ns)

    def _all_parameters(self) -> dict[str, object]:
        return {key: value for t in self._topics for key, value in t.parameters().items()}

    def _epoch_ns(self) -> int | None:
        return next((epoch for t in self._topics if (epoch := t.epoch_ns) is not None), None)

    def _play(self, now_ns: int, epoch_ns: int) -> None:
        before = self._playback
        if not self._has_begun:
            if self._subscribed_ns is None and any(topic.is_subscribed for topic in self._topics):
                self._subscribed_ns = now_ns
            # A client subscribes to its topics one after another, and needs the beginning of each.
            self._has_begun = (
                self._subscribed_ns is not None
                and now_ns - self._subscribed_ns >= _PLAYBACK_DELAY_NS
            )
            self._playback = Playback(0, now_ns, is_playing=self._has_begun)
            if not self._has_begun:
                return  # without a subscription the first step would be lost
        if not self._playback.since_ns:  # requested before the first call
            self._playback = self._playback._replace(since_ns=now_ns)
        self._playback = self._playback.at(now_ns, self._end_ns)
        for topic in self._topics:
            topic.publish(epoch_ns, self._playback.position_ns)
        if before.is_playing != self._playback.is_playing:
            self._server.broadcast_playback_state(self._state(epoch_ns, did_seek=False))

    def _state(self, epoch_ns: int, did_seek: bool, request: str | None = None) -> "PlaybackState":
        playback, words = self._playback, self._sdk.websocket.PlaybackStatus
        at_rest = words.Paused if playback.position_ns < self._end_ns else words.Ended
        return self._sdk.websocket.PlaybackState(
            status=words.Playing if playback.is_playing else at_rest,
            current_time=epoch_ns + playback.position_ns,
            playback_speed=playback.speed,
            did_seek=did_seek,
            request_id=request,
        )

    def _publish_parameters(self, now_ns: int) -> None:
        """Publish the changes by `rig set`, once a second."""
        if now_ns - self._parameters_ns < _PARAMETERS_EVERY_NS:
            return
        self._parameters_ns = now_ns
        now = self._all_parameters()
        other = {key: value for key, value in now.items() if self._parameters.get(key) != value}
        if other:
            self._server.publish_parameter_values(self.parameters(list(other)))
        self._parameters = now


def _listener(sdk: ModuleType, view: FoxgloveView) -> object:
    """Callbacks for the SDK, whose threads call them."""

    class Listener(sdk.websocket.ServerListener):
        def on_get_parameters(
            self, _client: object, names: list[str], _id: str | None = None
        ) -> "list[Parameter]":
            return view.parameters(names)

        def on_set_parameters(
            self, _client: object, given: "list[Parameter]", _id: str | None = None
        ) -> "list[Parameter]":
            # A client cannot change anything: it gets the current values.
            return view.parameters([parameter.name for parameter in given])

        def on_playback_control_request(self, request: "PlaybackControlRequest") -> "PlaybackState":
            return view.play(request)

    return Listener()


def _sdk() -> ModuleType:
    try:
        foxglove = importlib.import_module("foxglove")  # an extra that may not be there
        importlib.import_module("foxglove.websocket")
    except ImportError as error:
        raise InputError(
            "--foxglove: " + missing_package("foxglove-sdk", "pip install -e '.[foxglove]'")
        ) from error
    foxglove.set_log_level("ERROR")
    return foxglove


def _names(folders: Sequence[Path]) -> list[str]:
    """Names of the folders, with a number where two have the same."""
    names: list[str] = []
    for folder in folders:
        name = folder.absolute().name
        same = sum(other.absolute().name == name for other in folders[: len(names)])
        names.append(f"{name}-{same + 1}" if same else name)
    return names


def _read_all(topic: Topic) -> str:
    """Read all steps of a run; returns its state."""
    while (state := topic.read()) == "reading":
        pass
    return state


def _schema(paths: Sequence[Sequence[str]]) -> dict[str, Any]:
    root: dict[str, Any] = {"type": "object", "title": "rig.Step", "properties": {}}
    for path in paths:
        node = root
        for name in path[:-1]:
            empty: dict[str, Any] = {"type": "object", "properties": {}}
            node = node["properties"].setdefault(name, empty)
        node["properties"][path[-1]] = {"type": "number"}
    return root


def _message(paths: Sequence[Sequence[str]], row: NDArray[np.float64]) -> dict[str, Any]:
    """A step, without columns that are NaN, which JSON does not have."""
    root: dict[str, Any] = {}
    for path, value in zip(paths, row.tolist(), strict=True):
        if not math.isfinite(value):
            continue
        node = root
        for name in path[:-1]:
            node = node.setdefault(name, {})
        node[path[-1]] = value
    return root


def _flat(key: str, value: object) -> list[tuple[str, object]]:
    if isinstance(value, Mapping):
        items = cast("Mapping[object, object]", value).items()
    elif isinstance(value, list):
        items = enumerate(cast("list[object]", value))
    else:
        return [] if value is None else [(key, value)]
    return [pair for name, item in items for pair in _flat(f"{key}.{name}", item)]
