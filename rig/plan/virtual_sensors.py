"""Virtual sensors of a plan: what each reads, its column in the log, and its signal on the bus."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from can_dbc.errors import InputError, expected_name
from dart_model.errors import ModelError
from dart_model.plant.virtual_sensors import turning_joints
from dart_model.protocol import AnySensorReader
from dart_model.spec import ModelSpec
from dart_model.virtual_sensors import KINDS, SensedQuantity, VirtualSensor
from rig.bridge.counts import Report
from rig.bridge.published_quantities import Publication
from rig.bridge.virtual_sensors import SensorPlace


@dataclass(frozen=True)
class PlannedSensor:
    """A virtual sensor of a run.

    Attributes:
        strut: Index of the strut that it is of; -1 for a body or joint.
    """

    name: str
    sensor: VirtualSensor
    quantity: SensedQuantity
    strut: int

    @property
    def place(self) -> SensorPlace:
        """What it reads, for the bridge."""
        return SensorPlace(self.sensor.kind, self.strut, self.quantity.known_by)

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns in the log of its value, and of the standard deviation where there is one."""
        column = f"{self.name}.{self.quantity.suffix}"
        if not self.quantity.known_by:
            return (column,)
        stem, _, unit = self.quantity.suffix.partition("_")
        return column, f"{self.name}.{stem}_std_{unit}"


def resolve_sensors(
    sensors: Mapping[str, VirtualSensor],
    model: ModelSpec,
    taken: Iterable[str],
    source: Path,
    *,
    is_prescribed: bool,
) -> tuple[PlannedSensor, ...]:
    """The virtual sensors of a configuration, in its order.

    `taken` are the names of struts and inputs, which no sensor may have.

    Raises:
        InputError: A sensor has a name that is taken, or reads what the bench does not have.
        ModelError: The skeleton cannot be built.
    """
    struts, names = [strut.name for strut in model.struts], list(taken)
    turning: frozenset[str] = frozenset()
    if any(item.kind in ("coordinate_of", "speed_of") for item in sensors.values()):
        turning = turning_joints(model)
    planned: list[PlannedSensor] = []
    for name, item in sensors.items():
        where = f"{source}: virtual_sensors.{name}"
        if name in names:
            raise InputError(f"{where}: is the name of a strut or input, expected another one")
        strut = -1
        if KINDS[item.kind].of == "strut":
            if item.target not in struts:
                raise InputError(
                    f"{where}.{item.kind} {item.target!r}: {expected_name(item.target, struts)}"
                )
            strut = struts.index(item.target)
        elif is_prescribed:
            raise InputError(
                f"{where}.{item.kind}: with prescribed_motion no body moves, expected "
                f"{', '.join(kind for kind, it in KINDS.items() if it.of == 'strut')}"
            )
        quantity = item.quantity(is_turning=item.target in turning)
        planned.append(PlannedSensor(name, item, quantity, strut))
    return tuple(planned)


def make_reader(
    make: Callable[[Mapping[str, VirtualSensor]], AnySensorReader],
    sensors: Mapping[str, VirtualSensor],
    source: Path,
) -> AnySensorReader:
    """What reads sensors of bodies and joints.

    Raises:
        InputError: The model has not what one reads.
    """
    try:
        return make(sensors)
    except ModelError as error:
        raise InputError(f"{source}: {error}") from None


def publication_of(sensor: PlannedSensor) -> Publication:
    """How a virtual sensor is published; zero where no model moves."""

    def value(report: Report, column: int) -> float:
        shown = report.output.sensors
        return shown[column] if shown else 0.0

    return Publication(sensor.name, sensor.quantity.dimension, value, "", sensor.quantity.meaning)
