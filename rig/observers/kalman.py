"""The noise-aware observer: a filter of the model's error, which the virtual force takes away.

The filter estimates error, rate and residual force d. The virtual force is the residual force and a
feedback of error and rate,

    F_v = d + m omega_c² x + 2 m zeta omega_c dx/dt,

so that the model follows the filtered height through a force alone: its height and velocity remain
those of the integrator. What is published is the force that the model's law
lacks at the model's own state, d - k x - c dx/dt, without the feedback.

Reference: Åström and Wittenmark, "Computer-Controlled Systems" (1997), 9.5, for the disturbance
that is estimated and cancelled.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from typing import ClassVar, Literal

import numpy as np
from msgspec import Struct, structs
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from can_dbc.yaml_file import Positive
from rig.observers.error_filter import DAMPING, MOST_PER_INTERVAL, ErrorFilter, ErrorState
from rig.observers.filter_lag import NO_LAG
from rig.observers.protocol import (
    AnyObserver,
    Innovation,
    Remark,
    Search,
    SensorStep,
    Start,
    TuningTask,
    Vector,
)

_GAIN_MARGIN = 1.1
"""The residual force is cancelled with the effective mass that the model itself gives, which is
known: the observer tolerates a tenth or a fifth."""

_LONGEST_SETTLING_S = 0.25
"""The estimate is invalid for as long after each start and each disturbance. Where the model lacks
little, noise alone would choose a filter that needs a second for it, and that follows a new
residual force as slowly."""

_BANDWIDTHS = 30
"""Tried before the local search, in steps of a fifth: the error has several minima over the
bandwidth where the force has spectral lines."""

_UNTUNED_CORNER_PER_INTERVAL = 0.1
"""Corner in rad/s times the interval, of an observer that is not tuned yet: quick and tame."""


class KalmanState(Struct, frozen=True, gc=False):
    """State of a noise-aware observer of a strut that it observes alone."""

    error: ErrorState
    innovation_m: float
    virtual_force_n: float
    residual_force_n: float
    force_std_n: float
    measured_ns: int
    is_disturbed: bool = False

    @property
    def left_out(self) -> tuple[int, ...]:
        """None: a strut with further sensors has a joint filter."""
        return ()


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class KalmanObserver:
    """The noise-aware observer of one strut.

    Attributes:
        kind: `kalman`: the noise-aware observer.
        filter: Kalman filter of the model's error; `rig tune` chooses its bandwidth.
        force_limit_n: Largest magnitude of the virtual force.
    """

    fuses_sensors: ClassVar[bool] = True
    is_joinable: ClassVar[bool] = True
    knows_std: ClassVar[bool] = True
    estimates_force: ClassVar[bool] = True

    kind: Literal["kalman"]
    filter: ErrorFilter
    force_limit_n: Positive = 1.0e4

    @property
    def requires_height(self) -> bool:
        return True

    @property
    def measurements_to_start(self) -> int:
        """Enough for height and velocity: a parabola through twelve of them."""
        return 12

    @property
    def height_std_m(self) -> float:
        return self.filter.noise_std_m

    @property
    def force_filter(self) -> ErrorFilter:
        return self.filter

    def init(self, start: Start) -> KalmanState:
        return self._initial(self.filter.init(start), start)

    def restart(self, state: KalmanState, start: Start) -> KalmanState:
        """The state of a start, with the lag there was."""
        begun = self.init(start)
        lag = NO_LAG._replace(square=state.error.lag.square, peak=state.error.lag.peak)
        error = structs.replace(begun.error, lag=lag)
        return structs.replace(begun, error=error)

    def steady_state(self, start: Start) -> KalmanState:
        return self._initial(self.filter.steady_state(start), start)

    def _initial(self, error: ErrorState, start: Start) -> KalmanState:
        std_n = self.filter.residual_std(error, start.t_ns) / start.mobility_per_kg
        return KalmanState(error, 0.0, 0.0, 0.0, std_n, start.t_ns)

    def step(self, state: KalmanState, t_ns: int, innovation: Innovation | None) -> KalmanState:
        error = state.error
        if innovation is not None:
            error = self.filter.update(error, innovation)
        innovation_m = state.innovation_m if innovation is None else innovation.value
        start, follower, limit_n = error.start, self.filter, self.force_limit_n
        mobility_per_kg = start.mobility_per_kg
        mean = follower.predict(error, t_ns)
        x, v, a, _, _ = mean
        corner = min(self.filter.omega, MOST_PER_INTERVAL * 1e9 / start.interval_ns)
        required = a + corner * corner * x + 2.0 * DAMPING * corner * v
        force_n = min(max(required / mobility_per_kg, -limit_n), limit_n)
        std_n = follower.residual_std(error, t_ns) / mobility_per_kg
        residual_n = follower.residual(error, mean) / mobility_per_kg
        error = follower.with_input(error, t_ns, -force_n * mobility_per_kg)
        is_disturbed = abs(force_n) >= limit_n or not follower.is_steady(error, t_ns)
        return KalmanState(
            error,
            innovation_m,
            force_n,
            residual_n,
            std_n,
            error.t_ns,
            is_disturbed,
        )

    def with_slopes(
        self, state: KalmanState, stiffness_n_per_m: float, damping_n_s_per_m: float
    ) -> KalmanState:
        per_kg = state.error.start.mobility_per_kg
        slopes = stiffness_n_per_m * per_kg, damping_n_s_per_m * per_kg
        return structs.replace(state, error=structs.replace(state.error, slopes=slopes))

    def longest_gap_ns(self, interval_ns: int) -> int:
        """The time after which the filter knows nothing more: until then its variances say what."""
        del interval_ns
        return self.filter.forgotten_ns

    def settling_ns(self, decay_ns: int) -> int:
        """Its variances know the start and every gap: what they cannot know decays soon after."""
        del decay_ns
        return self.filter.settling_ns

    def numbers(self, state: KalmanState) -> tuple[float, ...]:
        # All of it is in the filter's inputs.
        return self.filter.numbers(state.error)

    def with_numbers(self, state: KalmanState, numbers: Sequence[float]) -> KalmanState:
        error = self.filter.with_numbers(state.error, numbers)
        _, by_force = error.inputs[-1]
        virtual_force_n = -by_force / error.start.mobility_per_kg
        return structs.replace(state, error=error, virtual_force_n=virtual_force_n)

    def can_continue(self, other: AnyObserver) -> bool:
        """Whether the other one has the same filter, whose state it continues."""
        return type(other) is KalmanObserver and other.filter == self.filter

    def remark_on_step(self, step: SensorStep) -> Remark:
        """Whether the rounding of the height sensor is within the filter's noise."""
        if step.step_m / sqrt(12.0) <= self.filter.noise_std_m:
            return Remark("", is_warning=False)
        text = "their rounding alone is more than filter.noise_std_m; see rig tune"
        return Remark(text, is_warning=True)

    def remark_on_rate(self, rate_hz: float) -> Remark | None:
        return self.filter.remark_on_rate(rate_hz)

    @classmethod
    def before_tuning(cls, noise_std_m: float, interval_ns: int) -> "KalmanObserver":
        """An observer for a strut whose noise alone is known."""
        corner = _UNTUNED_CORNER_PER_INTERVAL / (interval_ns * 1e-9)
        return cls("kalman", ErrorFilter.within(corner / (2.0 * math.pi), noise_std_m))

    @classmethod
    def search(cls, task: TuningTask) -> Search:
        low, high = ErrorFilter.corners(task.interval_s)

        def observer(x: Vector) -> KalmanObserver:
            corner = math.exp(float(x[0]))
            return cls("kalman", ErrorFilter.with_corner(corner, task), task.force_limit_n)

        grid = np.linspace(math.log(low), math.log(high), _BANDWIDTHS).tolist()
        return Search(observer, [[value] for value in grid], 1, _GAIN_MARGIN, _LONGEST_SETTLING_S)

    def bandwidth_hz(self, mobility_per_kg: float) -> float:
        del mobility_per_kg
        return self.filter.bandwidth_hz

    def with_bandwidth(self, factor: float) -> "KalmanObserver":
        return replace(self, filter=self.filter.with_bandwidth(factor))

    def to_four_digits(self) -> "KalmanObserver":
        return replace(self, filter=self.filter.to_four_digits())
