"""A bus with CANopen devices, through the package `canopen`: for configuration, not for a run.

The package reads in a thread and drops frames at a high rate, so the frames of a run never pass
through it.
"""

import importlib
import logging
import struct
import time
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, cast

import can

from can_dbc.errors import InputError, missing_package
from can_dbc.frame import Frame
from rig.bus.bus import BusConfig, BusError, open_bus

_SDO_REQUEST, _SDO_ANSWER = 0x600, 0x580
_ANSWER_WITHIN_S = 0.5
_LSS_ANSWER_WITHIN_S = 0.1
_LAST_NODE = 127
_MOST_FRAMES = 200_000
"""Frames that are kept while listening; a second of a full bus at 1 Mbit/s has some 10 000."""

_NO_NODE_ID = 255
"""Of a device that has none (CiA 305)."""

OPERATIONAL, PRE_OPERATIONAL, RESET_COMMUNICATION = 1, 128, 130
"""Commands of network management."""


def package() -> ModuleType:
    """The package `canopen`.

    Raises:
        BusError: It is not installed.
    """
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # what it logs, it also raises
    try:
        return importlib.import_module("canopen")
    except ImportError:
        raise BusError(missing_package("canopen", "pip install -e '.[sensors]'")) from None


class RefusedError(InputError):
    """A device refuses an access."""


class CanOpenNetwork:
    """A bus on which CANopen devices are read and set.

    Raises:
        BusError: The interface cannot be opened, or the package is not installed.
    """

    def __init__(self, config: BusConfig, *, listen_only: bool = False) -> None:
        self._package = package()
        self._aborted: type[Exception] = self._package.SdoAbortedError
        self._failed: type[Exception] = self._package.SdoCommunicationError
        self.listens_only = listen_only
        self.received: list[Frame] = []
        """Received frames in their order, the first ones of very many."""
        self._bus = open_bus(config, listen_only=listen_only)
        self._network: Any = self._package.Network(self._bus)
        self._network.listeners = [_Listener(self._network.notify, self.received)]
        self._network.NOTIFIER_CYCLE = 0.1
        self._network.connect()
        self._clients: dict[int, Any] = {}

    def close(self) -> None:
        """Close the bus."""
        try:
            self._network.disconnect()
        except (can.CanError, OSError) as error:
            raise BusError(f"the bus failed: {error}") from error

    def listen(self, seconds: float) -> None:
        """Wait while frames come in."""
        time.sleep(seconds)

    def search(self) -> None:
        """Ask every node id for its device type; answers appear in `received`."""
        for node_id in range(1, _LAST_NODE + 1):
            self._send(_SDO_REQUEST + node_id, b"\x40\x00\x10\x00\x00\x00\x00\x00")

    def ask_for_addresses(self) -> None:
        """Ask every J1939 device for its address claim, from the address of those without one."""
        self._transmit(can.Message(arbitration_id=0x18EAFFFE, data=b"\x00\xee\x00"))

    def read(self, node_id: int, index: int, subindex: int = 0) -> bytes | None:
        """Content of an object; None where the device reports that it has none, or none to read.

        Raises:
            BusError: The device does not answer, or the bus fails.
        """
        try:
            return bytes(self._client(node_id).upload(index, subindex))
        except self._aborted:
            return None
        except (self._failed, can.CanError, OSError, struct.error) as error:
            raise BusError(
                f"node {node_id}, object {index:04X}h: no answer ({error}): is the device "
                "powered, and the bit rate the bus's own? `rig sensor scan` lists the nodes"
            ) from error

    def write(self, node_id: int, index: int, subindex: int, content: bytes) -> None:
        """Write an object.

        Raises:
            RefusedError: The device refuses it.
            BusError: The device does not answer, or the bus fails.
        """
        where = f"node {node_id}, object {index:04X}h.{subindex}"
        try:
            self._client(node_id).download(index, subindex, content)
        except self._aborted as error:
            raise RefusedError(f"{where}: the device refuses {content.hex()}: {error}") from error
        except (self._failed, can.CanError, OSError, struct.error) as error:
            raise BusError(f"{where}: no answer: {error}") from error

    def command(self, node_id: int, command: int) -> None:
        """Send a command of network management; there is no answer to it."""
        self._send(0x000, bytes((command, node_id)))

    def find_unconfigured(self) -> Sequence[int] | None:
        """Identity of a device without a node id, by LSS fast scan; None if there is none.

        It takes some 15 s where there is one, and a tenth of a second where there is none.
        """
        lss = self._network.lss
        lss.RESPONSE_TIMEOUT = _LSS_ANSWER_WITHIN_S
        try:
            is_there, identity = lss.fast_scan()
        except (can.CanError, OSError) as error:
            raise BusError(f"sending failed: {error}") from error
        return cast("Sequence[int]", identity) if is_there else None

    def give_node_id(self, node_id: int) -> None:
        """Set the node id of the device of `find_unconfigured`, until it is switched off.

        Raises:
            BusError: It does not take it.
        """
        lss = self._network.lss
        lss.RESPONSE_TIMEOUT = _ANSWER_WITHIN_S
        try:
            lss.configure_node_id(node_id)
            lss.send_switch_state_global(lss.WAITING_STATE)
        except Exception as error:  # the package raises errors of many classes here
            raise BusError(f"the device does not take node id {node_id}: {error}") from error

    def take_node_id_back(self, node_id: int, identity: Sequence[int]) -> None:
        """Undo `give_node_id` for the device with an identity, as `find_unconfigured` returns it.

        Raises:
            BusError: It keeps it.
        """
        lss = self._network.lss
        try:
            lss.send_switch_state_selective(*identity)
            lss.configure_node_id(_NO_NODE_ID)
            lss.send_switch_state_global(lss.WAITING_STATE)
        except Exception as error:  # the package raises errors of many classes here
            raise BusError(f"the device keeps node id {node_id}: {error}") from error
        self.command(node_id, RESET_COMMUNICATION)

    def _client(self, node_id: int) -> Any:
        client = self._clients.get(node_id)
        if client is None:
            request, answer = _SDO_REQUEST + node_id, _SDO_ANSWER + node_id
            objects = self._package.ObjectDictionary()
            client = self._package.sdo.SdoClient(request, answer, objects)
            client.RESPONSE_TIMEOUT = _ANSWER_WITHIN_S
            client.network = self._network
            self._network.subscribe(answer, client.on_response)
            self._clients[node_id] = client
        return client

    def _send(self, arbitration_id: int, data: bytes) -> None:
        self._transmit(can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=data))

    def _transmit(self, message: can.Message) -> None:
        if self.listens_only:
            raise BusError("sending failed: the bus is opened to listen only")
        try:
            self._bus.send(message, timeout=1.0)
        except (can.CanError, OSError, ValueError) as error:
            raise BusError(f"sending failed: {error}") from error


class _Listener(can.Listener):
    """Keeps received frames, and passes on what can be CANopen: never J1939's ids of 29 bits."""

    def __init__(
        self, notify: Callable[[int, bytearray, float], None], received: list[Frame]
    ) -> None:
        self._notify = notify
        self._received = received

    def on_message_received(self, msg: can.Message) -> None:
        if msg.is_error_frame or msg.is_remote_frame:
            return
        if len(self._received) < _MOST_FRAMES:
            t_ns, data = round(msg.timestamp * 1e9), bytes(msg.data)
            self._received.append(Frame(t_ns, msg.arbitration_id, data, msg.is_extended_id))
        if not msg.is_extended_id:
            self._notify(msg.arbitration_id, msg.data, msg.timestamp)

    def stop(self) -> None:
        """There is nothing to release."""
