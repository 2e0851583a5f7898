"""What goes into a step, what comes out, and the state in between."""

from enum import IntEnum
from typing import Protocol

from msgspec import Struct

from dart_model.plant import Loaded


class Mode(IntEnum):
    """State of the bridge, with the numbers it has on the bus."""

    INIT = 0
    WAITING = 1
    RUNNING = 2
    HOLD = 3
    SAFE = 4
    STOPPED = 5


class Measurement(Struct, frozen=True, gc=False):
    """A height that arrived.

    Attributes:
        height_m: Measured strut height.
        t_ns: Time at which it was true.
    """

    height_m: float
    t_ns: int


class StepInput(Struct, frozen=True, gc=False):
    """All that one tick is given.

    Attributes:
        t_ns: Time of the tick.
        heights: New measurement of each observed strut, None where no frame came.
        applied_force_n: New applied force, None where no frame came.
        temperature_c: New damper temperature, None where no frame came.
        acknowledged: Somebody acknowledged the safe state.
        load_cell_force_n: New load-cell force, None where no frame came.
    """

    t_ns: int
    heights: tuple[Measurement | None, ...]
    applied_force_n: float | None = None
    temperature_c: float | None = None
    acknowledged: bool = False
    load_cell_force_n: float | None = None


class ObserverState(Struct, frozen=True, gc=False):
    """Memory of one observer.

    Attributes:
        integral_m_s: Integral of the innovation.
        innovation_m: Last innovation: measured less model height.
        virtual_force_n: Virtual force, held until the next measurement.
        measured_ns: Time of the last measurement.
    """

    integral_m_s: float
    innovation_m: float
    virtual_force_n: float
    measured_ns: int


class RigState(Struct, frozen=True, gc=False):
    """State between two ticks; a run can be restarted from any.

    Attributes:
        t_ns: Time of the last tick.
        mode: State of the bridge.
        observers: One a strut; empty before the first measurements.
        first: Measurements that came before every strut had one.
        model: The model under its forces; None before the first measurements.
        temperature_c: Last damper temperature.
        last_valid: What was last published as valid; empty before.
    """

    t_ns: int
    mode: Mode
    observers: tuple[ObserverState, ...]
    first: tuple[Measurement | None, ...]
    model: Loaded | None
    temperature_c: float
    last_valid: tuple["StrutOutput", ...]


class StrutOutput(Struct, frozen=True, gc=False):
    """What a tick says of one strut.

    Attributes:
        force_n: Estimated spring-damper force, virtual force included.
        virtual_force_n: Virtual force.
        valid: Whether the estimate rests on a fresh measurement.
        height_m: Model height.
        velocity_m_per_s: Model velocity.
        acceleration_m_per_s2: Model acceleration.
        innovation_m: Innovation.
    """

    force_n: float
    virtual_force_n: float
    valid: bool
    height_m: float
    velocity_m_per_s: float
    acceleration_m_per_s2: float
    innovation_m: float


class StepOutput(Struct, frozen=True, gc=False):
    """What a tick publishes.

    Attributes:
        mode: State of the bridge.
        struts: One a strut, in the model's order; empty before the first measurements.
    """

    mode: Mode
    struts: tuple[StrutOutput, ...]


class Core(Protocol):
    """The arithmetic of a bridge: values in, values out."""

    @property
    def struts(self) -> int:
        """Number of struts."""
        ...

    def init(self, t_ns: int) -> RigState:
        """State before the first tick."""
        ...

    def step(self, state: RigState, step_input: StepInput) -> tuple[RigState, StepOutput]:
        """State after a tick, and what it publishes."""
        ...
