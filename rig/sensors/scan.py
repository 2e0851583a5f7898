"""What is on a bus: CANopen devices by their own word, J1939 devices by their claims, other frames.

A device is asked only what reading it tells; nothing of it is changed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median

from can_dbc.frame import Frame
from rig.bus.bus import BusError
from rig.bus.canopen_network import CanOpenNetwork
from rig.sensors.canopen_description import Device, described
from rig.sensors.j1939 import Claim, Spoken, claims, spoken

_ANSWERS, _HEARTBEATS = range(0x581, 0x600), range(0x701, 0x780)
_ANSWERS_WITHIN_S, _CLAIMS_WITHIN_S = 0.5, 0.5
"""A device answers an SDO within some ms; a J1939 address is claimed within 0.25 s."""

_DEVICE_TYPE, _MOST_MUTE = 0x1000, 3
_FEWEST = 4
"""Frames of which an interval can be told."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Traffic:
    """Frames of one id that were heard.

    Attributes:
        arbitration_id: The id.
        is_extended: Whether it has 29 bits.
        count: How many.
        length_bytes: Length of the last one's payload.
        interval_s: Median time between two; None where there were too few.
    """

    arbitration_id: int
    is_extended: bool
    count: int
    length_bytes: int
    interval_s: float | None


@dataclass(frozen=True)
class Found:
    """What is on a bus.

    Attributes:
        devices: CANopen devices that describe themselves, by node id.
        silent: Node ids that were heard and gave no description.
        unconfigured: Identity of a device without a node id; None if there is none.
        claims: J1939 devices that claim an address.
        spoken: Parameter groups of J1939 that are known and sent, with their senders.
        traffic: All that was heard, by id.
    """

    devices: tuple[Device, ...]
    silent: tuple[int, ...]
    unconfigured: tuple[int, ...] | None
    claims: tuple[Claim, ...]
    spoken: tuple[Spoken, ...]
    traffic: tuple[Traffic, ...]


class _Remote:
    """The objects of a device on the bus."""

    def __init__(self, network: CanOpenNetwork, node_id: int) -> None:
        self._network = network
        self._node_id = node_id
        self._known: dict[tuple[int, int], bytes | None] = {}
        self.mute: list[str] = []
        """Objects to which there was no answer."""

    def read(self, index: int, subindex: int = 0) -> bytes | None:
        """Content of an object; none where the device does not answer, which is noted.

        Raises:
            BusError: It does not answer at all.
        """
        key = index, subindex
        if key not in self._known:
            try:
                self._known[key] = self._network.read(self._node_id, index, subindex)
            except BusError:
                self._known[key] = None
                self.mute.append(f"{index:04X}h.{subindex}")
                if index == _DEVICE_TYPE or len(self.mute) > _MOST_MUTE:
                    raise
        return self._known[key]

    def is_signed(self, index: int, subindex: int) -> bool | None:
        """A device does not tell."""
        del index, subindex


def scan(network: CanOpenNetwork, listen_s: float, *, progress: Progress) -> Found:
    """What is on a bus.

    Args:
        network: The bus; where it only listens, no device is asked for anything.
        listen_s: How long to listen first; longer than the slowest heartbeat finds all that send
            one.
        progress: Told what is done, and which share of the whole is.

    Raises:
        BusError: The bus fails.
    """
    progress("listening", 0.0)
    network.listen(listen_s)
    traffic = heard(network.received)
    unconfigured = None
    if not network.listens_only:
        progress("asking every node id", 0.2)
        network.search()
        network.listen(_ANSWERS_WITHIN_S)
        if any(frame.is_extended for frame in network.received):
            network.ask_for_addresses()
            network.listen(_CLAIMS_WITHIN_S)
        progress("looking for a device without a node id", 0.4)
        unconfigured = network.find_unconfigured()
    frames = list(network.received)
    nodes = _nodes(frames)
    devices: list[Device] = []
    for place, node_id in enumerate(nodes if not network.listens_only else ()):
        progress(f"reading node {node_id}", 0.5 + 0.5 * place / len(nodes))
        remote = _Remote(network, node_id)
        try:
            device = described(remote, node_id)
        except BusError:
            device = None  # one that does not answer is listed as silent
        if device is not None:
            mute = tuple(f"object {name} is not answered: taken for none" for name in remote.mute)
            noted = replace(device, notes=(*device.notes, *mute))
            devices.append(_with_cycles(noted, traffic))
    progress("done", 1.0)
    described_ids = [device.node_id for device in devices]
    return Found(
        tuple(devices),
        tuple(node_id for node_id in nodes if node_id not in described_ids),
        None if unconfigured is None else tuple(unconfigured),
        claims(frames),
        spoken(frames),
        traffic,
    )


def _nodes(frames: Sequence[Frame]) -> list[int]:
    """Node ids of those that answered or sent a heartbeat."""
    found = {
        frame.arbitration_id & 0x7F
        for frame in frames
        if not frame.is_extended
        and (
            frame.arbitration_id in _ANSWERS
            or (frame.arbitration_id in _HEARTBEATS and len(frame.data) == 1)
        )
    }
    return sorted(found)


def heard(frames: Sequence[Frame]) -> tuple[Traffic, ...]:
    """What was heard, by id: how much, how long, how often."""
    by_id: dict[tuple[bool, int], list[Frame]] = {}
    for frame in list(frames):
        by_id.setdefault((frame.is_extended, frame.arbitration_id), []).append(frame)
    return tuple(
        Traffic(arbitration_id, is_extended, len(found), len(found[-1].data), _interval_s(found))
        for (is_extended, arbitration_id), found in sorted(by_id.items())
    )


def _interval_s(frames: Sequence[Frame]) -> float | None:
    if len(frames) < _FEWEST:
        return None
    times = [frame.t_ns for frame in frames]
    return median(after - before for before, after in pairwise(times)) * 1e-9


def _with_cycles(device: Device, traffic: Sequence[Traffic]) -> Device:
    """A device with the cycles that were heard where it tells none of its own."""
    intervals = {(item.arbitration_id, item.is_extended): item.interval_s for item in traffic}
    pdos = tuple(
        replace(pdo, cycle_s=pdo.cycle_s or intervals.get((pdo.arbitration_id, pdo.is_extended)))
        for pdo in device.pdos
    )
    return replace(device, pdos=pdos)
