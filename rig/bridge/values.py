"""What a step is given and what it publishes."""

from collections.abc import Sequence
from enum import Enum, IntEnum
from math import nan

from msgspec import Struct

from rig.channels.channel import Sample


class Mode(IntEnum):
    """State of the bridge, with the numbers it has on the bus.

    WAITING has no model yet, SETTLING one whose estimate is not to be believed yet, READY one that
    is not armed, or whose published force is still fading in. RUNNING alone publishes valid
    estimates. HOLD goes without fresh measurements, or is beyond a limit; SAFE has stopped the
    model until the user acknowledges.
    """

    INIT = 0
    WAITING = 1
    RUNNING = 2
    HOLD = 3
    SAFE = 4
    SETTLING = 5
    READY = 6


class Request(Enum):
    """What an operator requests of the bridge.

    ACKNOWLEDGE leaves the safe state, ARM lets estimates become valid, DISARM takes that back.
    """

    ACKNOWLEDGE = "acknowledge"
    ARM = "arm"
    DISARM = "disarm"


class StepInput(Struct, frozen=True, gc=False):
    """All that one step is given.

    Attributes:
        t_ns: Time of the step.
        samples: Samples that arrived since the last one, in the order of their arrival; at most one
            of each reference height.
        request: What an operator requests at this step; None for nothing.
    """

    t_ns: int
    samples: tuple[Sample, ...] = ()
    request: Request | None = None


class StrutOutput(Struct, frozen=True, gc=False):
    """What a tick publishes of one strut; each attribute is a column of the log.

    Attributes:
        force_n: Estimated strut force: the model's plus the estimated residual force.
        virtual_force_n: Virtual force.
        valid: Whether the estimate rests on fresh measurements and has settled.
        height_m: Model height.
        velocity_m_per_s: Model velocity.
        acceleration_m_per_s2: Model acceleration.
        innovation_m: Innovation.
        force_std_n: Standard deviation of the estimated force; NaN where it is not known.
        law_force_n: Force of the model's law alone, part of the estimated force.
    """

    force_n: float
    virtual_force_n: float
    valid: bool
    height_m: float
    velocity_m_per_s: float
    acceleration_m_per_s2: float
    innovation_m: float
    force_std_n: float = nan
    law_force_n: float = nan


class StepOutput(Struct, frozen=True, gc=False):
    """What a tick publishes: of each strut in the model's order, nothing before measurements.

    Attributes:
        sensors: Of each virtual sensor its value, followed by its standard deviation where it has
            one; empty where no model moves.
        left_out: Channels of further sensors that are not used now.
        first_cause: Number of the cause of the first HOLD or SAFE since the estimate was last
            valid; 0 if there was none since then.
    """

    mode: Mode
    struts: tuple[StrutOutput, ...]
    left_out: tuple[int, ...] = ()
    first_cause: int = 0
    sensors: Sequence[float] = ()


class Divergence(Struct, frozen=True, gc=False):
    """A model whose numbers no bench has: the first strut that shows it, and when it showed."""

    strut: int
    t_ns: int
