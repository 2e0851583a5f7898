"""What an observer is, and what it exchanges with the step, the check and the tuning."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from rig.channels.channel import Channel

if TYPE_CHECKING:
    from rig.observers.error_filter import ErrorFilter

REFERENCE_HEIGHT = -1
"""Channel of an innovation of the strut's own height, `signals.height`."""


class Innovation(Struct, frozen=True, gc=False):
    """A sample compared with the model.

    Attributes:
        value: Measured value less the model's, both at the time of the measurement, in SI; of a
            force that of the model's law.
        t_ns: That time.
        channel: Index of the further sensor's channel.
    """

    value: float
    t_ns: int
    channel: int = REFERENCE_HEIGHT


class Start(Struct, frozen=True, gc=False):
    """What an observer is given when the model starts.

    Attributes:
        t_ns: Time of the measurement that it starts with.
        mobility_per_kg: Acceleration of the strut's height per newton in the strut.
        interval_ns: Time between two measurements; 0 of a strut whose height is not measured.
        delay_ns: Time from a measurement to the arrival of its frame.
        stiffness_per_s2: Decrease of that acceleration per metre of height: of the model's own
            law, its stiffness over the effective mass.
        damping_per_s: The same per m/s.
        sensors: Further sensors of the strut.
    """

    t_ns: int
    mobility_per_kg: float
    interval_ns: int
    delay_ns: int = 0
    stiffness_per_s2: float = 0.0
    damping_per_s: float = 0.0
    sensors: tuple[Channel, ...] = ()


class ObserverState(Protocol):
    """State of an observer; frozen."""

    @property
    def innovation_m(self) -> float:
        """Last innovation of the height."""
        ...

    @property
    def virtual_force_n(self) -> float:
        """Virtual force, constant until the next step."""
        ...

    @property
    def residual_force_n(self) -> float:
        """Estimate of the residual force; published together with the model's own."""
        ...

    @property
    def force_std_n(self) -> float:
        """Standard deviation of that estimate; NaN where the observer does not know it."""
        ...

    @property
    def measured_ns(self) -> int:
        """Time of the last measurement of the height."""
        ...

    @property
    def left_out(self) -> tuple[int, ...]:
        """Channels of further sensors that are not used now."""
        ...

    @property
    def is_disturbed(self) -> bool:
        """Whether the estimate is not what it would be had nothing ever been missing.

        Its variances show the start or a gap, or the virtual force is at its limit, so that the
        model cannot follow.
        """
        ...


class SensorStep(NamedTuple):
    """A step of the height sensor, for the check; the weight is that of the model's bodies."""

    step_m: float
    weight_n: float | None


class Remark(NamedTuple):
    """What a check of an observer found; a warning is shown to the user as one."""

    text: str
    is_warning: bool


StateT = TypeVar("StateT", bound=ObserverState)


class Observer(Protocol[StateT]):
    """What makes the model of one strut follow its bench. By itself it knows no other strut.

    The settings of an observer are its own attributes: it is a frozen pydantic dataclass with a
    `kind`, which `rig.observers.OBSERVERS` lists.

    Attributes:
        fuses_sensors: Whether further sensors of its strut are used.
        is_joinable: Whether struts that move each other have one filter
            (`rig.observers.joint_filter`).
        knows_std: Whether it knows the standard deviation of its estimate.
        estimates_force: Whether it estimates a residual force.
    """

    fuses_sensors: ClassVar[bool]
    is_joinable: ClassVar[bool]
    knows_std: ClassVar[bool]
    estimates_force: ClassVar[bool]

    @property
    def requires_height(self) -> bool:
        """Whether the height of its strut has to be measured."""
        ...

    @property
    def height_std_m(self) -> float | None:
        """Standard deviation of the height in a joint filter; None where it corrects none."""
        ...

    @property
    def force_filter(self) -> "ErrorFilter | None":
        """Filter of its residual force in a joint filter; None where that estimates none."""
        ...

    @property
    def kind(self) -> str:
        """Its name in a configuration."""
        ...

    @property
    def force_limit_n(self) -> float:
        """Largest magnitude of the virtual force."""
        ...

    @property
    def measurements_to_start(self) -> int:
        """Measurements that the model's start is computed from; with more than one it moves."""
        ...

    def init(self, start: Start) -> StateT:
        """State at the model's start, without virtual force."""
        ...

    def restart(self, state: StateT, start: Start) -> StateT:
        """State at another start, after a gap; it keeps what the gap did not change."""
        ...

    def steady_state(self, start: Start) -> StateT:
        """State after a long time at rest, whose variances no longer change."""
        ...

    def step(self, state: StateT, t_ns: int, innovation: Innovation | None) -> StateT:
        """State after a tick, from the state after the last one.

        `innovation` is that of a new measurement of the height, None where no frame came.
        """
        ...

    def with_slopes(
        self, state: StateT, stiffness_n_per_m: float, damping_n_s_per_m: float
    ) -> StateT:
        """State that knows the slopes of the model's law where the model is now."""
        ...

    def longest_gap_ns(self, interval_ns: int) -> int:
        """Longest time without a measurement that a state is worth keeping for.

        Behind a longer one model and observer start again from measurements. `interval_ns` is the
        usual time between two of them.
        """
        ...

    def settling_ns(self, decay_ns: int) -> int:
        """Time without a disturbance until the estimate has forgotten the last one.

        `decay_ns` is the time in which the closed loop forgets (`rig.closed_loop.settling`).
        """
        ...

    def numbers(self, state: StateT) -> Sequence[float]:
        """What of a state the next one depends on, but for times and variances."""
        ...

    def with_numbers(self, state: StateT, numbers: Sequence[float]) -> StateT:
        """A state with other numbers, as `numbers` returns them."""
        ...

    def can_continue(self, other: "AnyObserver") -> bool:
        """Whether a state of another observer of this kind is a state of this one too."""
        ...

    def remark_on_step(self, step: SensorStep) -> Remark:
        """What one step of the height sensor means to the observer."""
        ...

    def remark_on_rate(self, rate_hz: float) -> Remark | None:
        """A remark on the rate of the measurements; None if it does not affect this observer."""
        ...


AnyObserver = Observer[Any]
"""An observer of whatever kind: its states come from it alone and go back to it alone."""


Vector = Sequence[float] | NDArray[np.float64]


class Search(NamedTuple):
    """How the parameters of a kind of observer are searched; vectors are of any length.

    Attributes:
        observer: Parameter vector -> the observer.
        candidates: Vectors that are tried first.
        starts: How many of the best candidates a local search begins at.
        gain_margin: Gain margin that the loop must keep unless the user states another.
        settling_s: The same for the longest settling time of the estimate.
    """

    observer: Callable[[Vector], "AnyTunableObserver"]
    candidates: Sequence[Sequence[float]]
    starts: int
    gain_margin: float
    settling_s: float = math.inf


class TuningTask(NamedTuple):
    """The strut that an observer is tuned for; `mass_kg` is what the strut's force moves."""

    mass_kg: float
    noise_std_m: float
    interval_s: float
    force_limit_n: float


class TunableObserver(Observer[StateT], Protocol[StateT]):
    """An observer with parameters that `rig tune` can choose."""

    @property
    def force_limit_n(self) -> float:
        """Largest magnitude of the virtual force."""
        ...

    @classmethod
    def search(cls, task: TuningTask) -> Search:
        """How its parameters are searched for a strut."""
        ...

    def bandwidth_hz(self, mobility_per_kg: float) -> float:
        """Bandwidth on a strut of some mobility."""
        ...

    def with_bandwidth(self, factor: float) -> "TunableObserver[StateT]":
        """The observer with its bandwidth multiplied by a factor."""
        ...

    def to_four_digits(self) -> "TunableObserver[StateT]":
        """The observer with parameters of four digits, as they stand in a configuration."""
        ...


AnyTunableObserver = TunableObserver[Any]
