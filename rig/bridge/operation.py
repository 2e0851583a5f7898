"""What precedes and follows a valid estimate: arming, interlock, and ramps of the published force.

While a ramp is under way the published force is not the estimate: it is invalid. A receiver that
follows the force alone sees no step; one that needs the right value waits for the valid signal.
"""

from collections.abc import Sequence

from msgspec import Struct
from msgspec.structs import replace

from rig.bridge.arming import NOT_ARMED, Arming, ArmingState, OpenInterlock
from rig.bridge.values import Mode, StepInput, StepOutput


class OperationState(Struct, frozen=True, gc=False):
    """State of arming and ramps between two ticks.

    Attributes:
        t_ns: Time of the last tick.
        arming: What was received of those who permit estimates.
        share: Share of the estimate in the published force, from 0 to 1.
        rest_n: Of each strut the force that has the other share: it moves to the safe output.
        published_n: Of each strut the force that was published last; empty before the first.
    """

    t_ns: int
    arming: ArmingState = NOT_ARMED
    share: float = 0.0
    rest_n: tuple[float, ...] = ()
    published_n: tuple[float, ...] = ()


NOT_OPERATED = OperationState(0)


class Operation:
    """Arming and ramps.

    Args:
        arming: Those who permit estimates.
        fade_in_s: Time in which the share of the estimate grows to 1; 0 for at once.
        slew_n_per_s: Rate at which a force that is no longer valid moves to the safe output; None
            for at once.
    """

    def __init__(self, arming: Arming, fade_in_s: float, slew_n_per_s: float | None) -> None:
        self._arming = arming
        self._fade_in_s = fade_in_s
        self._slew_n_per_s = slew_n_per_s
        self._has_ramps = fade_in_s > 0.0 or slew_n_per_s is not None
        self.is_used = arming.is_used or self._has_ramps
        """Whether there is anything to do."""
        self.switches = arming.switches
        """Indices of the channels of interlock and enable signal."""

    def update(self, state: OperationState, step_input: StepInput, before: Mode) -> OperationState:
        """State with what a tick was given; `before` is the mode of the tick before it."""
        arming = self._arming.update(state.arming, step_input)
        if before is Mode.SAFE:
            arming = replace(arming, is_armed=False)
        return replace(state, arming=arming)

    def is_withheld(self, state: OperationState, t_ns: int) -> bool:
        """Whether an estimate must not be valid yet: it is not permitted, or fades in."""
        is_fading_in = self._has_ramps and state.share < 1.0
        return is_fading_in or not self._arming.permits(state.arming, t_ns)

    def find_open_interlock(self, state: OperationState, t_ns: int) -> OpenInterlock | None:
        """Why the interlock counts as open; None if it does not."""
        return self._arming.find_open(state.arming, t_ns)

    def publish(
        self, state: OperationState, t_ns: int, output: StepOutput, safe_n: Sequence[float]
    ) -> tuple[OperationState, StepOutput]:
        """State and output of a tick, with the forces that the ramps leave."""
        struts, mode = output.struts, output.mode
        if not self._has_ramps:
            return replace(state, t_ns=t_ns), output
        if not struts or mode is Mode.RUNNING:
            published_n = tuple([strut.force_n for strut in struts])
            share = 1.0 if struts else 0.0
            return OperationState(t_ns, state.arming, share, (), published_n), output
        elapsed_s = (t_ns - state.t_ns) * 1e-9
        if mode is Mode.READY and self._arming.permits(state.arming, t_ns):
            share = self._fade_in(state.share, elapsed_s)
            rest_n = self._approach(state.rest_n, safe_n, elapsed_s)
        else:
            share = 0.0
            rest_n = self._approach(state.published_n, safe_n, elapsed_s)
        published_n = tuple(
            [
                share * strut.force_n + (1.0 - share) * rest
                for strut, rest in zip(struts, rest_n, strict=True)
            ]
        )
        shaped = [replace(it, force_n=n) for it, n in zip(struts, published_n, strict=True)]
        after = OperationState(t_ns, state.arming, share, rest_n, published_n)
        return after, replace(output, struts=tuple(shaped))

    def is_at_rest(self, state: OperationState, safe_n: Sequence[float]) -> bool:
        """Whether the published force has arrived at the safe output."""
        return not self._has_ramps or state.published_n in ((), tuple(safe_n))

    def _fade_in(self, share: float, elapsed_s: float) -> float:
        if elapsed_s >= self._fade_in_s * (1.0 - share):
            return 1.0
        return share + elapsed_s / self._fade_in_s

    def _approach(
        self, forces_n: Sequence[float], safe_n: Sequence[float], elapsed_s: float
    ) -> tuple[float, ...]:
        """Forces, moved towards the safe output."""
        slew = self._slew_n_per_s
        if slew is None or len(forces_n) != len(safe_n):
            return tuple(safe_n)
        most_n = slew * elapsed_s
        return tuple(
            [
                force_n + min(max(safe - force_n, -most_n), most_n)
                for force_n, safe in zip(forces_n, safe_n, strict=True)
            ]
        )
