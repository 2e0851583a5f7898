"""A dyno: the motion is prescribed, and the load cell measures the force it requires.

The model is not free: its strut is moved along the measured motion, and the virtual force is the
load cell's less that of the model's own law.

No model contradicts height and load cell. What does is what is usual of them: the time between two
samples, and the band of the filter's innovations.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C
from dart_model.errors import ModelError
from dart_model.protocol import AnySensorReader
from dart_model.virtual_sensors import VirtualSensor
from rig.bridge.estimator import Estimate, is_sensible
from rig.bridge.innovation_band import InnovationBand, restart_band, update_band
from rig.bridge.measurement_age import is_too_old
from rig.bridge.tracked_motion import SETTLED, TrackedMotion, predict_motion, update_motion
from rig.bridge.values import StepInput, StrutOutput
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import LOAD_CELL_FORCE, TEMPERATURE
from rig.observers.protocol import AnyObserver

ModelT = TypeVar("ModelT")

_LONGEST_GAP = 10
"""Intervals after which the motion is followed from the next measurement on, as from the first."""

_LONGEST_AGE = 3
"""Intervals that a value may be old: what it has changed by since is at most three times what it
changes by between two samples."""


_FADING = 64
"""Samples over which the longest time between two of them fades."""


class PrescribedModel(Protocol[ModelT]):
    """A strut of a model that is moved from outside. Its states are frozen."""

    def init(self, t_s: float) -> ModelT:
        """State at the beginning."""
        ...

    def step(
        self,
        state: ModelT,
        t_s: float,
        motion: Callable[[float], tuple[float, float]],
        temperature_c: float,
    ) -> ModelT:
        """State at `t_s`, after a motion: time in s -> height (m) and velocity (m/s)."""
        ...

    def force_n(
        self, state: ModelT, height_m: float, velocity_m_per_s: float, temperature_c: float
    ) -> float:
        """Force that a load cell would show, in N."""
        ...


class Watched(Struct, frozen=True, gc=False):
    """A channel's last sample, and the time between two of them: 0 before it is known."""

    sample: Sample
    interval_ns: int


class PrescribedMotionState(Struct, frozen=True, gc=False):
    """State between two steps at a dyno; None before the first measurement.

    Attributes:
        is_moving: Whether the model has begun to move.
        disturbed_ns: Time since which the motion is followed undisturbed.
        band: The band of the motion's innovations.
        is_settled: Whether the estimate had settled at the last step.
    """

    t_ns: int
    temperature_c: float
    motion: TrackedMotion | None = None
    model: object = None
    height: Watched | None = None
    cell: Watched | None = None
    is_moving: bool = False
    disturbed_ns: int = 0
    band: InnovationBand = InnovationBand()
    is_settled: bool = False


def _motion_at(motion: TrackedMotion, t_s: float) -> tuple[float, float]:
    """Height and velocity at a time of the run."""
    height_m, velocity_m_per_s, _ = predict_motion(motion, round(t_s * 1e9))
    return height_m, velocity_m_per_s


class PrescribedMotionEstimator:
    """An estimator whose motion is prescribed and whose force is measured.

    Args:
        settling_s: Time constant with which older measurements of the motion fade.
        channels: Channels of the bench; their indices are their positions.
        stale_after_ns: Age up to which a measurement can start the model.
    """

    def __init__(
        self,
        model: PrescribedModel[Any],
        settling_s: float,
        channels: Sequence[Channel],
        stale_after_ns: int,
    ) -> None:
        self._model = model
        self._settling_s = settling_s
        self._channels = tuple(channels)
        self._stale_after_ns = stale_after_ns
        self._steps = [channel.step for channel in channels]

    @property
    def struts(self) -> int:
        return 1

    @property
    def observers(self) -> Sequence[AnyObserver]:
        return ()

    def with_settings(
        self, observers: Sequence[AnyObserver], stale_after_ns: int, settling_s: float | None
    ) -> "PrescribedMotionEstimator":
        del observers, settling_s
        return PrescribedMotionEstimator(
            self._model, self._settling_s, self._channels, stale_after_ns
        )

    def init(self, t_ns: int) -> PrescribedMotionState:
        return PrescribedMotionState(t_ns, AMBIENT_C)

    def unsettle(self, state: PrescribedMotionState, t_ns: int) -> PrescribedMotionState:
        return replace(state, disturbed_ns=t_ns)

    def restart(self, state: PrescribedMotionState, t_ns: int) -> PrescribedMotionState:
        """State that waits for measurements again; the temperature is kept."""
        return PrescribedMotionState(t_ns, state.temperature_c)

    def discard(
        self, before: PrescribedMotionState, after: PrescribedMotionState
    ) -> PrescribedMotionState:
        """State after the step: the motion is the bench's, whatever becomes of the model."""
        del before
        return after

    def heights_m(self, state: PrescribedMotionState) -> Sequence[float]:
        """Last measured height as it is filtered; empty before the first one."""
        return () if state.motion is None else (state.motion.position_m,)

    def read_model(self, sensors: Mapping[str, VirtualSensor]) -> AnySensorReader:
        """None can be read: a plan has refused them."""
        raise ModelError(f"virtual sensors {', '.join(sensors)}: no body moves on a dyno")

    def model_of(self, state: PrescribedMotionState) -> None:
        del state

    def force_covariance_n2(self, state: PrescribedMotionState) -> NDArray[np.float64]:
        del state
        return np.full((self.struts, self.struts), np.nan)

    def innovations(self, state: PrescribedMotionState) -> tuple[()]:
        del state
        return ()

    def motion_errors(self, state: PrescribedMotionState) -> tuple[()]:
        del state
        return ()

    def step(
        self, state: PrescribedMotionState, step_input: StepInput
    ) -> tuple[PrescribedMotionState, Estimate | None]:
        """Move the model to a time, and compare it with the load cell."""
        t_ns = step_input.t_ns
        state, can_start = self.collect(state, step_input)
        motion, height, cell = state.motion, state.height, state.cell
        if motion is None or height is None or cell is None or not (state.is_moving or can_start):
            return state, None
        measured_ns = min(motion.measured_ns, cell.sample.t_ns)
        temperature_c, cell_n = state.temperature_c, cell.sample.value
        model = self._model.step(
            state.model, t_ns * 1e-9, partial(_motion_at, motion), temperature_c
        )
        height_m, velocity, acceleration = predict_motion(motion, t_ns)
        model_n = self._model.force_n(model, height_m, velocity, temperature_c)
        innovation_m, virtual_n = motion.innovation_m, cell_n - model_n
        strut = StrutOutput(cell_n, virtual_n, True, height_m, velocity, acceleration, innovation_m)
        diverged = -1 if is_sensible(cell_n + model_n + height_m + velocity) else 0
        is_settled = (
            (t_ns - state.disturbed_ns) * 1e-9 >= SETTLED * self._settling_s
            and not self._is_old(height, t_ns)
            and not self._is_old(cell, t_ns)
        )
        after = replace(state, model=model, is_moving=True, is_settled=is_settled)
        return after, Estimate((strut,), measured_ns, is_settled, diverged)

    def _is_old(self, watched: Watched, t_ns: int) -> bool:
        """Whether a channel's next sample is overdue."""
        delay_ns = self._channels[watched.sample.channel].delay_ns
        return t_ns - watched.sample.t_ns > _LONGEST_AGE * watched.interval_ns + delay_ns

    def collect(
        self, state: PrescribedMotionState, step_input: StepInput
    ) -> tuple[PrescribedMotionState, bool]:
        """State with the samples of a step; the model begins at the first measured height."""
        state = replace(state, t_ns=step_input.t_ns)
        for sample in step_input.samples:
            channel = self._channels[sample.channel]
            if channel.role is Role.HEIGHT:
                state = self._follow(state, sample)
            elif channel.quantity is LOAD_CELL_FORCE:
                state = replace(state, cell=self._watch(state.cell, sample))
            elif channel.quantity is TEMPERATURE:
                state = replace(state, temperature_c=sample.value)
        motion, cell = state.motion, state.cell
        if motion is None or cell is None:
            return state, False
        oldest_ns = min(motion.measured_ns, cell.sample.t_ns)
        return state, not is_too_old(oldest_ns, state.t_ns, self._stale_after_ns)

    def _follow(self, state: PrescribedMotionState, sample: Sample) -> PrescribedMotionState:
        """State after a measured height."""
        t_ns, motion, last, band = sample.t_ns, state.motion, state.height, state.band
        height = self._watch(last, sample)
        gap_ns, usual_ns = 0, 0
        if last is not None:
            gap_ns, usual_ns = t_ns - last.sample.t_ns, last.interval_ns
        if motion is None or (usual_ns and gap_ns > _LONGEST_GAP * usual_ns):
            model = self._model.init(state.t_ns * 1e-9) if motion is None else state.model
            motion = TrackedMotion(sample.value, 0.0, 0.0, 0.0, t_ns)
            return replace(
                state,
                motion=motion,
                model=model,
                height=height,
                disturbed_ns=t_ns,
                band=restart_band(band),
            )
        motion = update_motion(motion, sample, self._settling_s)
        sensing = self._steps[sample.channel], height.interval_ns
        band = update_band(band, sample.value, motion.innovation_m, t_ns, sensing, state.is_settled)
        disturbed_ns = state.disturbed_ns
        if band.is_left or gap_ns > _LONGEST_AGE * usual_ns:
            disturbed_ns = t_ns
        return replace(state, motion=motion, height=height, disturbed_ns=disturbed_ns, band=band)

    def _watch(self, last: Watched | None, sample: Sample) -> Watched:
        """A channel after a sample."""
        channel = self._channels[sample.channel]
        if last is None:
            return Watched(sample, channel.interval_ns if channel.has_cycle else 0)
        gap_ns, usual_ns = sample.t_ns - last.sample.t_ns, last.interval_ns
        if gap_ns <= 0:
            return last
        if not channel.has_cycle:
            usual_ns = _usual_ns(usual_ns, gap_ns)
        return Watched(sample, usual_ns)


def _usual_ns(usual_ns: int, gap_ns: int) -> int:
    """Time between samples of an unknown cycle: the longest, which fades over some of them.

    A gap is not usual at once, but what becomes usual begins with one.
    """
    if not usual_ns:
        return gap_ns
    if gap_ns > usual_ns:
        return min(gap_ns, 2 * usual_ns)
    return usual_ns - (usual_ns - gap_ns) // _FADING
