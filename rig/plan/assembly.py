"""The bridge that a configuration describes, put together from its parts."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from can_dbc.errors import InputError
from dart_model.plant import DartPlant, PrescribedStrut
from dart_model.spec import ModelSpec
from rig.bridge.bridge import Bridge
from rig.bridge.contract import Core, Measures, Plant, Sensor
from rig.bridge.devices import Device
from rig.bridge.free_model import Arrival, RigCore
from rig.bridge.messages import (
    STATUS,
    STRUT,
    TIMING,
    Incoming,
    Outgoing,
    Published,
    Wanted,
    incoming,
    outgoing,
)
from rig.bridge.prescribed_motion import PrescribedCore
from rig.plan.quantities import ALARM, FURTHER, HEIGHT, LOAD_CELL_FORCE
from rig.plan.setup import Setup

ENGINES: Mapping[str, Callable[[ModelSpec], Plant]] = MappingProxyType({"dart": DartPlant})
"""`engine` in a configuration -> what makes a plant of a model. A further one is a line here."""


def build_bridge(ready: Setup, model: ModelSpec | None = None, *, sending: bool = True) -> Bridge:
    """The bridge that a configuration describes.

    Args:
        ready: Configuration, model and DBC.
        model: Another model with the same struts, e.g. a corrected one.
        sending: Whether it makes frames to send; what it computes is the same without.

    Raises:
        InputError: The model cannot be built.
        DatabaseError: A signal does not fit what it is for.
    """
    outgoing = _outgoing(ready) if sending else ()
    limits = ready.config.supervision.supervision().limits
    core, devices = _core(ready, model or ready.model), build_devices(ready)
    return Bridge(core, _incoming(ready), outgoing, limits, devices)


def build_plant(ready: Setup, model: ModelSpec | None = None) -> Plant:
    """The model that runs beside the bench, in the configuration's engine.

    Raises:
        InputError: There is no such engine, or the model cannot be built.
    """
    make = ENGINES.get(ready.config.engine)
    if make is None:
        raise InputError(
            f"{ready.source}: engine {ready.config.engine!r}: expected one of {', '.join(ENGINES)}"
        )
    return make(model or ready.model)


def _core(ready: Setup, model: ModelSpec) -> Core:
    config = ready.config
    supervision = config.supervision.supervision()
    if config.prescribed_motion is not None:
        settling_s = config.prescribed_motion.settling_s
        return PrescribedCore(PrescribedStrut(model), settling_s, supervision)
    observers = tuple(config.observers.values())
    return RigCore(
        build_plant(ready, model), observers, supervision, arrivals(ready), sensors(ready)
    )


def build_devices(ready: Setup) -> tuple[Device, ...]:
    """Devices that say how they are; the estimate rests on those that send a height."""
    config = ready.config
    vital = [entry.message for entry in config.signals.height.values()]
    if config.prescribed_motion is not None:
        vital.append(config.signals.others[LOAD_CELL_FORCE].message)
    senders = {ready.database.message(name).sender for name in vital}
    return tuple(
        entry.device(name, is_vital=name in senders) for name, entry in config.devices.items()
    )


def arrivals(ready: Setup) -> tuple[Arrival, ...]:
    """How the measurements of each strut come: at their message's cycle, or one at each tick."""
    found: list[Arrival] = []
    for name in ready.config.observers:
        entry = ready.config.signals.height.get(name)
        if entry is None:
            found.append(Arrival(ready.config.period_ns))
            continue
        cycle_ns = ready.database.message(entry.message).cycle_time_ns or ready.config.period_ns
        found.append(Arrival(cycle_ns, entry.delay_ns))
    return tuple(found)


def sensors(ready: Setup) -> tuple[Sensor, ...]:
    """Further sensors, at their messages' cycles."""
    struts = list(ready.config.observers)
    found: list[Sensor] = []
    for name, strut, entry in ready.config.signals.sensors():
        cycle_ns = ready.database.message(entry.message).cycle_time_ns or ready.config.period_ns
        sensor = Sensor(
            name,
            struts.index(strut),
            Measures(entry.measures),
            entry.noise_std,
            cycle_ns,
            entry.delay_ns,
        )
        found.append(sensor)
    return tuple(found)


def _incoming(ready: Setup) -> list[Incoming]:
    signals = ready.config.signals
    wanted: dict[str, list[Wanted]] = {}
    struts = list(ready.config.observers)
    for name, entry in signals.height.items():
        index = struts.index(name)
        wanted.setdefault(entry.message, []).append(
            Wanted(entry.signal, HEIGHT, index, entry.delay_ns)
        )
    for quantity, entry in signals.others.items():
        wanted.setdefault(entry.message, []).append(Wanted(entry.signal, quantity))
    for place, (_, _, entry) in enumerate(signals.sensors()):
        wanted.setdefault(entry.message, []).append(
            Wanted(entry.signal, FURTHER[entry.measures], 0, entry.delay_ns, place)
        )
    devices = list(ready.config.devices)
    for place, entry in enumerate(ready.config.devices.values()):
        for number, alarm in enumerate(entry.alarms):
            wanted.setdefault(alarm.message, []).append(
                Wanted(alarm.signal, ALARM, alarm=(place, number))
            )
    messages = {name: ready.database.message(name) for name in wanted}
    return [
        incoming(
            messages[name],
            found,
            devices.index(sender) if (sender := messages[name].sender) in devices else None,
        )
        for name, found in wanted.items()
    ]


def _outgoing(ready: Setup) -> list[Outgoing]:
    config = ready.config
    publications = {item.key: item for item in STRUT}
    published: dict[str, list[Published]] = {}
    for strut, name in enumerate(config.observers):
        for key, entry in (config.publish or {}).get(name, {}).items():
            carried = Published(entry.signal, publications[key], strut)
            published.setdefault(entry.message, []).append(carried)
    for group, choices in ((config.status, STATUS), (config.timing, TIMING)):
        publications = {item.key: item for item in choices}
        for key, entry in (group or {}).items():
            carried = Published(entry.signal, publications[key])
            published.setdefault(entry.message, []).append(carried)
    return [outgoing(ready.database.message(name), found) for name, found in published.items()]
