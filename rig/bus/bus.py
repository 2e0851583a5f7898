"""CAN through python-can, whatever the interface: frames as values, faults as `BusError`."""

import contextlib
import errno
import logging
import socket
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import field
from types import MappingProxyType
from typing import Annotated, Any, cast

import can
from can.typechecking import BitTimingDict, BitTimingFdDict
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from can_dbc.addressing import Filter
from can_dbc.errors import InputError, expected_name
from can_dbc.frame import Frame

FRAMES_A_MS = 64
"""Bound on the frames read per ms since the last tick, so that a flood delays no tick. No bus
reaches it (CAN FD at 1 and 8 Mbit/s carries a third); further frames wait."""

_QUEUE_BYTES, _SO_RCVBUFFORCE = 4_000_000, 33
"""Some 5 000 frames wait for a tick that is late; more than usual is granted to root alone."""

_MOST_KNOWN = 10_000
"""Identifiers remembered as accepted or not, and frames that may come back: none must fill the
memory."""

_RETURN_OWN_FRAMES = ("udp_multicast",)
"""Interfaces that return what is sent on them, whatever they are asked for."""

WITHOUT_BIT_RATE = ("virtual", "udp_multicast")
"""Interfaces that are no bus with a bit rate."""

SHARED_INTERFACES = ("socketcan", "udp_multicast")
"""Interfaces that several processes can use at once."""

_LISTEN_ONLY_OPTIONS: dict[str, dict[str, object]] = {
    "pcan": {"state": can.BusState.PASSIVE},
    "slcan": {"listen_only": True},
    "vector": {"listen_only": True},
    "kvaser": {"driver_mode": False},
}
"""What keeps a controller from acknowledging frames too. SocketCAN leaves this to `ip link`."""

# A driver that is missing is logged where python-can is imported, and raised when it is opened.
logging.getLogger("can").addHandler(logging.NullHandler())

_STATES = MappingProxyType({state.name: state for state in can.BusState})
_TIMINGS: Mapping[Callable[..., object], frozenset[str]] = MappingProxyType(
    {
        can.BitTimingFd: frozenset(BitTimingFdDict.__annotations__),
        can.BitTiming: frozenset(BitTimingDict.__annotations__),
    }
)
"""Options that together are a bit timing."""


class BusError(InputError):
    """The bus cannot be opened, or a frame cannot be sent or received."""


class BusFullError(BusError):
    """A frame cannot be sent now, because the interface's queue is full; it may be later."""


_Name = Annotated[str, Field(min_length=1, max_length=255)]
_BitRate = Annotated[int, Field(gt=0, le=1_000_000_000)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class BusConfig:
    """How to open the bus.

    Attributes:
        interface: python-can's name of the interface: `socketcan`, `pcan`, `slcan`, `virtual`, ...
        channel: Channel of the interface.
        bitrate: Bit rate in bit/s. With `socketcan`, the key does not set the rate: state the rate
            that was set with `ip link`, from which `rig check` computes the bus load.
        data_bitrate: Bit rate of CAN FD payloads in bit/s; classic CAN if absent. With `socketcan`,
            `ip link` sets this rate, too.
        options: Further arguments of python-can's interface, by name.
    """

    interface: _Name = "virtual"
    channel: _Name = "rig"
    bitrate: _BitRate = 1_000_000
    data_bitrate: _BitRate | None = None
    options: dict[str, object] = field(default_factory=dict[str, object])


class Bus:
    """An open bus.

    Args:
        filters: The only frames that are accepted, besides error frames; None accepts all.
        listen_only: Send nothing. Most interfaces ignore such a request silently, so it is
            enforced here: the method of sending is not even looked up.
        epoch_ns: Unix time of the run's start; time stamps are given relative to it.

    Raises:
        BusError: The interface cannot be opened.
    """

    def __init__(
        self,
        config: BusConfig,
        filters: Iterable[Filter] | None = None,
        *,
        listen_only: bool = False,
        epoch_ns: int = 0,
    ) -> None:
        self._filters = None if filters is None else frozenset(filters)
        self._accepted: dict[tuple[int, bool], bool] = {}
        self.epoch_ns = epoch_ns
        """Unix time that stamps are relative to; to be updated when the system's clock was set."""
        self._bus = open_bus(config, self._filters, listen_only=listen_only)
        asked_for_own = bool(config.options.get("receive_own_messages", False))
        self._returns_own = config.interface in _RETURN_OWN_FRAMES or asked_for_own
        self._sent: Counter[tuple[int, bool, bytes]] = Counter()
        self._receive = self._bus.recv
        self._send = None if listen_only else self._bus.send

    def receive(self, elapsed_ns: int = 1_000_000_000) -> list[Frame]:
        """The frames that have arrived, in order, without waiting; error frames among them.

        Their number is bounded by the time since the last poll.

        Raises:
            BusError: The interface is gone.
        """
        frames: list[Frame] = []
        receive = self._receive
        try:
            for _ in range(FRAMES_A_MS * (elapsed_ns // 1_000_000 + 1)):
                message = receive(0)
                if message is None:
                    break
                if self._returns_own and self._is_own(message):
                    continue
                if message.is_error_frame or self._accepts(message):
                    frames.append(self._frame(message))
        except Exception as error:  # drivers raise whatever they like
            raise BusError(f"receiving failed: {_describe(error)}") from error
        return frames

    def _is_own(self, message: can.Message) -> bool:
        """Whether a frame is one that was sent here and comes back: it is no second sender's."""
        key = message.arbitration_id, message.is_extended_id, bytes(message.data)
        if key not in self._sent:
            return False
        self._sent[key] -= 1
        if not self._sent[key]:
            del self._sent[key]
        return True

    def _accepts(self, message: can.Message) -> bool:
        if self._filters is None:
            return True
        key = (message.arbitration_id, message.is_extended_id)
        known = self._accepted.get(key)
        if known is None:
            known = self._accepted[key] = any(
                item.is_extended == message.is_extended_id
                and message.arbitration_id & item.mask == item.arbitration_id & item.mask
                for item in self._filters
            )
            if len(self._accepted) > _MOST_KNOWN:
                self._accepted.clear()
        return known

    def _frame(self, message: can.Message) -> Frame:
        return Frame(
            round(message.timestamp * 1e9) - self.epoch_ns,
            message.arbitration_id,
            bytes(message.data),
            message.is_extended_id,
            message.is_fd,
            message.bitrate_switch,
            message.is_error_frame,
        )

    @property
    def listens_only(self) -> bool:
        """Whether nothing is ever sent."""
        return self._send is None

    def send(self, frame: Frame) -> None:
        """Send one frame; nothing if the bus only listens.

        Raises:
            BusFullError: The interface's queue is full.
            BusError: The frame cannot be sent.
        """
        if self._send is None:
            return
        message = can.Message(
            timestamp=(frame.t_ns + self.epoch_ns) * 1e-9,
            arbitration_id=frame.arbitration_id,
            is_extended_id=frame.is_extended,
            data=frame.data,
            is_fd=frame.is_fd,
            bitrate_switch=frame.bitrate_switch,
        )
        try:
            self._send(message)
        except Exception as error:  # drivers raise whatever they like
            raise _sending_error(error) from error
        if self._returns_own:
            if len(self._sent) > _MOST_KNOWN:
                self._sent.clear()
            self._sent[frame.arbitration_id, frame.is_extended, frame.data] += 1

    def close(self) -> None:
        """Close the interface; an interface that is gone already is closed."""
        with contextlib.suppress(Exception):
            self._bus.shutdown()


def _widen(connection: socket.socket) -> None:
    """Let the kernel keep more frames than its usual 250 or so, as many as it allows for."""
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _QUEUE_BYTES)
        connection.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _QUEUE_BYTES)


def _describe(error: Exception) -> str:
    """What an error of a driver says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _sending_error(error: Exception) -> BusError:
    code = getattr(error, "error_code", None) or getattr(error, "errno", None)
    text = _describe(error)
    full = code == errno.ENOBUFS or "buffer full" in text.lower()
    return (BusFullError if full else BusError)(f"sending failed: {text}")


def _interface_options(options: Mapping[str, object]) -> dict[str, object]:
    """Options of an interface, with the objects that a file can only describe.

    python-can makes them too, but only together with the settings of the user and the environment.
    """
    found = dict(options)
    state = found.get("state")
    if isinstance(state, str):
        if state not in _STATES:
            raise BusError(f"bus.options.state {state!r}: expected one of {', '.join(_STATES)}")
        found["state"] = _STATES[state]
    for timing, keys in _TIMINGS.items():
        if "timing" not in found and keys <= found.keys():
            try:
                found["timing"] = timing(**{key: found[key] for key in keys}, strict=False)
            except (ValueError, TypeError) as error:
                raise BusError(f"bus.options: expected a bit timing: {error}") from error
    return found


def check_interface(name: str) -> None:
    """Refuse an interface that python-can, with what is installed for it, does not have.

    Raises:
        BusError: It is unknown.
    """
    if name not in can.VALID_INTERFACES:
        expected = expected_name(name, sorted(can.VALID_INTERFACES))
        raise BusError(f"bus.interface {name!r}: {expected}")


def open_bus(
    config: BusConfig, filters: frozenset[Filter] | None = None, *, listen_only: bool = False
) -> can.BusABC:
    """python-can's open bus, for callers that need more of it than `Bus` offers.

    Filters and silence apply where the interface supports them.

    Raises:
        BusError: The interface cannot be opened.
    """
    check_interface(config.interface)
    options = _interface_options(config.options)
    if listen_only:
        options |= _LISTEN_ONLY_OPTIONS.get(config.interface, {})
    if config.interface == "virtual":
        # Simulated time would otherwise be overwritten by the time of sending.
        options.setdefault("preserve_timestamps", True)
    if config.data_bitrate is not None:
        options.setdefault("fd", True)
        options.setdefault("data_bitrate", config.data_bitrate)
    kernel_filters = None
    if filters is not None and config.interface == "socketcan":
        # The kernel's filters let error frames pass. python-can's own, which stand in for them at
        # other interfaces, do not, and end a poll at the first foreign frame.
        kernel_filters = [
            {"can_id": item.arbitration_id, "can_mask": item.mask, "extended": item.is_extended}
            for item in sorted(filters, key=lambda item: item.arbitration_id)
        ]
    try:
        bus: can.BusABC = cast("Any", can.Bus)(
            interface=config.interface,
            # Some interfaces know their channels by numbers alone, and none by digits in a text.
            channel=int(config.channel) if config.channel.isdecimal() else config.channel,
            ignore_config=True,  # settings of a user or an environment are in no log of a run
            bitrate=config.bitrate,
            can_filters=kernel_filters,
            **options,
        )
        if config.interface == "socketcan":
            _widen(cast("Any", bus).socket)
    except Exception as error:  # drivers raise whatever they like
        raise BusError(
            f"bus.interface {config.interface!r}, bus.channel {config.channel!r}: "
            f"cannot be opened: {_describe(error)}{_cure(config, error)}"
        ) from error
    return bus


_DRIVERS = {
    "pcan": ": expected PEAK's driver, PCAN-Basic, to be installed",
    "slcan": ": expected the package pyserial (`pip install pyserial`), and the adapter's device",
    "vector": ": expected Vector's XL driver library to be installed",
    "kvaser": ": expected Kvaser's CANlib to be installed",
    "ixxat": ": expected the VCI driver of HMS to be installed",
}
"""What interfaces need that is not part of python-can."""


def _cure(config: BusConfig, error: Exception) -> str:
    """What to do about an interface that cannot be opened; empty where that is not known.

    With SocketCAN, python-can raises what the kernel reports, an `OSError`.
    """
    if config.interface != "socketcan":
        return _DRIVERS.get(config.interface, "")
    name = config.channel
    up = f"`ip link set {name} up type can bitrate {config.bitrate}` as root"
    cures = {
        errno.EAFNOSUPPORT: "this kernel has no SocketCAN, expected one with the module can_raw "
        "(`modprobe can_raw` as root), or another interface",
        errno.ENODEV: f"expected an interface that `ip link` lists, switched on by {up}",
        errno.ENETDOWN: f"expected {up}",
        errno.EPERM: "expected the rights to open raw sockets",
    }
    cure = cures.get(getattr(error, "errno", None) or 0)
    return "" if cure is None else f": {cure}"
