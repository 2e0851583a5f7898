"""No observer: the strut's force is that of the model's law, and its height is not measured.

An example is a tyre under an observed suspension: its law takes part in the motion and is not
corrected.
"""

from collections.abc import Sequence
from math import nan
from typing import ClassVar, Literal

from msgspec import Struct
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from rig.observers.protocol import AnyObserver, Innovation, Remark, SensorStep, Start


class NoState(Struct, frozen=True, gc=False):
    """State of no observer.

    Attributes:
        measured_ns: Time of the last tick: no measurement is awaited.
        innovation_m: NaN.
        virtual_force_n: Zero.
        residual_force_n: Zero.
        force_std_n: NaN.
        left_out: Empty.
    """

    measured_ns: int
    innovation_m: float = nan
    virtual_force_n: float = 0.0
    residual_force_n: float = 0.0
    force_std_n: float = nan
    left_out: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class NoObserver:
    """A strut without an observer.

    Attributes:
        kind: Tag of this observer in a configuration.
    """

    requires_height: ClassVar[bool] = False
    fuses_sensors: ClassVar[bool] = False
    knows_std: ClassVar[bool] = False

    kind: Literal["none"]

    @property
    def measurements_to_start(self) -> int:
        """Zero: the model starts where the other heights put the strut."""
        return 0

    def init(self, start: Start) -> NoState:
        """State at the model's start."""
        return NoState(start.t_ns)

    def steady_state(self, start: Start) -> NoState:
        """State after a long time at rest."""
        return NoState(start.t_ns)

    def step(
        self,
        state: NoState,
        t_ns: int,
        innovation: Innovation | None,
        further: Sequence[Innovation] = (),
    ) -> NoState:
        """State after a tick."""
        del state, innovation, further
        return NoState(t_ns)

    def numbers(self, state: NoState) -> tuple[float, ...]:
        """Empty: the next state depends on nothing."""
        del state
        return ()

    def with_numbers(self, state: NoState, numbers: Sequence[float]) -> NoState:
        """The same state."""
        del numbers
        return state

    def can_continue(self, other: AnyObserver) -> bool:
        """Whether the other one is no observer either."""
        return type(other) is NoObserver

    def remark_on_step(self, step: SensorStep) -> Remark:
        """No remark: no height is used."""
        del step
        return Remark("", is_warning=False)

    def remark_on_rate(self, rate_hz: float) -> Remark | None:
        """No remark: no measurement is used."""
        del rate_hz
        return None
