"""A channel: a quantity of the bench from its signal on the bus to its column in the log."""

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, ClassVar

from msgspec import Struct
from pydantic import BaseModel, ConfigDict, Field

from can_dbc.calibration import Calibration
from can_dbc.codec import si_step
from can_dbc.database import Message
from can_dbc.yaml_file import Finite
from rig.channels.measured_quantities import Quantity


class SignalName(BaseModel):
    """Where a value stands on the bus.

    Attributes:
        message: Message of the DBC.
        signal: Signal of the message; its unit is converted.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    message: Annotated[str, Field(min_length=1, max_length=255)]
    signal: Annotated[str, Field(min_length=1, max_length=255)]


SignalOfMessage = Annotated[str, Field(min_length=1, max_length=255)]
"""Name of a signal of the message that a value stands in."""


class ValidSignal(BaseModel):
    """A signal that shows whether a measured value is valid.

    Attributes:
        signal: Signal of the same message, an integer or a float without a unit.
        value: Value of this signal while the measured one is valid.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    signal: SignalOfMessage
    value: Finite = 1.0


class Zero(BaseModel):
    """A reading of a position sensor at a known length of the strut; `rig zero` measures it.

    Attributes:
        reads: Reading of the sensor in m, after the conversion by gain and unit (in a
            configuration: by the DBC).
        at_m: Length of the strut at that reading, in m.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    reads: Finite
    at_m: Finite


class MeasuredSignal(SignalName):
    """Where a measured value stands on the bus, how its sensor is mounted, and when it is valid.

    Attributes:
        message: Message of the DBC.
        signal: Signal of the message; its unit is converted.
        valid: Signal of the same message that shows whether the measured value is valid; a frame in
            which this signal does not have `valid.value` is refused. If absent, every value is
            used.
        counter: Signal of the same message that rises by one with every frame, for a message
            without E2E protection. It shows frames that are lost, repeated or out of sequence. If
            the DBC contains the message's cycle time, the times of the samples follow from the
            counter. If absent, lost frames are not counted.
        time: Signal of the same message with the sensor's time of the sample; it may restart at the
            end of its range. If absent, this time follows from the message's counter, or else from
            the arrival of the frame.
        zero: A reading at a known length of the strut; if absent, the reading is the length.
        reversed: True if the reading falls while the quantity grows; only for a force.
        tare_n: Only for a force: reading without a force, in N after the scaling by the DBC and
            before a reversal; 0 if absent.
    """

    refused_keys: ClassVar[frozenset[str]] = frozenset({"zero"})
    """Keys that the plan refuses here, and that the guide therefore leaves out: those of a sensor
    of another dimension. This class itself stands for the quantities of the bench."""

    valid: ValidSignal | None = None
    counter: SignalOfMessage | None = None
    time: SignalOfMessage | None = None
    zero: Zero | None = None
    reversed: bool = False
    tare_n: Finite | None = None

    @property
    def calibration(self) -> Calibration:
        """From what the sensor reads to what is measured, in SI."""
        if self.zero is not None:
            return Calibration(self.zero.reads, self.zero.at_m, self.reversed)
        return Calibration(self.tare_n or 0.0, 0.0, self.reversed)


class Role(Enum):
    """What a step does with a channel's samples.

    HEIGHT is the reference height of a strut, SENSOR a further sensor of a strut, INPUT drives the
    model, and BENCH is any other quantity, of which the bench has one.
    """

    HEIGHT = "height"
    SENSOR = "sensor"
    INPUT = "input"
    BENCH = "bench"


@dataclass(frozen=True, slots=True)
class Channel:
    """A quantity of the bench wherever it stands.

    Attributes:
        index: Position among the channels of the plan.
        name: Its name in messages to the user, and in the log what stands before the dot of its
            columns: a strut, or a strut and a sensor; of a quantity of the bench its key; of an
            input its name, with a dot and what is measured in addition to it.
        strut: Index of the strut that it is of; -1 for any other.
        delay_ns: How much later a sample arrives than it is true.
        noise_std: Standard deviation of a sample in SI, quantisation included; of a further sensor.
        message: Message that carries it; None for a channel that is on no bus.
        valid: What says that it is valid; None where nothing does.
        counter: Signal that counts its message's frames; empty where the message is protected, or
            nothing counts them.
        time: Signal with the sensor's time of a sample; empty where there is none.
    """

    index: int
    role: Role
    quantity: Quantity
    name: str
    key: str
    strut: int
    interval_ns: int
    delay_ns: int = 0
    noise_std: float = 0.0
    message: Message | None = None
    signal: str = ""
    valid: ValidSignal | None = None
    counter: str = ""
    time: str = ""

    @property
    def column(self) -> str:
        """Its column in the log."""
        if self.role is Role.INPUT and self.name != self.quantity.key:
            return f"{self.quantity.column}:{self.name.partition('.')[0]}"
        if self.role in (Role.BENCH, Role.INPUT):
            return self.quantity.column
        return f"{self.name}.measured_{self.quantity.column}"

    @property
    def has_cycle(self) -> bool:
        """Whether it is known how often it is measured."""
        return self.message is None or self.message.cycle_time_ns is not None

    @property
    def step(self) -> float:
        """Step of its values in SI; 0 where it is on no bus."""
        if self.message is None or not self.signal:
            return 0.0
        return si_step(self.message, self.signal, self.quantity.dimension)


class Sample(Struct, frozen=True, gc=False):
    """A value that a channel delivered; it was true at `t_ns`, the delay before its arrival."""

    channel: int
    value: float
    t_ns: int
