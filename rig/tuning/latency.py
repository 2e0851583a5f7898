"""Delay of a height, from a run of the bench.

The applied force arrives at once and the height late: compared with a model without the delay, the
strut's force seems to depend on the applied force. So the run is computed again with a delay, the
estimated force is smoothed, and its derivative by the delay determines the error of the delay and
its variance, as in a diagnosis (`rig.diagnosis.numerics.delay_step`). This is repeated until it
converges.

A bench moved by a single sine does not determine the delay: whatever is periodic is a function of
height and velocity there. Neither does a run that the observer follows for too short a time. The
interval is infinite then.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.diagnosis.numerics.delay_step import ForceOverTime, delay_step
from rig.observers.kalman import KalmanObserver
from rig.plan.plan import Plan
from rig.run.replay import replay
from rig.tuning.expectation import FEWEST, Array, longest_stretch, residual_force

_ITERATIONS = 6
"""Of Gauss and Newton: three sines took three, a single sine none that helps."""

_STEP_S = 0.5e-3
"""Step of the derivative by the delay."""

_LONGEST_S = 0.05
"""Longest delay searched for: an older height is of no use in a closed loop."""

_SETTLED_S = 0.3
"""Time after the start from which the observer follows."""


class Latency(NamedTuple):
    """A delay, and its standard deviation: infinite where the run does not determine it.

    The delay is negative where the applied force arrives later than the height.
    """

    delay_s: float
    std_s: float

    @property
    def low_s(self) -> float:
        """Lower end of the 95 % interval."""
        return self.delay_s - 1.96 * self.std_s

    @property
    def high_s(self) -> float:
        """Upper end of the 95 % interval."""
        return self.delay_s + 1.96 * self.std_s


class _Series(NamedTuple):
    """A strut as it appears with a delay, by the time at which its heights arrived."""

    arrived_s: Array
    height_m: Array
    velocity_m_per_s: Array
    force_n: Array

    def part(self, is_in: NDArray[np.bool_]) -> "_Series":
        """The part of it that a mask of shape (N,) selects."""
        return _Series(*(column[is_in] for column in self))


def with_delay(plan: Plan, delay_s: float) -> Plan:
    """The plan with heights delayed by some time; they become stale later by it too."""
    config = plan.config
    heights = {
        name: entry.model_copy(update={"delay_s": delay_s})
        for name, entry in config.signals.height.items()
    }
    supervision = config.supervision.model_copy(
        update={
            "stale_after_s": config.supervision.stale_after_s + delay_s,
            "safe_after_s": config.supervision.safe_after_s + delay_s,
        }
    )
    signals = config.signals.model_copy(update={"height": heights})
    config = config.model_copy(update={"signals": signals, "supervision": supervision})
    return plan.with_config(config)


def estimate_latency(
    folder: Path,
    plan: Plan,
    strut: str,
    mobilities_per_kg: Mapping[str, float],
    observer_for: Callable[[float], KalmanObserver],
    progress: Callable[[float], None],
) -> Latency:
    """The delay of a strut's height.

    The mobilities are the acceleration of its height per newton in each strut. `observer_for`
    gives a noise-aware observer whose loop is stable with a delay; `progress` is called with the
    share that is done.

    Raises:
        InputError: The run is damaged or too short.
    """

    def series(delay_s: float, observer: KalmanObserver) -> _Series:
        delayed = with_delay(plan.with_observers({strut: observer}), delay_s)
        steps = replay(folder, plan=delayed).steps
        stretch = longest_stretch(steps, folder, strut, mobilities_per_kg)
        _, residual_n = residual_force(stretch, mobilities_per_kg[strut])
        is_settled = stretch.t_s > stretch.tick_s[0] + _SETTLED_S
        is_used = is_settled & (stretch.t_s <= stretch.tick_s[-1])
        t_s = stretch.t_s[is_used]
        law_n, height, velocity = (
            np.interp(t_s, stretch.tick_s, column)
            for column in (stretch.law_force_n, stretch.height_m, stretch.velocity_m_per_s)
        )
        return _Series(t_s + delay_s, height, velocity, law_n + residual_n[is_used])

    delay_s, found_s, std_s = 0.0, 0.0, math.inf
    for number in range(_ITERATIONS):
        observer = observer_for(delay_s)
        step_s, std_s = _delay_step(series(delay_s, observer), series(delay_s + _STEP_S, observer))
        progress((number + 1) / _ITERATIONS)
        found_s, before_s = delay_s + step_s, delay_s
        delay_s = min(max(found_s, 0.0), _LONGEST_S)
        if not math.isfinite(std_s) or abs(delay_s - before_s) < 0.1 * std_s:
            break
    return Latency(min(found_s, _LONGEST_S), std_s)


def _delay_step(here: _Series, later: _Series) -> tuple[float, float]:
    """Error of the delay, and its standard deviation, from where the observer followed in both."""
    first_s, last_s = later.arrived_s[[0, -1]]
    here = here.part((first_s <= here.arrived_s) & (here.arrived_s <= last_s))
    if len(here.arrived_s) < FEWEST:
        return 0.0, math.inf
    slope = np.interp(here.arrived_s, later.arrived_s, later.force_n) - here.force_n
    slope = slope / _STEP_S
    nothing = np.zeros((len(slope), 0))
    force = ForceOverTime(
        here.height_m, here.velocity_m_per_s, here.force_n, slope[:, np.newaxis], nothing
    )
    step = delay_step([force])
    return float(step.steps_s[0]), float(step.stds_s[0])
