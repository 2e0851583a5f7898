"""No observer: the strut's force is that of the model's law.

An example is a tyre under an observed suspension: its law takes part in the motion and is not
corrected. If its height is measured, it is logged for a diagnosis; where its noise is stated, it
also shows the filter of the observed struts where the bench is.
"""

import sys
from collections.abc import Sequence
from math import nan
from typing import ClassVar, Literal

from msgspec import Struct
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from rig.observers.error_filter import HeightNoise
from rig.observers.protocol import AnyObserver, Innovation, Remark, SensorStep, Start


class NoState(Struct, frozen=True, gc=False):
    """State of no observer; no measurement is awaited."""

    measured_ns: int
    innovation_m: float = nan
    virtual_force_n: float = 0.0
    residual_force_n: float = 0.0
    force_std_n: float = nan
    left_out: tuple[int, ...] = ()
    is_disturbed: bool = False


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class NoObserver:
    """A strut without an observer.

    Attributes:
        kind: `none`: no observer.
        noise_std_m: Standard deviation of its measured height, quantisation included, with which
            the height corrects the filter of the struts with observers of the kind `kalman` that it
            shares bodies with; if absent, no height corrects it.
    """

    fuses_sensors: ClassVar[bool] = False
    is_joinable: ClassVar[bool] = True
    knows_std: ClassVar[bool] = False
    estimates_force: ClassVar[bool] = False

    kind: Literal["none"]
    noise_std_m: HeightNoise | None = None

    @property
    def requires_height(self) -> bool:
        return self.noise_std_m is not None

    @property
    def height_std_m(self) -> float | None:
        return self.noise_std_m

    @property
    def force_filter(self) -> None:
        return None

    @property
    def force_limit_n(self) -> float:
        """Zero: it has no virtual force."""
        return 0.0

    @property
    def measurements_to_start(self) -> int:
        """As many as others require; without a height the others put the strut where it starts."""
        return 0 if self.noise_std_m is None else 12

    def init(self, start: Start) -> NoState:
        return NoState(start.t_ns)

    def restart(self, state: NoState, start: Start) -> NoState:
        del state
        return self.init(start)

    def steady_state(self, start: Start) -> NoState:
        return NoState(start.t_ns)

    def step(self, state: NoState, t_ns: int, innovation: Innovation | None) -> NoState:
        del state, innovation
        return NoState(t_ns)

    def with_slopes(
        self, state: NoState, stiffness_n_per_m: float, damping_n_s_per_m: float
    ) -> NoState:
        del stiffness_n_per_m, damping_n_s_per_m
        return state

    def longest_gap_ns(self, interval_ns: int) -> int:
        del interval_ns
        return sys.maxsize

    def settling_ns(self, decay_ns: int) -> int:
        del decay_ns
        return 0

    def numbers(self, state: NoState) -> tuple[float, ...]:
        del state
        return ()

    def with_numbers(self, state: NoState, numbers: Sequence[float]) -> NoState:
        del numbers
        return state

    def can_continue(self, other: AnyObserver) -> bool:
        return other == self

    def remark_on_step(self, step: SensorStep) -> Remark:
        del step
        return Remark("", is_warning=False)

    def remark_on_rate(self, rate_hz: float) -> Remark | None:
        del rate_hz
        return None
