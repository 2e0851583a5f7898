"""CAN through python-can, whatever the interface: frames as values, faults as errors of our own."""

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import can

from can_dbc.frame import Frame

_MAX_FRAMES_A_POLL = 4096
"""Bound on one poll, so that a flood of frames cannot hold up a tick for ever."""


class BusError(OSError):
    """The bus cannot be opened, or a frame cannot be sent or received."""


@dataclass(frozen=True)
class BusConfig:
    """How to open a bus.

    Attributes:
        interface: python-can's name: ``virtual``, ``socketcan``, ``pcan``, ``slcan``, ...
        channel: Channel of the interface.
        bitrate: Bit rate in bit/s.
        data_bitrate: Bit rate of CAN FD payloads in bit/s; None on classic CAN.
        options: Further arguments of the interface.
    """

    interface: str
    channel: str
    bitrate: int
    data_bitrate: int | None = None
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])


class Bus:
    """An open bus.

    Args:
        config: How to open it.
        heard: The only (arbitration id, is extended) that are let in; None lets all in.
        listen_only: Send nothing. Most interfaces swallow such a request silently, so it is kept here.
        epoch_ns: Unix time of the run's start; time stamps are given relative to it.

    Raises:
        BusError: The interface cannot be opened.
    """

    def __init__(
        self,
        config: BusConfig,
        heard: Iterable[tuple[int, bool]] | None = None,
        *,
        listen_only: bool = False,
        epoch_ns: int = 0,
    ) -> None:
        self._heard = None if heard is None else frozenset(heard)
        self._listen_only = listen_only
        self._epoch_ns = epoch_ns
        self._epoch_s = epoch_ns * 1e-9
        self._bus = _open(config, self._heard)
        self._receive = self._bus.recv

    def receive(self) -> list[Frame]:
        """All frames that have arrived, in order, without waiting.

        Raises:
            BusError: The interface is gone.
        """
        frames: list[Frame] = []
        receive, heard = self._receive, self._heard
        try:
            for _ in range(_MAX_FRAMES_A_POLL):
                message = receive(0)
                if message is None:
                    break
                key = (message.arbitration_id, message.is_extended_id)
                if heard is None or key in heard or message.is_error_frame:
                    frames.append(self._frame(message))
        except (can.CanError, OSError, ValueError) as error:
            raise BusError(f"receiving failed: {error}") from error
        return frames

    def _frame(self, message: can.Message) -> Frame:
        return Frame(
            round(message.timestamp * 1e9) - self._epoch_ns,
            message.arbitration_id,
            bytes(message.data),
            message.is_extended_id,
            message.is_fd,
            message.bitrate_switch,
            message.is_error_frame,
        )

    def send(self, frame: Frame) -> None:
        """Send one frame; nothing if the bus only listens.

        Raises:
            BusError: The frame cannot be sent.
        """
        if self._listen_only:
            return
        message = can.Message(
            timestamp=frame.t_ns * 1e-9 + self._epoch_s,
            arbitration_id=frame.arbitration_id,
            is_extended_id=frame.is_extended,
            data=frame.data,
            is_fd=frame.is_fd,
            bitrate_switch=frame.bitrate_switch,
        )
        try:
            self._bus.send(message)
        except (can.CanError, OSError, ValueError) as error:
            raise BusError(f"sending failed: {error}") from error

    def close(self) -> None:
        """Close the interface; an interface that is gone already is closed."""
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()


def _open(config: BusConfig, heard: frozenset[tuple[int, bool]] | None) -> can.BusABC:
    options: dict[str, Any] = dict(config.options)
    if config.interface == "virtual":
        # Simulated time would otherwise be overwritten by the time of sending.
        options.setdefault("preserve_timestamps", True)
    if config.data_bitrate is not None:
        options.setdefault("fd", True)
        options.setdefault("data_bitrate", config.data_bitrate)
    filters = None
    if heard is not None:
        filters = [
            {"can_id": key, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended}
            for key, extended in sorted(heard)
        ]
    try:
        bus: can.BusABC = cast("Any", can.Bus)(
            interface=config.interface,
            channel=config.channel,
            bitrate=config.bitrate,
            can_filters=filters,
            **options,
        )
    except (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BusError(
            f"bus.interface {config.interface!r}, bus.channel {config.channel!r}: "
            f"cannot be opened: {reason}"
        ) from error
    return bus
