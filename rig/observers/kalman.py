"""The noise-aware observer: a filter of the model's error, which the virtual force takes away.

The filter tells error, rate and residual force d. The virtual force is the residual force and a
feedback of error and rate,

    F_v = d + m omega_c² x + 2 m zeta omega_c dx/dt,

so that the model follows the filtered height through a force alone: its height and velocity stay
what the integrator makes of them. What is published is the force that the model's law
lacks where the model is, d - k x - c dx/dt, not the feedback beside it.

Reference: Åström and Wittenmark, "Computer-Controlled Systems" (1997), 9.5, for the disturbance
that is estimated and cancelled.
"""

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from can_dbc.yaml_file import Positive
from rig.bridge.contract import Deviation, Innovation, Start
from rig.observers.error_filter import ErrorFilter, ErrorState
from rig.observers.sensor_fusion import Several, begun, fused

_DAMPING = 0.8
"""Damping ratio of the feedback: settles fast, hardly overshoots."""

_MOST_PER_INTERVAL = 0.3
"""Largest product of the feedback's corner and the time between two measurements: the hold of the
virtual force takes half an interval of phase."""


class KalmanState(Struct, frozen=True, gc=False):
    """State of a noise-aware observer.

    Attributes:
        error: What is known of the model's error.
        innovation_m: Last innovation.
        virtual_force_n: Virtual force, constant until the next tick.
        residual_force_n: Estimated residual force.
        force_std_n: Its standard deviation.
        measured_ns: Time of the last measurement of the height.
        several: What is remembered of further sensors; None without any.
    """

    error: ErrorState
    innovation_m: float
    virtual_force_n: float
    residual_force_n: float
    force_std_n: float
    measured_ns: int
    several: Several | None = None

    @property
    def left_out(self) -> tuple[int, ...]:
        """Places of further sensors that are not used now."""
        return () if self.several is None else self.several.left_out


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class KalmanObserver:
    """The noise-aware observer of one strut.

    Attributes:
        kind: Tag of this observer in a configuration.
        filter: The filter; `rig tune` finds its bandwidth.
        force_limit_n: Largest magnitude of the virtual force.
    """

    kind: Literal["kalman"]
    filter: ErrorFilter
    force_limit_n: Positive = 1.0e4

    @property
    def first_measurements(self) -> int:
        """Enough for height and velocity: a parabola through twelve of them."""
        return 12

    def init(self, start: Start) -> KalmanState:
        """State at the model's start."""
        return self._at(self.filter.init(start), start)

    def settled(self, start: Start) -> KalmanState:
        """State after a long time at rest."""
        return self._at(self.filter.settled(start), start)

    def _at(self, error: ErrorState, start: Start) -> KalmanState:
        std_n = self.filter.residual_std(error, start.t_ns) / start.mobility_per_kg
        return KalmanState(error, 0.0, 0.0, 0.0, std_n, start.t_ns)

    def step(self, state: KalmanState, t_ns: int, innovation: Innovation | None) -> KalmanState:
        """State after a tick; arguments as of `Observer.step`."""
        if innovation is None:
            return self._driven(t_ns, state.error, state.innovation_m)
        error = self.filter.updated(state.error, innovation)
        return self._driven(t_ns, error, innovation.value_m)

    def fuse(
        self,
        state: KalmanState,
        t_ns: int,
        innovation: Innovation | None,
        deviations: Sequence[Deviation],
    ) -> KalmanState:
        """State after a tick; arguments as of `FusingObserver.fuse`."""
        several = state.several or begun(state.error.start)
        error, several = fused(self.filter, state.error, several, t_ns, innovation, deviations)
        innovation_m = state.innovation_m if innovation is None else innovation.value_m
        return self._driven(t_ns, error, innovation_m, several)

    def _driven(
        self,
        t_ns: int,
        error: ErrorState,
        innovation_m: float,
        several: Several | None = None,
    ) -> KalmanState:
        """State with the virtual force that a new estimate asks for."""
        follower, limit_n = self.filter, self.force_limit_n
        start, mobility_per_kg = error.start, error.start.mobility_per_kg
        mean = follower.predicted(error, t_ns)
        x, v, a, _, _ = mean
        corner = min(error.constants.omega, _MOST_PER_INTERVAL * 1e9 / start.interval_ns)
        wanted = a + corner * corner * x + 2.0 * _DAMPING * corner * v
        force_n = min(max(wanted / mobility_per_kg, -limit_n), limit_n)
        std_n = follower.residual_std(error, t_ns) / mobility_per_kg
        residual_n = follower.residual(error, mean) / mobility_per_kg
        error = follower.with_input(error, t_ns, -force_n * mobility_per_kg)
        measured_ns = error.t_ns if several is None else several.measured_ns
        return KalmanState(error, innovation_m, force_n, residual_n, std_n, measured_ns, several)

    def numbers(self, state: KalmanState) -> tuple[float, ...]:
        """What the next state depends on: all of it is in the filter's inputs."""
        return self.filter.numbers(state.error)

    def with_numbers(self, state: KalmanState, numbers: Sequence[float]) -> KalmanState:
        """The state with other numbers, as `numbers` gives them."""
        error = self.filter.with_numbers(state.error, numbers)
        virtual_force_n = -error.inputs[-1][1] / error.start.mobility_per_kg
        return KalmanState(
            error,
            state.innovation_m,
            virtual_force_n,
            state.residual_force_n,
            state.force_std_n,
            state.measured_ns,
            state.several,
        )
