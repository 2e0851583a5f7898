"""The bridge that a configuration describes, put together from its parts."""

from dart_model.plant import DartPlant
from dart_model.spec import ModelSpec
from rig.core.bridge import Bridge
from rig.core.dyno import DynoCore
from rig.core.messages import (
    Outgoing,
    Quantity,
    Target,
    estimate,
    incoming,
    kinematics,
    status,
    timing,
)
from rig.core.step import RigCore
from rig.core.types import Core
from rig.operation.setup import Setup


def build_bridge(ready: Setup, model: ModelSpec | None = None) -> Bridge:
    """The bridge that a configuration describes.

    Args:
        ready: Configuration, model and DBC.
        model: Another model with the same struts, e.g. a corrected one.

    Raises:
        InputError: The model cannot be built.
        DatabaseError: A signal does not fit what it is for.
    """
    config, database = ready.config, ready.database
    targets: dict[str, list[Target]] = {}
    for index, entry in enumerate(config.signals.height.values()):
        target = Target(entry.signal, Quantity.HEIGHT, index)
        targets.setdefault(entry.message, []).append(target)
    for quantity, entry in (
        (Quantity.APPLIED_FORCE, config.signals.applied_force),
        (Quantity.LOAD_CELL_FORCE, config.signals.load_cell_force),
        (Quantity.TEMPERATURE, config.signals.temperature),
    ):
        if entry is not None:
            targets.setdefault(entry.message, []).append(Target(entry.signal, quantity, 0))
    outgoing: list[Outgoing] = []
    for index, entry in enumerate(config.publish.values()):
        outgoing.append(estimate(database.message(entry.estimate), index))
        if entry.kinematics is not None:
            outgoing.append(kinematics(database.message(entry.kinematics), index))
    if config.status is not None:
        outgoing.append(status(database.message(config.status)))
    if config.timing is not None:
        outgoing.append(timing(database.message(config.timing)))
    gains = tuple(observer.gains() for observer in config.observers.values())
    supervision = config.supervision.supervision()
    plant = DartPlant(model or ready.model)
    core: Core
    if config.imposed_motion is None:
        core = RigCore(plant, gains, supervision)
    else:
        core = DynoCore(plant, config.imposed_motion.settling_s, supervision)
    received = [incoming(database.message(name), found) for name, found in targets.items()]
    return Bridge(core, received, outgoing, supervision.limits)
