"""Every quantity that a bench may send, each declared here and nowhere else.

A quantity of the table can be named under `signals` of a configuration; it reaches the step, the
log, its replay and its exports under its own name.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from can_dbc.units import Dimension
from dart_model.spec import ForceInput, MotionInput, TorqueInput


@dataclass(frozen=True)
class SensorNoise:
    """How a configuration states the standard deviation of a sensor's readings; bounds are SI."""

    key: str
    low: float
    high: float


@dataclass(frozen=True)
class Quantity:
    """A measured quantity.

    Attributes:
        key: Its key under `signals`; of a further sensor of a strut, what it `measures`.
        words: Its meaning and its sign, for the guide.
        noise: Noise of a sensor that measures it on a strut; None for a quantity of the bench.
    """

    key: str
    column: str
    dimension: Dimension
    words: str
    noise: SensorNoise | None = None


HEIGHT = Quantity(
    "height",
    "height_m",
    Dimension.LENGTH,
    "height of a strut",
    SensorNoise("noise_std_m", 1e-9, 1.0),
)
"""Height of a strut; the one under `signals.height` is the reference of its observer."""

VELOCITY = Quantity(
    "velocity",
    "velocity_m_per_s",
    Dimension.VELOCITY,
    "velocity of the height, positive in rebound",
    SensorNoise("noise_std_m_per_s", 1e-7, 100.0),
)
FORCE = Quantity(
    "force",
    "force_n",
    Dimension.FORCE,
    "force of a load cell in the strut, positive when the strut pushes its ends apart",
    SensorNoise("noise_std_n", 1e-4, 1e7),
)

STRUT_QUANTITIES: Mapping[str, Quantity] = MappingProxyType(
    {quantity.key: quantity for quantity in (HEIGHT, VELOCITY, FORCE)}
)
"""What a sensor of a strut may measure, by key. `rig.observers.strut_sensors` defines the
reading of each on the model."""

APPLIED_FORCE = Quantity(
    "applied_force",
    "applied_force_n",
    Dimension.FORCE,
    "force that the actuator applies to the body, positive upwards, without the weight",
)
APPLIED_TORQUE = Quantity(
    "applied_torque",
    "applied_torque_n_m",
    Dimension.TORQUE,
    "torque that the actuator applies to the joint, positive about the joint's axis",
)
MOTION = Quantity("motion", "motion_m", Dimension.LENGTH, "position of a body that is moved")
ACCELERATION = Quantity(
    "acceleration",
    "acceleration_m_per_s2",
    Dimension.ACCELERATION,
    "acceleration of a body that is moved",
)
INPUT_QUANTITIES = (APPLIED_FORCE, APPLIED_TORQUE, MOTION, ACCELERATION)
"""What may be measured of the inputs of a model, by name."""


def quantity_of(item: ForceInput | TorqueInput | MotionInput) -> Quantity:
    """What is measured of an input of a model."""
    match item:
        case ForceInput():
            return APPLIED_FORCE
        case TorqueInput():
            return APPLIED_TORQUE
        case MotionInput():
            return MOTION


LOAD_CELL_FORCE = Quantity(
    "load_cell_force",
    "strut_force_n",
    Dimension.FORCE,
    "force of the strut, measured by a load cell, positive when the strut pushes its ends apart",
)
TEMPERATURE = Quantity(
    "temperature", "temperature_c", Dimension.TEMPERATURE, "temperature of the damper"
)
INTERLOCK = Quantity(
    "interlock",
    "interlock",
    Dimension.NUMBER,
    "interlock of the bench: 0 while it is open, any other value while it is closed",
)
ENABLE = Quantity(
    "enable",
    "enable",
    Dimension.NUMBER,
    "enable signal of the bench's controller: an estimate can be valid only while it is not 0",
)
SWITCHES = (INTERLOCK, ENABLE)
"""What permits valid estimates, or forbids them; `rig.bridge.arming` uses them."""

BENCH_QUANTITIES = (APPLIED_FORCE, LOAD_CELL_FORCE, TEMPERATURE, *SWITCHES)
"""What a bench sends once, and not for each strut, in the order of the log's columns."""
