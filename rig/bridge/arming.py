"""Who permits valid estimates: an operator, the bench's enable signal, and its interlock."""

from collections.abc import Sequence
from math import nan
from typing import Literal, NamedTuple

from msgspec import Struct

from rig.bridge.measurement_age import is_too_old
from rig.bridge.values import Request, StepInput
from rig.channels.channel import Channel, Sample
from rig.channels.measured_quantities import ENABLE, INTERLOCK, Quantity

ArmingKind = Literal["automatic", "manual"]


class ArmingState(Struct, frozen=True, gc=False):
    """What was last received of those who permit estimates.

    Attributes:
        is_armed: Whether an operator has armed the bridge.
        interlock: Newest sample of the interlock; None before the first.
        enable: Newest sample of the enable signal; None before the first.
    """

    is_armed: bool = False
    interlock: Sample | None = None
    enable: Sample | None = None


NOT_ARMED = ArmingState()


class OpenInterlock(NamedTuple):
    """Why an interlock counts as open: it reports 0, or it was received too long ago."""

    quantity: str
    value: float
    limit: float = nan


class Arming:
    """Reads operator, enable signal and interlock.

    Args:
        kind: `manual` requires an operator to arm the bridge.
        channels: Channels of the bench; those of the switches are used.
        safe_after_ns: Age from which a switch that is no longer received counts as open.
    """

    def __init__(self, kind: ArmingKind, channels: Sequence[Channel], safe_after_ns: int) -> None:
        self.is_manual = kind == "manual"
        self._interlock = _find(channels, INTERLOCK)
        self._enable = _find(channels, ENABLE)
        self._safe_after_ns = safe_after_ns
        self.switches = frozenset({self._interlock, self._enable} - {-1})
        """Indices of the switches' channels."""
        self.is_used = self.is_manual or bool(self.switches)
        """Whether anything has to permit estimates."""

    def update(self, state: ArmingState, step_input: StepInput) -> ArmingState:
        """State with what a step was given."""
        interlock, enable = state.interlock, state.enable
        for sample in step_input.samples:
            if sample.channel == self._interlock:
                interlock = sample
            elif sample.channel == self._enable:
                enable = sample
        is_armed, request = state.is_armed, step_input.request
        if request is Request.ARM:
            is_armed = True
        elif request is Request.DISARM:
            is_armed = False
        return ArmingState(is_armed, interlock, enable)

    def permits(self, state: ArmingState, t_ns: int) -> bool:
        """Whether estimates may be valid: all that has to permit them does."""
        if self.is_manual and not state.is_armed:
            return False
        if self._enable >= 0 and not self._permits_now(state.enable, t_ns):
            return False
        return self._interlock < 0 or self._permits_now(state.interlock, t_ns)

    def find_open(self, state: ArmingState, t_ns: int) -> OpenInterlock | None:
        """Why the interlock counts as open; None if it does not.

        One that was never received permits nothing, and counts as open at no time.
        """
        sample = state.interlock
        if sample is None or self._permits_now(sample, t_ns):
            return None
        if not sample.value:
            return OpenInterlock("interlock", 0.0)
        age_s = (t_ns - sample.t_ns) * 1e-9
        return OpenInterlock("age_s", age_s, self._safe_after_ns * 1e-9)

    def _permits_now(self, sample: Sample | None, t_ns: int) -> bool:
        return (
            sample is not None
            and bool(sample.value)
            and not is_too_old(sample.t_ns, t_ns, self._safe_after_ns)
        )


def _find(channels: Sequence[Channel], quantity: Quantity) -> int:
    """Index of the channel of a quantity; -1 if there is none."""
    return next((channel.index for channel in channels if channel.quantity is quantity), -1)
