"""No observer: the strut is what the model's law says, and nobody measures its height.

So a tyre under an observed suspension: its law takes part in the motion and is not corrected.
"""

from collections.abc import Sequence
from math import nan
from typing import Literal

from msgspec import Struct
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from rig.bridge.contract import Innovation, Start


class NoState(Struct, frozen=True, gc=False):
    """State of no observer.

    Attributes:
        measured_ns: Time of the last tick: nothing is waited for.
        innovation_m: NaN.
        virtual_force_n: None, so zero.
        residual_force_n: None, so zero.
        force_std_n: NaN.
    """

    measured_ns: int
    innovation_m: float = nan
    virtual_force_n: float = 0.0
    residual_force_n: float = 0.0
    force_std_n: float = nan


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class NoObserver:
    """A strut without an observer.

    Attributes:
        kind: Tag of this observer in a configuration.
    """

    kind: Literal["none"]

    @property
    def first_measurements(self) -> int:
        """None: the model starts at what the other heights leave."""
        return 0

    def init(self, start: Start) -> NoState:
        """State at the model's start."""
        return NoState(start.t_ns)

    def settled(self, start: Start) -> NoState:
        """State after a long time at rest."""
        return NoState(start.t_ns)

    def step(self, _state: NoState, t_ns: int, _innovation: Innovation | None) -> NoState:
        """State after a tick."""
        return NoState(t_ns)

    def numbers(self, _state: NoState) -> tuple[float, ...]:
        """Nothing."""
        return ()

    def with_numbers(self, state: NoState, _numbers: Sequence[float]) -> NoState:
        """The same."""
        return state
