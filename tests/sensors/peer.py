"""CANopen devices on a stack of its own (durand), which shares nothing with what reads them."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from durand import Array, CANBusNetwork, DatatypeEnum, MinimalNode, Record, Variable, set_scheduler
from durand.scheduler import SyncScheduler

U8, U16, U32 = DatatypeEnum.UNSIGNED8, DatatypeEnum.UNSIGNED16, DatatypeEnum.UNSIGNED32
I16, I32, REAL = DatatypeEnum.INTEGER16, DatatypeEnum.INTEGER32, DatatypeEnum.REAL32
NEWTON, KILONEWTON, CELSIUS = 0x00210000, 0x03210000, 0x002D0000


@contextmanager
def scheduled() -> Iterator[SyncScheduler]:
    """What durand's timers need: a scheduler that runs in a thread."""
    scheduler = SyncScheduler()
    set_scheduler(scheduler)
    thread = threading.Thread(target=scheduler.run, daemon=True)
    thread.start()
    try:
        yield scheduler
    finally:
        scheduler.stop()


def encoder(network: CANBusNetwork, node_id: int, *, step_nm: int = 5000, cycle_ms: int = 10):
    """A linear encoder after CiA 406: position and alarms in one PDO."""
    node = MinimalNode(network, node_id)
    objects = node.object_dictionary
    objects.write(0x1000, 0, 0x00080196)
    objects.write(0x1008, 0, b"Linear encoder")
    for place, value in enumerate((0x1A2, 7, 0x10002, 4711), 1):
        objects.write(0x1018, place, value)
    objects[0x6004] = Variable(I32, "ro", 0)
    objects[0x6005] = _record((U32, step_nm), (U32, 100))
    objects[0x6030] = _array(I16, 0)
    objects[0x6200] = Variable(U16, "rw", cycle_ms)
    objects[0x6503] = Variable(U16, "ro", 0)
    node.tpdo[0].mapping = [(0x6004, 0), (0x6503, 0)]
    node.tpdo[0].transmission_type = 254
    for place in (1, 2, 3):
        node.tpdo[place].enable = False
    return node


def amplifier(network: CANBusNetwork, node_id: int, *, unit: int = NEWTON, digits: int = 1):
    """An amplifier of a load cell after CiA 404: force and its status in one PDO."""
    node = MinimalNode(network, node_id)
    objects = node.object_dictionary
    objects.write(0x1000, 0, 0x00020194)
    objects.write(0x1008, 0, b"Load cell [kN]")
    objects[0x9130] = _array(I32, 0)
    objects[0x6131] = _array(U32, unit)
    objects[0x6132] = _array(U8, digits)
    objects[0x6150] = _array(U8, 0)
    node.tpdo[0].mapping = [(0x9130, 1), (0x6150, 1)]
    node.tpdo[0].transmission_type = 254
    for place in (1, 2, 3):
        node.tpdo[place].enable = False
    return node


def _array(kind: DatatypeEnum, value: float) -> Array:
    return Array(Variable(kind, "rw", value), length=1)


def _record(*entries: tuple[DatatypeEnum, int]) -> Record:
    record = Record()
    for place, (kind, value) in enumerate(entries, 1):
        record[place] = Variable(kind, "rw", value)
    return record


def with_timer(node, cycle_ms: int) -> None:
    """An event timer (1800h.5), which durand leaves out, in the first PDO's record."""
    node.object_dictionary[0x1800][5] = Variable(U16, "rw", cycle_ms)


def send(node) -> None:
    """Send the first PDO now, if the device is operational."""
    if node.tpdo[0]._cache is not None:
        node.tpdo[0].transmit()
