"""A dyno: the motion is prescribed, and the load cell measures the force it requires.

The model is not free: its strut is moved along the measured motion, and the virtual force is the
load cell's less that of the model's own law. The motion between and at measurements is followed by
a filter with fading memory, which has no lag for a constant acceleration.

Reference: Morrison, "Introduction to Sequential Smoothing and Prediction" (1969), chapter 13: the
fading-memory polynomial filter of second degree.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from dart_model.effects import AMBIENT_C
from rig.bridge.estimator import Estimate, is_sensible
from rig.bridge.measurement_age import is_too_old
from rig.bridge.values import StepInput, StrutOutput
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import LOAD_CELL_FORCE, TEMPERATURE
from rig.observers.protocol import AnyObserver

ModelT = TypeVar("ModelT")

_SETTLED = 9.0
"""Time constants after which the filter has forgotten that it began at rest: to a hundredth."""

_LONGEST_GAP = 10
"""Measurements that may be missing in a row; the motion is followed from the next one on."""


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


class TrackedMotion(Struct, frozen=True, gc=False):
    """The motion as it is known: derivatives of the height at the last measurement."""

    height_m: float
    velocity_m_per_s: float
    acceleration_m_per_s2: float
    innovation_m: float
    measured_ns: int


class PrescribedMotionState(Struct, frozen=True, gc=False):
    """State between two steps at a dyno; None before the first measurement.

    `cell_ns` is the time at which the last force of the load cell arrived, `disturbed_ns` that
    since which the motion is followed without a gap.
    """

    t_ns: int
    temperature_c: float
    motion: TrackedMotion | None = None
    model: object = None
    cell_n: float | None = None
    cell_ns: int = 0
    is_moving: bool = False
    disturbed_ns: int = 0


def update_motion(motion: TrackedMotion, sample: Sample, settling_s: float) -> TrackedMotion:
    """The motion after a new measured height; older ones fade with a time constant."""
    age_s = (sample.t_ns - motion.measured_ns) * 1e-9
    if age_s <= 0.0:
        return motion
    height_m, velocity, acceleration = predict_motion(motion, sample.t_ns)
    innovation_m = sample.value - height_m
    kept = math.exp(-age_s / settling_s)
    fresh = 1.0 - kept
    return TrackedMotion(
        height_m + (1.0 - kept**3) * innovation_m,
        velocity + 1.5 * fresh * fresh * (1.0 + kept) * innovation_m / age_s,
        acceleration + fresh**3 * innovation_m / (age_s * age_s),
        innovation_m,
        sample.t_ns,
    )


def predict_motion(motion: TrackedMotion, t_ns: int) -> tuple[float, float, float]:
    """Height (m), velocity (m/s) and acceleration (m/s²) at a time after the last measurement."""
    h = (t_ns - motion.measured_ns) * 1e-9
    acceleration = motion.acceleration_m_per_s2
    velocity = motion.velocity_m_per_s + h * acceleration
    return (
        motion.height_m + h * (motion.velocity_m_per_s + 0.5 * h * acceleration),
        velocity,
        acceleration,
    )


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
        return () if state.motion is None else (state.motion.height_m,)

    def step(
        self, state: PrescribedMotionState, step_input: StepInput
    ) -> tuple[PrescribedMotionState, Estimate | None]:
        """Move the model to a time, and compare it with the load cell."""
        t_ns = step_input.t_ns
        state, can_start = self.collect(state, step_input)
        motion, cell_n = state.motion, state.cell_n
        if motion is None or cell_n is None or not (state.is_moving or can_start):
            return state, None
        measured_ns = min(motion.measured_ns, state.cell_ns)
        temperature_c = state.temperature_c
        model = self._model.step(
            state.model, t_ns * 1e-9, partial(_motion_at, motion), temperature_c
        )
        height_m, velocity, acceleration = predict_motion(motion, t_ns)
        model_n = self._model.force_n(model, height_m, velocity, temperature_c)
        innovation_m, virtual_n = motion.innovation_m, cell_n - model_n
        strut = StrutOutput(cell_n, virtual_n, True, height_m, velocity, acceleration, innovation_m)
        diverged = -1 if is_sensible(cell_n + model_n + height_m + velocity) else 0
        after = replace(state, model=model, is_moving=True)
        is_settled = (t_ns - state.disturbed_ns) * 1e-9 >= _SETTLED * self._settling_s
        return after, Estimate((strut,), measured_ns, is_settled, diverged)

    def collect(
        self, state: PrescribedMotionState, step_input: StepInput
    ) -> tuple[PrescribedMotionState, bool]:
        """State with the samples of a step; the model begins at the first measured height."""
        motion, model, temperature_c = state.motion, state.model, state.temperature_c
        cell_n, cell_ns, disturbed_ns = state.cell_n, state.cell_ns, state.disturbed_ns
        for sample in step_input.samples:
            channel = self._channels[sample.channel]
            if channel.role is Role.HEIGHT:
                longest_ns = _LONGEST_GAP * channel.interval_ns
                if motion is None or sample.t_ns - motion.measured_ns > longest_ns:
                    if motion is None:
                        model = self._model.init(state.t_ns * 1e-9)
                    motion = TrackedMotion(sample.value, 0.0, 0.0, 0.0, sample.t_ns)
                    disturbed_ns = sample.t_ns
                else:
                    motion = update_motion(motion, sample, self._settling_s)
            elif channel.quantity is LOAD_CELL_FORCE:
                cell_n, cell_ns = sample.value, step_input.t_ns
            elif channel.quantity is TEMPERATURE:
                temperature_c = sample.value
        can_start = (
            motion is not None
            and cell_n is not None
            and not is_too_old(
                min(motion.measured_ns, cell_ns), step_input.t_ns, self._stale_after_ns
            )
        )
        collected = PrescribedMotionState(
            step_input.t_ns,
            temperature_c,
            motion,
            model,
            cell_n,
            cell_ns,
            state.is_moving,
            disturbed_ns,
        )
        return collected, can_start
