"""Gains with the smallest expected error of the published force.

The error is that of model and observer in closed loop, made linear on the model itself: the
sensor's noise goes through to the force, and the residual force is followed with a lag. Both parts
are closed forms of the linear loop (a Lyapunov equation, a frequency response); their sum is
minimised over the gains, among those whose poles keep a damping ratio, whose loop keeps a gain
margin and whose estimate settles in time.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.optimize import minimize

from dart_model.protocol import AnyPlant, LoadedModel, ModelState
from rig.closed_loop.loop import LinearLoop, Loop, SampleTiming
from rig.closed_loop.poles import (
    OperatingPoint,
    Pole,
    is_stable,
    least_damping,
    least_damping_ratio,
    poles_of,
)
from rig.closed_loop.settling import decay_time_ns
from rig.observers import OBSERVERS
from rig.observers.error_model import ErrorModel
from rig.observers.pi import PUBLISHED_PER_S2
from rig.observers.protocol import AnyObserver, AnyTunableObserver, TuningTask, Vector
from rig.tuning.expectation import Expectation

KINDS = tuple(kind for kind, observer in OBSERVERS.items() if hasattr(observer, "search"))
"""Kinds of observers that can be tuned."""

PAPER_HZ = math.sqrt(PUBLISHED_PER_S2) / (2.0 * math.pi)
"""Natural frequency of the published gains by mass."""

LEAST_IN_MOTION = 0.02
"""Least damping ratio in every motion of the run: an error decays to a tenth in 18 oscillations.
A stop or a fast stroke is over before."""

_EVALUATIONS = 250
"""Of a search, shared among its starts."""

_LARGEST_COST = 1e12
"""Cost of an observer that is unstable or cannot be made."""

_LARGEST_MARGIN = 20.0
"""Gain margin at which the search for it ends: the largest that a user may require."""


class Aim(NamedTuple):
    """What the loop must keep.

    Attributes:
        damping_ratio: Least damping ratio of its poles.
        gain_margin: Gain margin of the loop, upwards and downwards; None: that of the observer's
            kind.
        settling_s: Longest settling time of the estimate; None: that of the observer's kind.
    """

    damping_ratio: float = 0.1
    gain_margin: float | None = None
    settling_s: float | None = None


class ExpectedError(NamedTuple):
    """Expected error of an observer's force, and the poles of its loop.

    Attributes:
        noise_n: Standard deviation of the force's error by the sensor's noise; infinite where the
            loop is unstable.
        lag_n: Root mean square of its error by the lag.
        poles: Poles of the loop, the slowest first.
        settling_s: Settling time of the estimate; infinite where it never settles.
    """

    noise_n: float
    lag_n: float
    poles: Sequence[Pole]
    settling_s: float

    @property
    def force_n(self) -> float:
        """Root mean square of the force's error."""
        return math.hypot(self.noise_n, self.lag_n)

    @property
    def damping_ratio(self) -> float:
        """Least damping ratio of the poles."""
        return least_damping_ratio(self.poles)


class Tuned(NamedTuple):
    """An observer that was tuned.

    Attributes:
        gain_margin: Gain margin of its loop, upwards and downwards; 20 means that or more.
        in_motion: Least damping ratio of its loop at the operating points of the motion.
        required_margin: The gain margin that it was to keep.
        required_settling_s: The settling time that it was to keep.
    """

    observer: AnyTunableObserver
    expected: ExpectedError
    gain_margin: float
    in_motion: float
    required_margin: float
    required_settling_s: float


class TuningProblem(NamedTuple):
    """A strut whose observer is to be tuned.

    Attributes:
        observers: Observers of all its struts.
        strut: Index of the strut.
        heights_m: Heights at which the bench rests.
        timing: How often the loop is closed.
        expectation: Noise and residual force that are expected of the strut.
        force_limit_n: Limit of the virtual force.
        points: Motions in which the loop has to be stable, too: where the model is in a stop, or
            its damper beyond a knee, it is another one than at rest.
    """

    plant: AnyPlant
    observers: tuple[AnyObserver, ...]
    strut: int
    assumed: ErrorModel
    heights_m: Sequence[float]
    timing: SampleTiming
    expectation: Expectation
    force_limit_n: float
    points: Sequence[OperatingPoint] = ()

    @property
    def mobility_per_kg(self) -> float:
        """Acceleration of the strut's height per newton in it."""
        return float(self.assumed.mobility_per_kg[self.strut, self.strut])

    def linear(self, observer: AnyObserver, factor: float = 1.0) -> LinearLoop:
        """The loop with another observer of this strut.

        The model responds to a virtual force more strongly, by a factor, than the observers take it
        to.
        """
        plant = self.plant
        if factor != 1.0:
            plant = cast("AnyPlant", _StrongerPlant(plant, factor))
        loop = Loop(plant, self.with_observer(observer), self.heights_m, self.timing, self.assumed)
        return loop.linear(self.strut)

    def with_observer(self, observer: AnyObserver) -> tuple[AnyObserver, ...]:
        """The observers of all struts, with another one of this strut."""
        return (*self.observers[: self.strut], observer, *self.observers[self.strut + 1 :])

    def damping_in_motion(self, observer: AnyObserver) -> float:
        """Least damping ratio of the loop with another observer, at the operating points."""
        observers = self.with_observer(observer)
        return least_damping(self.plant, observers, self.timing, self.assumed, self.points)[0]


class _StrongerPlant:
    """A model that responds more strongly to a virtual force."""

    def __init__(self, plant: AnyPlant, factor: float) -> None:
        self._plant, self._factor = plant, factor

    def __getattr__(self, name: str) -> object:
        return getattr(self._plant, name)

    def load(
        self, state: ModelState, virtual_forces_n: Sequence[float], *others: Any
    ) -> LoadedModel[ModelState]:
        return self._plant.load(state, [self._factor * f for f in virtual_forces_n], *others)


def expect_error(problem: TuningProblem, observer: AnyObserver) -> ExpectedError:
    """Expected error of an observer of a strut; infinite where its loop is unstable."""
    linear = problem.linear(observer)
    poles = poles_of(linear.a, linear.interval_s)
    if not is_stable(poles):
        return ExpectedError(math.inf, math.inf, poles, math.inf)
    noise_n = linear.noise_gain_n_per_m() * problem.expectation.noise_std_m
    share = linear.lag_gain(problem.expectation.frequency_hz)
    lag_n = float(np.sqrt(np.sum(share**2 * problem.expectation.power_n2)))
    decay_ns = decay_time_ns(linear)
    settling_s = math.inf if decay_ns is None else observer.settling_ns(decay_ns) * 1e-9
    return ExpectedError(noise_n, lag_n, poles, settling_s)


def gain_margin(problem: TuningProblem, observer: AnyObserver) -> float:
    """Gain margin of the closed loop, upwards and downwards, dimensionless; 20 at most."""
    if not _is_stable_at(problem, observer, 1.0):
        return 1.0
    low, high = 1.0, _LARGEST_MARGIN
    if _has_margin(problem, observer, high):
        return high
    while high / low > 1.01:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if _has_margin(problem, observer, middle) else (low, middle)
    return low


def tune_observer(problem: TuningProblem, kind: str, aim: Aim) -> Tuned:
    """Tune an observer: that of a kind of `KINDS` with the smallest expected error of the force."""
    task = TuningTask(
        1.0 / problem.mobility_per_kg,
        problem.expectation.noise_std_m,
        problem.timing.interval_ns * 1e-9,
        problem.force_limit_n,
    )
    search = cast("type[AnyTunableObserver]", OBSERVERS[kind]).search(task)
    margin = search.gain_margin if aim.gain_margin is None else aim.gain_margin
    longest_s = search.settling_s if aim.settling_s is None else aim.settling_s

    def cost(x: Vector) -> float:
        try:
            observer = search.observer(x)
        except (OverflowError, ValueError):
            return _LARGEST_COST
        error = expect_error(problem, observer)
        if not math.isfinite(error.force_n):
            return _LARGEST_COST
        short = max(0.0, aim.damping_ratio - error.damping_ratio)
        if not _has_margin(problem, observer, margin):
            short += 1.0
        if error.settling_s > longest_s:
            short += min(1.0, error.settling_s / longest_s - 1.0)
        if short == 0.0:  # the longest part of the work
            short = max(0.0, LEAST_IN_MOTION - problem.damping_in_motion(observer))
        # What misses the aim costs more than all that keeps it, and the more it misses.
        return math.log(error.force_n + 1e-12) + (1e3 * (1.0 + short) if short > 0.0 else 0.0)

    costs = [cost(x) for x in search.candidates]
    best = min(
        (
            minimize(
                cost,
                search.candidates[index],
                method="Nelder-Mead",
                options={"maxfev": _EVALUATIONS // search.starts, "xatol": 0.01, "fatol": 1e-3},
            )
            for index in sorted(range(len(costs)), key=costs.__getitem__)[: search.starts]
        ),
        key=lambda item: item.fun,
    )
    observer = search.observer(best.x).to_four_digits()
    error = expect_error(problem, observer)
    reached = gain_margin(problem, observer), problem.damping_in_motion(observer)
    return Tuned(observer, error, *reached, margin, longest_s)


def sweep_bandwidth(
    problem: TuningProblem, observer: AnyTunableObserver, factors: Sequence[float]
) -> list[tuple[float, ExpectedError]]:
    """Expected errors of an observer at other bandwidths, by their frequencies in Hz.

    With a factor of the bandwidth, gains of the innovation go with its square, those of its rate
    linearly.
    """
    others = [observer.with_bandwidth(factor) for factor in factors]
    return [
        (other.bandwidth_hz(problem.mobility_per_kg), expect_error(problem, other))
        for other in others
    ]


def _is_stable_at(problem: TuningProblem, observer: AnyObserver, factor: float) -> bool:
    """Whether the loop is stable where the model responds more strongly by a factor."""
    linear = problem.linear(observer, factor)
    return is_stable(poles_of(linear.a, linear.interval_s))


def _has_margin(problem: TuningProblem, observer: AnyObserver, factor: float) -> bool:
    return _is_stable_at(problem, observer, factor) and _is_stable_at(
        problem, observer, 1.0 / factor
    )
