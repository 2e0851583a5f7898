"""Survey of a bus: CANopen devices by their objects, J1939 devices by their claims, other frames.

Devices are only read; nothing in them is changed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import median

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.bus.bus import BusError
from rig.bus.canopen_network import CanOpenNetwork
from rig.sensors.canopen_device import CanOpenDevice, describe_device
from rig.sensors.eds_file import EdsObjects
from rig.sensors.j1939 import AddressClaim, GroupMessage, address_claims, group_messages

_ANSWERS, _HEARTBEATS = range(0x581, 0x600), range(0x701, 0x780)
_ANSWERS_WITHIN_S, _CLAIMS_WITHIN_S = 0.5, 0.5
"""A device answers an SDO within some ms; a J1939 address is claimed within 0.25 s."""

_DEVICE_TYPE, _MOST_UNANSWERED = 0x1000, 3
_FEWEST = 4
"""Frames from which an interval is determined."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Traffic:
    """Frames of one id: their number, the length of the last, and the median interval, if known."""

    arbitration_id: int
    is_extended: bool
    count: int
    length_bytes: int
    interval_s: float | None


@dataclass(frozen=True)
class BusSurvey:
    """Devices and frames on a bus.

    Attributes:
        devices: CANopen devices that describe themselves, by node id.
        silent: Node ids that sent frames and gave no description.
        unconfigured: Identity of a device without a node id; None if there is none.
        claims: J1939 devices that claim an address.
        groups: Known parameter groups of J1939 that are sent, with their senders.
    """

    devices: tuple[CanOpenDevice, ...]
    silent: tuple[int, ...]
    unconfigured: tuple[int, ...] | None
    claims: tuple[AddressClaim, ...]
    groups: tuple[GroupMessage, ...]
    traffic: tuple[Traffic, ...]


class _DeviceObjects:
    """The objects of a device on the bus."""

    def __init__(self, network: CanOpenNetwork, node_id: int) -> None:
        self._network = network
        self._node_id = node_id
        self._objects: dict[tuple[int, int], bytes | None] = {}
        self.unanswered: list[str] = []
        """Objects for which the device gave no answer."""

    def read(self, index: int, subindex: int = 0) -> bytes | None:
        """Content of an object; None where the device does not answer, which is recorded.

        Raises:
            BusError: The device answers no request.
        """
        key = index, subindex
        if key not in self._objects:
            try:
                self._objects[key] = self._network.read(self._node_id, index, subindex)
            except BusError:
                self._objects[key] = None
                self.unanswered.append(f"{index:04X}h.{subindex}")
                if index == _DEVICE_TYPE or len(self.unanswered) > _MOST_UNANSWERED:
                    raise
        return self._objects[key]

    def is_signed(self, index: int, subindex: int) -> bool | None:
        """None: a device does not report it."""
        del index, subindex


def scan(network: CanOpenNetwork, listen_s: float, *, progress: Progress) -> BusSurvey:
    """Survey of a bus; where the network only listens, no request is sent.

    Listening before the first request for longer than the slowest heartbeat, `listen_s`, finds all
    devices that send one.

    Raises:
        BusError: The bus fails.
    """
    progress("listening", 0.0)
    network.listen(listen_s)
    traffic = traffic_by_id(network.received)
    unconfigured = None
    if not network.listens_only:
        progress("requesting the device type of every node id", 0.2)
        network.search()
        network.listen(_ANSWERS_WITHIN_S)
        if any(frame.is_extended for frame in network.received):
            network.ask_for_addresses()
            network.listen(_CLAIMS_WITHIN_S)
        progress("searching for a device without a node id", 0.4)
        unconfigured = network.find_unconfigured()
    frames = list(network.received)
    nodes = _nodes(frames)
    devices: list[CanOpenDevice] = []
    for index, node_id in enumerate(nodes if not network.listens_only else ()):
        progress(f"reading node {node_id}", 0.5 + 0.5 * index / len(nodes))
        objects = _DeviceObjects(network, node_id)
        try:
            device = describe_device(objects, node_id)
        except BusError:
            continue  # it is listed as silent
        if device is not None:
            notes = [f"object {name}: no answer, taken as absent" for name in objects.unanswered]
            device = replace(device, notes=(*device.notes, *notes))
            devices.append(_with_cycles(device, traffic))
    progress("done", 1.0)
    described_ids = [device.node_id for device in devices]
    return BusSurvey(
        tuple(devices),
        tuple(node_id for node_id in nodes if node_id not in described_ids),
        None if unconfigured is None else tuple(unconfigured),
        address_claims(frames),
        group_messages(frames),
        traffic,
    )


def survey_of_files(files: Mapping[int, Path]) -> BusSurvey:
    """Survey of devices that are not on a bus, by the EDS or DCF file of each node id.

    Raises:
        InputError: A file cannot be read, or is no EDS file.
    """
    devices: list[CanOpenDevice] = []
    for node_id, path in files.items():
        device = describe_device(EdsObjects(path, node_id), node_id)
        if device is None:
            raise InputError(f"{path}: its device type (1000h) has no value")
        devices.append(device)
    return BusSurvey(tuple(devices), (), None, (), (), ())


def _nodes(frames: Sequence[Frame]) -> list[int]:
    """Node ids that answered or sent a heartbeat."""
    nodes = {
        frame.arbitration_id & 0x7F
        for frame in frames
        if not frame.is_extended
        and (
            frame.arbitration_id in _ANSWERS
            or (frame.arbitration_id in _HEARTBEATS and len(frame.data) == 1)
        )
    }
    return sorted(nodes)


def traffic_by_id(frames: Sequence[Frame]) -> tuple[Traffic, ...]:
    """Number, length and interval of the frames of each id."""
    by_id: dict[tuple[bool, int], list[Frame]] = {}
    for frame in list(frames):
        by_id.setdefault((frame.is_extended, frame.arbitration_id), []).append(frame)
    return tuple(
        Traffic(arbitration_id, is_extended, len(same), len(same[-1].data), _interval_s(same))
        for (is_extended, arbitration_id), same in sorted(by_id.items())
    )


def _interval_s(frames: Sequence[Frame]) -> float | None:
    if len(frames) < _FEWEST:
        return None
    times = [frame.t_ns for frame in frames]
    return median(after - before for before, after in pairwise(times)) * 1e-9


def _with_cycles(device: CanOpenDevice, traffic: Sequence[Traffic]) -> CanOpenDevice:
    """The device, with measured cycles where it reports none."""
    intervals = {(item.arbitration_id, item.is_extended): item.interval_s for item in traffic}
    pdos = tuple(
        replace(pdo, cycle_s=pdo.cycle_s or intervals.get((pdo.arbitration_id, pdo.is_extended)))
        for pdo in device.pdos
    )
    return replace(device, pdos=pdos)
