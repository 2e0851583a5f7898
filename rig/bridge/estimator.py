"""Estimators of the struts' forces: one protocol, and one file for each kind of bench.

    free_model          a model under the applied force, corrected by observers
    prescribed_motion   a strut whose motion is prescribed and whose force is measured

An estimator knows no modes: when its estimate is published, and as what, is decided by
`rig.bridge.mode_supervisor`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from dart_model.protocol import AnySensorReader
from dart_model.virtual_sensors import VirtualSensor
from rig.bridge.values import StepInput, StrutOutput
from rig.observers.protocol import AnyObserver, Innovation


class FollowedError(NamedTuple):
    """What is known of the error of a motion that is followed, at a tick.

    Attributes:
        sample_m2: Variance of its samples' noise.
        noise: Variances of position (m²) and velocity (m²/s²) by it, shape (2,).
        lag: Mean squares of both by the filter's lag, shape (2,).
        interval_s: Time between two samples.
        delay_s: Time that a sample is old when it comes.
    """

    sample_m2: float
    noise: NDArray[np.float64]
    lag: NDArray[np.float64]
    interval_s: float
    delay_s: float


StateT = TypeVar("StateT")


class Estimate(Struct, frozen=True, gc=False):
    """What a step of an estimator computed.

    Attributes:
        struts: One per strut, in the model's order, as published while the bridge is running.
        measured_ns: Time of the oldest of the newest measurements that it rests on.
        is_settled: Whether it has forgotten how it began, and what was missing since.
        diverged: Index of the first strut whose numbers no bench has; -1 if there is none.
        left_out: Channels of further sensors that are not used now.
    """

    struts: tuple[StrutOutput, ...]
    measured_ns: int
    is_settled: bool
    diverged: int = -1
    left_out: tuple[int, ...] = ()


class Estimator(Protocol[StateT]):
    """The arithmetic of a bridge: samples in, estimates out."""

    @property
    def struts(self) -> int:
        """Number of struts."""
        ...

    @property
    def observers(self) -> Sequence[AnyObserver]:
        """Observers of the struts; empty where the motion is prescribed."""
        ...

    def init(self, t_ns: int) -> StateT:
        """State before the first step: it waits for measurements."""
        ...

    def unsettle(self, state: StateT, t_ns: int) -> StateT:
        """State whose estimate has to settle again, from a time on."""
        ...

    def restart(self, state: StateT, t_ns: int) -> StateT:
        """State that waits for measurements again, its last step at a time."""
        ...

    def step(self, state: StateT, step_input: StepInput) -> tuple[StateT, Estimate | None]:
        """State after a step, and its estimate; None while it waits for measurements."""
        ...

    def collect(self, state: StateT, step_input: StepInput) -> tuple[StateT, bool]:
        """State of an estimator that must not start, with new measurements, and whether it could.

        The state is one that waits for measurements.
        """
        ...

    def discard(self, before: StateT, after: StateT) -> StateT:
        """State of a model that stopped before a step whose motion is not to be used."""
        ...

    def heights_m(self, state: StateT) -> Sequence[float]:
        """Height at which each strut stands if the model stops here; empty while it waits."""
        ...

    def read_model(self, sensors: Mapping[str, VirtualSensor]) -> AnySensorReader:
        """What reads virtual sensors of bodies and joints in `model_of` a state.

        Raises:
            InputError: The model has not what one reads.
        """
        ...

    def model_of(self, state: StateT) -> object | None:
        """The model under its forces, for virtual sensors; None where none moves."""
        ...

    def force_covariance_n2(self, state: StateT) -> NDArray[np.float64]:
        """Covariance of the errors of the struts' forces, (struts, struts); NaN if not known."""
        ...

    def innovations(self, state: StateT) -> Sequence[Innovation | None]:
        """Innovations of the newest heights by strut, and of the newest position of each motion.

        They are None where there is none, or all are missing: where the model has just started.
        """
        ...

    def motion_errors(self, state: StateT) -> Sequence[FollowedError]:
        """What is known of the error of each motion that is followed."""
        ...

    def with_settings(
        self, observers: Sequence[AnyObserver], stale_after_ns: int, settling_s: float | None
    ) -> "Estimator[StateT]":
        """The same with other settings; a state of one is a state of the other.

        A measurement can start the model up to the age `stale_after_ns`; the estimate settles in
        `settling_s`, or as the observers do.
        """
        ...


AnyEstimator = Estimator[Any]
"""An estimator of whatever kind: its states come from it alone and go back to it alone."""

_LARGEST = 1e12
"""No bench has heights, velocities or forces of this size: the model has diverged."""


def is_sensible(number: float) -> bool:
    """Whether a number, or a sum of some, in SI is of a size that a bench may have; NaN is not."""
    return -_LARGEST < number < _LARGEST


def find_divergence(struts: Sequence[StrutOutput]) -> int:
    """Index of the first strut whose numbers no bench has; 0 where only their sum shows it."""
    for index, strut in enumerate(struts):
        if not is_sensible(strut.force_n + strut.height_m + strut.velocity_m_per_s):
            return index
    return 0
