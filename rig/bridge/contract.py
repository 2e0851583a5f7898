"""What a step is given and gives, and what its parts must be able to do."""

from collections.abc import Sequence
from enum import Enum, IntEnum
from math import nan
from typing import Any, Protocol

from msgspec import Struct

from rig.plan.quantities import APPLIED_FORCE, LOAD_CELL_FORCE, OTHERS, PLACES, TEMPERATURE


class Mode(IntEnum):
    """State of the bridge, with the numbers it has on the bus."""

    INIT = 0
    WAITING = 1
    RUNNING = 2
    HOLD = 3
    SAFE = 4


class Measurement(Struct, frozen=True, gc=False):
    """A height that arrived.

    Attributes:
        height_m: Measured strut height.
        t_ns: Time at which it was true.
        delay_ns: How much later it came, as far as that is known beforehand.
    """

    height_m: float
    t_ns: int
    delay_ns: int = 0


class Measures(Enum):
    """What a further sensor of a strut measures, in SI; a force is positive as a strut's."""

    HEIGHT = "height"
    VELOCITY = "velocity"
    FORCE = "force"


class Sensor(Struct, frozen=True, gc=False):
    """A sensor beside the height of a strut.

    Attributes:
        name: What it is called, after its strut's name and a dot.
        strut: Index of the strut.
        measures: What it measures.
        noise_std: Standard deviation of a reading in SI, quantisation included.
        interval_ns: Time between two readings.
        delay_ns: How much later one comes than it is true.
    """

    name: str
    strut: int
    measures: Measures
    noise_std: float
    interval_ns: int
    delay_ns: int = 0


class Reading(Struct, frozen=True, gc=False):
    """What a further sensor sent.

    Attributes:
        sensor: Place of the sensor among those of the core.
        value: Measured value in SI.
        t_ns: Time at which it was true.
    """

    sensor: int
    value: float
    t_ns: int


class Deviation(Struct, frozen=True, gc=False):
    """A reading held against the model.

    Attributes:
        sensor: Place of the sensor among those of the core.
        value: Measured value less the model's, both at the time of the reading, in SI; of a force
            that of the model's law.
        t_ns: That time.
    """

    sensor: int
    value: float
    t_ns: int


class Innovation(Struct, frozen=True, gc=False):
    """A measured height held against the model.

    Attributes:
        value_m: Measured less model height, both at the time of the measurement.
        t_ns: That time.
    """

    value_m: float
    t_ns: int


class Start(Struct, frozen=True, gc=False):
    """What an observer is given when the model starts.

    Attributes:
        t_ns: Time of the measurement that it starts with.
        mobility_per_kg: Acceleration of the strut's height per newton in the strut.
        interval_ns: Time between two measurements.
        delay_ns: How much later a measurement comes than it is true.
        stiffness_per_s2: By how much that acceleration falls per metre of height: of the model's
            own law, its stiffness over the effective mass.
        damping_per_s: The same per m/s.
        sensors: Further sensors of the strut, by their places among those of the core.
    """

    t_ns: int
    mobility_per_kg: float
    interval_ns: int
    delay_ns: int = 0
    stiffness_per_s2: float = 0.0
    damping_per_s: float = 0.0
    sensors: tuple[tuple[int, Sensor], ...] = ()


NO_OTHERS: tuple[float | None, ...] = (None,) * len(OTHERS)
_APPLIED, _LOAD_CELL, _TEMPERATURE = (
    PLACES[quantity] for quantity in (APPLIED_FORCE, LOAD_CELL_FORCE, TEMPERATURE)
)


class StepInput(Struct, frozen=True, gc=False):
    """All that one tick is given.

    Attributes:
        t_ns: Time of the tick.
        heights: New measurement of each observed strut, None where no frame came.
        others: New value of each of `OTHERS`, in SI, None where no frame came.
        acknowledged: Somebody acknowledged the safe state.
        readings: What further sensors sent, in the order in which it came.
    """

    t_ns: int
    heights: tuple[Measurement | None, ...]
    others: tuple[float | None, ...] = NO_OTHERS
    acknowledged: bool = False
    readings: tuple[Reading, ...] = ()

    @property
    def applied_force_n(self) -> float | None:
        """New applied force."""
        return self.others[_APPLIED]

    @property
    def load_cell_force_n(self) -> float | None:
        """New force of the load cell."""
        return self.others[_LOAD_CELL]

    @property
    def temperature_c(self) -> float | None:
        """New damper temperature."""
        return self.others[_TEMPERATURE]


class MovingModel(Protocol):
    """State of a model, made by its plant and frozen."""

    @property
    def struts(self) -> Sequence[tuple[float, float]]:
        """Height (m) and velocity (m/s) of each strut."""
        ...


class LoadedModel(Protocol):
    """A state of a model under the forces that act from it on; frozen."""

    @property
    def state(self) -> Any:
        """The state, a `MovingModel`."""
        ...

    @property
    def forces_n(self) -> Sequence[float]:
        """Spring-damper force of each strut, without the virtual force."""
        ...

    @property
    def accelerations_m_per_s2(self) -> Sequence[float]:
        """Second derivative of each strut's height."""
        ...

    @property
    def applied_force_n(self) -> float:
        """Applied force."""
        ...

    @property
    def temperature_c(self) -> float:
        """Damper temperature."""
        ...


class Plant(Protocol):
    """A model that runs beside a bench. Its answers depend on its arguments alone."""

    @property
    def struts(self) -> int:
        """Number of struts."""
        ...

    def init(
        self,
        heights_m: Sequence[float],
        velocities_m_per_s: Sequence[float] | None = None,
        t_s: float = 0.0,
    ) -> Any:
        """State with given strut heights, at rest unless velocities are given."""
        ...

    def load(
        self,
        state: Any,
        virtual_forces_n: Sequence[float],
        applied_force_n: float,
        temperature_c: float,
    ) -> Any:
        """The state with forces on it, a `LoadedModel`; virtual forces are constant from it on."""
        ...

    def step(self, loaded: Any, dt_s: float, applied_force_end_n: float) -> Any:
        """State after `dt_s`, with an applied force that is linear in between."""
        ...

    def numbers(self, state: Any) -> Sequence[float]:
        """A state as numbers, for whoever differentiates a step."""
        ...

    def state_of(self, numbers: Sequence[float]) -> Any:
        """The state of what `numbers` gave."""
        ...


class ObserverState(Protocol):
    """State of an observer; frozen."""

    @property
    def innovation_m(self) -> float:
        """Last innovation: measured less model height, at the time of the measurement."""
        ...

    @property
    def virtual_force_n(self) -> float:
        """Virtual force, constant until the next step."""
        ...

    @property
    def residual_force_n(self) -> float:
        """Estimate of the force that the model's law lacks; published with the law's own."""
        ...

    @property
    def force_std_n(self) -> float:
        """Standard deviation of that estimate; NaN where the observer does not know it."""
        ...

    @property
    def measured_ns(self) -> int:
        """Time of the last measurement of the height."""
        ...


class Observer(Protocol):
    """What makes the model of one strut follow its bench. It knows no other strut."""

    @property
    def first_measurements(self) -> int:
        """Measurements that the model's start is found from; with more than one it moves."""
        ...

    def init(self, start: Start) -> Any:
        """State at the model's start, an `ObserverState` without virtual force."""
        ...

    def settled(self, start: Start) -> Any:
        """State after a long time at rest, whose variances no longer change."""
        ...

    def step(self, state: Any, t_ns: int, innovation: Innovation | None) -> Any:
        """State after a tick.

        Args:
            state: State after the last tick.
            t_ns: Time of the tick.
            innovation: Of a new measurement; None where no frame came.
        """
        ...

    def numbers(self, state: Any) -> Sequence[float]:
        """What of a state the next one depends on, but for times and variances."""
        ...

    def with_numbers(self, state: Any, numbers: Sequence[float]) -> Any:
        """A state with other numbers, as `numbers` gives them."""
        ...


class FusingObserver(Observer, Protocol):
    """An observer that also uses further sensors; its states have `left_out`, their places."""

    def fuse(
        self,
        state: Any,
        t_ns: int,
        innovation: Innovation | None,
        deviations: Sequence[Deviation],
    ) -> Any:
        """State after a tick.

        Args:
            state: State after the last tick.
            t_ns: Time of the tick.
            innovation: Of a new measurement; None where no frame came.
            deviations: Of new readings of further sensors.
        """
        ...


class StrutOutput(Struct, frozen=True, gc=False):
    """What a tick publishes of one strut; each attribute is a column of the log.

    Attributes:
        force_n: Estimated spring-damper force: the law's, and the residual force.
        virtual_force_n: Virtual force.
        valid: Whether the estimate rests on a fresh measurement.
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
    """What a tick publishes.

    Attributes:
        mode: State of the bridge.
        struts: One a strut, in the model's order; empty before the first measurements.
        left_out: Places of further sensors that are not used now.
    """

    mode: Mode
    struts: tuple[StrutOutput, ...]
    left_out: tuple[int, ...] = ()


class Divergence(Struct, frozen=True, gc=False):
    """A model whose numbers no bench has.

    Attributes:
        strut: Index of the first strut that shows it.
        t_ns: Time of the tick that found it.
    """

    strut: int
    t_ns: int


class CoreState(Struct, frozen=True, gc=False):
    """State of a core between two ticks; a run can be restarted from any.

    Attributes:
        t_ns: Time of the last tick.
        mode: State of the bridge.
        temperature_c: Last damper temperature.
        last_valid: What was last published as valid; empty before.
        diverged: The last divergence of the model, if there ever was one.
    """

    t_ns: int
    mode: Mode
    temperature_c: float
    last_valid: tuple[StrutOutput, ...] = ()
    diverged: Divergence | None = None


class Core(Protocol):
    """The arithmetic of a bridge: values in, values out."""

    @property
    def struts(self) -> int:
        """Number of struts."""
        ...

    def init(self, t_ns: int) -> CoreState:
        """State before the first tick."""
        ...

    def step(self, state: Any, step_input: StepInput) -> tuple[CoreState, StepOutput]:
        """State after a tick, and what it publishes; `state` is what `init` or `step` gave."""
        ...

    def changed(self, observers: Sequence[Any], supervision: Any) -> "Core":
        """The same with other observers and supervision; states of one are states of the other."""
        ...


_SENSELESS = 1e12
"""No bench has heights, velocities or forces of this size: the model has diverged."""


def is_sensible(number: float) -> bool:
    """Whether a number, or a sum of some, in SI is of a size that a bench may have; NaN is not."""
    return -_SENSELESS < number < _SENSELESS
