"""What drives the model of a bench, as it was measured: samples in, the model's input vector out.

A force or torque acts as it was last measured. A body that is moved is followed by a filter
(`rig.bridge.tracked_motion`) and is where the filter predicts it for the tick.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from rig.bridge.measurement_age import age_limit_ns
from rig.bridge.tracked_motion import (
    SETTLED,
    ErrorGains,
    TrackedMotion,
    accelerate,
    error_gains,
    predict_motion,
    update_motion,
    update_with_acceleration,
)
from rig.channels.channel import Channel, Sample

_FADING_S = 1.0
"""Time constant with which the innovations' mean square is followed."""

_LONGEST_GAP = 10
"""Intervals after which a motion is followed from the next position on, as from the first."""


class InputState(Protocol):
    """What is known of an input, frozen."""

    @property
    def t_ns(self) -> int:
        """Time of its newest sample."""
        ...


StateT = TypeVar("StateT", bound=InputState)


class MeasuredInput(Protocol[StateT]):
    """An input of the model. None stands for the state of one of which nothing is measured."""

    @property
    def channels(self) -> Sequence[Channel]:
        """Channels that measure it; empty where nothing does, and the input is zero."""
        ...

    def update(self, state: StateT | None, sample: Sample) -> StateT | None:
        """State after a sample of one of its channels."""
        ...

    def values(self, state: StateT | None, t_ns: int) -> tuple[float, ...]:
        """Its part of the input vector at a time (see `dart_model.plant.inputs`)."""
        ...

    def is_ready(self, state: StateT | None) -> bool:
        """Whether a model can start with it."""
        ...

    @property
    def gains(self) -> ErrorGains | None:
        """Gains of the errors of a motion that is followed; None of any other input."""
        ...

    def newest(self, state: StateT | None) -> Sample | None:
        """The newest position of a motion; None of any other input, and before the first one."""
        ...

    def squares_m2(self, state: StateT | None) -> tuple[float, ...]:
        """Variance of a followed motion's samples, and mean square of what lag adds to innovations.

        Empty of any other input.
        """
        ...


AnyInput = MeasuredInput[Any]
"""An input of whatever kind: its states come from it alone and go back to it alone."""


@dataclass(frozen=True)
class HeldInput:
    """A force (N) or torque (N·m); `channel` is None where it is not measured."""

    channel: Channel | None

    @property
    def channels(self) -> tuple[Channel, ...]:
        return () if self.channel is None else (self.channel,)

    def update(self, state: Sample | None, sample: Sample) -> Sample:
        del state
        return sample

    def values(self, state: Sample | None, t_ns: int) -> tuple[float]:
        del t_ns
        return (0.0,) if state is None else (state.value,)

    def is_ready(self, state: Sample | None) -> bool:
        return state is not None or self.channel is None

    @property
    def gains(self) -> None:
        return None

    def newest(self, state: Sample | None) -> None:
        del state

    def squares_m2(self, state: Sample | None) -> tuple[()]:
        del state
        return ()


class Followed(Struct, frozen=True, gc=False):
    """A motion that is followed.

    Attributes:
        since_ns: Time since which it is followed without a gap.
        innovation_m2: Mean square of its innovations of late, without those of the first moments.
        change_m2: The same of their changes from sample to sample.
        averaged_s: Time over which both are averaged.
    """

    motion: TrackedMotion
    since_ns: int
    innovation_m2: float = 0.0
    change_m2: float = 0.0
    averaged_s: float = 0.0

    @property
    def t_ns(self) -> int:
        return self.motion.measured_ns


@dataclass(frozen=True)
class MovedInput:
    """Position (m), velocity (m/s) and acceleration (m/s²) of a body that is moved.

    Attributes:
        acceleration: Channel of its acceleration; None where it follows from the positions.
        settling_s: Time constant with which older positions fade.
    """

    position: Channel
    acceleration: Channel | None
    settling_s: float

    @property
    def channels(self) -> tuple[Channel, ...]:
        return (self.position,) if self.acceleration is None else (self.position, self.acceleration)

    def update(self, state: Followed | None, sample: Sample) -> Followed | None:
        if self.acceleration is not None and sample.channel == self.acceleration.index:
            return state and replace(state, motion=accelerate(state.motion, sample))
        interval_ns = self.position.interval_ns
        if state is None or sample.t_ns - state.t_ns > _LONGEST_GAP * interval_ns:
            first = TrackedMotion(sample.value, 0.0, 0.0, 0.0, sample.t_ns, sample.value)
            if state is None:
                return Followed(first, sample.t_ns)
            return replace(state, motion=first, since_ns=sample.t_ns)
        update = update_motion if self.acceleration is None else update_with_acceleration
        motion = update(state.motion, sample, self.settling_s)
        if motion is state.motion or not self.is_ready(state):
            return replace(state, motion=motion)
        new_m, before_m = motion.innovation_m, state.motion.innovation_m
        interval_s = interval_ns * 1e-9
        averaged_s = min(state.averaged_s + interval_s, _FADING_S)
        share = interval_s / averaged_s
        return Followed(
            motion,
            state.since_ns,
            state.innovation_m2 + share * (new_m * new_m - state.innovation_m2),
            state.change_m2 + share * ((new_m - before_m) ** 2 - state.change_m2),
            averaged_s,
        )

    @property
    def gains(self) -> ErrorGains:
        return self._gains

    @cached_property
    def _gains(self) -> ErrorGains:
        return error_gains(
            self.settling_s,
            self.position.interval_ns * 1e-9,
            has_acceleration=self.acceleration is not None,
        )

    def newest(self, state: Followed | None) -> Sample | None:
        if state is None:
            return None
        motion = state.motion
        return Sample(self.position.index, motion.measured_m, motion.measured_ns)

    def squares_m2(self, state: Followed | None) -> tuple[float, float]:
        if state is None:
            return 0.0, 0.0
        gains = self._gains
        noise_m2 = state.change_m2 / gains.change
        return noise_m2, max(state.innovation_m2 - gains.innovation * noise_m2, 0.0)

    def values(self, state: Followed | None, t_ns: int) -> tuple[float, float, float]:
        return (0.0, 0.0, 0.0) if state is None else predict_motion(state.motion, t_ns)

    def is_ready(self, state: Followed | None) -> bool:
        if state is None:
            return False
        return state.t_ns - state.since_ns >= SETTLED * self.settling_s * 1e9


def grace_ns(item: AnyInput, stale_after_ns: int) -> int:
    """How much older than a height its newest sample may be: its own cycle may be longer."""
    limits_ns = [age_limit_ns(it.interval_ns, stale_after_ns) for it in item.channels[:1]]
    return max(limits_ns, default=stale_after_ns) - stale_after_ns
