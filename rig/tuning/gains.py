"""Gains with the smallest expected error of the published force.

The error is that of model and observer in closed loop, made linear on the model itself: the
sensor's noise goes through to the force, and the residual force is followed with a lag. Both parts
are closed forms of the linear loop (a Lyapunov equation, a frequency response); their sum is
minimised over the gains, among those whose poles keep a damping ratio and whose loop keeps a gain
margin.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from rig.bridge.contract import Observer, Plant
from rig.bridge.free_model import Answer
from rig.closed_loop.loop import LinearLoop, Loop, Rhythm
from rig.closed_loop.poles import Pole, poles_of
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from rig.observers.pi import PiObserver
from rig.tuning.expectation import Expectation

MARGINS = {"kalman": 1.1, "pi": 2.0}
"""Gain margins by kind. Two is usual for a PI loop. A noise-aware observer cancels the residual
force with the effective mass that the model itself gives, which is known: it bears a tenth or a
fifth."""

KINDS = tuple(MARGINS)

PAPER_PER_S2, PAPER_PER_S3 = 1.0e4, 1.0e3
"""Gains of the reference case over its mass of 10 kg."""

PAPER_HZ = math.sqrt(PAPER_PER_S2) / (2.0 * math.pi)
"""Natural frequency of the published gains by mass."""

_EVALUATIONS = 250
"""Of a search, shared among its starts."""

_PI_STARTS = 8
"""Natural frequencies that a search may begin at, its bounds among them: an octave and more
apart. The fast ones keep their margin with strong damping and a filter well above them only."""

_GRID = 30
"""Bandwidths tried before the search: steps of a fifth."""

_INTEGRAL_SHARE_PER_S = 0.1
"""K_I over K_P, as in the reference case: slow, it takes what is constant."""

_WIDEST_PER_INTERVAL, _NARROWEST_PER_INTERVAL = 2.0, 0.004
"""Bounds of a bandwidth in rad/s times the time between two measurements: wider ones follow single
samples, narrower ones nothing."""


class Aim(NamedTuple):
    """What the loop must keep.

    Attributes:
        damping_ratio: Least damping ratio of its poles.
        gain_margin: Factor by which the model may answer more strongly, or less, and stay stable;
            None: that of `MARGINS`.
    """

    damping_ratio: float = 0.1
    gain_margin: float | None = None

    def margin(self, kind: str) -> float:
        """The gain margin for a kind of observer."""
        return MARGINS[kind] if self.gain_margin is None else self.gain_margin


class Expected(NamedTuple):
    """What is expected of an observer.

    Attributes:
        noise_n: Standard deviation of the force's error by the sensor's noise; infinite where the
            loop is unstable.
        lag_n: Root mean square of its error by the lag.
        poles: Poles of the loop, the slowest first.
    """

    noise_n: float
    lag_n: float
    poles: Sequence[Pole]

    @property
    def force_n(self) -> float:
        """Root mean square of the force's error."""
        return math.hypot(self.noise_n, self.lag_n)

    @property
    def damping_ratio(self) -> float:
        """Least damping ratio; an integrator that is switched off, a pole at 1, counts as 1."""
        poles = [pole for pole in self.poles if abs(pole.magnitude - 1.0) > 1e-9]
        return min((pole.damping_ratio for pole in poles), default=1.0)


class Tuned(NamedTuple):
    """An observer that was tuned.

    Attributes:
        observer: The observer.
        expected: What is expected of it.
        gain_margin: Factor by which the model may answer more strongly, or less; 20 means that or
            more.
    """

    observer: Any
    expected: Expected
    gain_margin: float


class Bench(NamedTuple):
    """A strut whose observer is to be tuned.

    Attributes:
        plant: The model.
        observers: Observers of all its struts.
        strut: Index of the strut.
        answers: What the model answers, strut by strut.
        heights_m: Heights at which the bench rests.
        rhythm: When the loop is closed.
        expectation: What is expected of the strut.
        force_limit_n: Limit of the virtual force.
    """

    plant: Plant
    observers: tuple[Observer, ...]
    strut: int
    answers: Sequence[Answer]
    heights_m: Sequence[float]
    rhythm: Rhythm
    expectation: Expectation
    force_limit_n: float

    @property
    def mobility_per_kg(self) -> float:
        """Acceleration of the strut's height per newton in it."""
        return self.answers[self.strut].mobility_per_kg

    def linear(self, observer: Any, factor: float = 1.0) -> LinearLoop:
        """The loop with another observer of this strut.

        Args:
            observer: The observer.
            factor: By how much the model answers a virtual force more strongly than the observers
                take it to.
        """
        plant: Any = self.plant if factor == 1.0 else _Stronger(self.plant, factor)
        observers = self.with_observer(observer)
        loop = Loop(plant, observers, self.heights_m, self.rhythm, self.answers)
        return loop.linear(self.strut)

    def with_observer(self, observer: Any) -> tuple[Observer, ...]:
        """All observers, with another one of this strut."""
        return (*self.observers[: self.strut], observer, *self.observers[self.strut + 1 :])


class _Stronger:
    """A model that answers a virtual force more strongly."""

    def __init__(self, plant: Plant, factor: float) -> None:
        self._plant, self._factor = plant, factor

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plant, name)

    def load(self, state: Any, virtual_forces_n: Sequence[float], *others: float) -> Any:
        return self._plant.load(state, [self._factor * f for f in virtual_forces_n], *others)


def expected(bench: Bench, observer: Any) -> Expected:
    """What is expected of an observer of a strut."""
    linear = bench.linear(observer)
    poles = poles_of(linear.a, linear.interval_s)
    if not _is_stable(poles):
        return Expected(math.inf, math.inf, poles)
    return Expected(*_parts(linear, bench.expectation), poles)


def gain_margin(bench: Bench, observer: Any, most: float = 20.0) -> float:
    """Factor by which the model may answer more strongly, or less, until the loop is unstable.

    Args:
        bench: The strut.
        observer: Its observer.
        most: Where the search ends.
    """
    if not _keeps(bench, observer, 1.0):
        return 1.0
    low, high = 1.0, most
    if _has_margin(bench, observer, most):
        return most
    while high / low > 1.01:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if _has_margin(bench, observer, middle) else (low, middle)
    return low


def paper(bench: Bench) -> PiObserver:
    """The published gains, scaled by the effective mass."""
    return PiObserver(
        proportional_n_per_m=PAPER_PER_S2 / bench.mobility_per_kg,
        integral_n_per_m_s=PAPER_PER_S3 / bench.mobility_per_kg,
        force_limit_n=bench.force_limit_n,
    )


def tuned(bench: Bench, kind: str, aim: Aim) -> Tuned:
    """The observer of a kind with the smallest expected error of the force.

    Args:
        bench: The strut.
        kind: One of `KINDS`.
        aim: What the loop must keep.
    """

    def cost(observer: Any) -> float:
        found = expected(bench, observer)
        if not math.isfinite(found.force_n):
            return 1e12
        short = max(0.0, aim.damping_ratio - found.damping_ratio)
        if not _has_margin(bench, observer, aim.margin(kind)):
            short += 1.0
        # What misses the aim is worse than all that keeps it, and the worse the more it misses.
        return math.log(found.force_n + 1e-12) + (1e3 * (1.0 + short) if short > 0.0 else 0.0)

    make, starts = _CHOICES[kind](bench, cost)

    def of_numbers(x: Any) -> float:
        try:
            observer = make(x)
        except (OverflowError, ValueError):
            return 1e12
        return cost(observer)

    best = min(
        (
            minimize(
                of_numbers,
                start,
                method="Nelder-Mead",
                options={"maxfev": _EVALUATIONS // len(starts), "xatol": 0.01, "fatol": 1e-3},
            )
            for start in starts
        ),
        key=lambda item: item.fun,
    )
    observer = _rounded(make(best.x))
    return Tuned(observer, expected(bench, observer), gain_margin(bench, observer))


def swept(bench: Bench, observer: Any, factors: Sequence[float]) -> list[tuple[float, Expected]]:
    """What is expected of an observer at other bandwidths, by their frequencies in Hz.

    Args:
        bench: The strut.
        observer: The observer.
        factors: By how much its bandwidth is multiplied: gains of the innovation go with the
            square, those of its rate linearly.
    """
    found: list[tuple[float, Expected]] = []
    for factor in factors:
        made = faster(observer, factor)
        found.append((bandwidth_hz(made, bench.mobility_per_kg), expected(bench, made)))
    return found


def faster(observer: Any, factor: float) -> Any:
    """An observer with another bandwidth."""
    changed: dict[str, Any] = {}
    if observer.filter is not None:
        follower = observer.filter
        changed["filter"] = follower.within(factor * follower.bandwidth_hz, follower.noise_std_m)
    if isinstance(observer, PiObserver):
        changed["proportional_n_per_m"] = factor**2 * observer.proportional_n_per_m
        changed["integral_n_per_m_s"] = factor**2 * observer.integral_n_per_m_s
        changed["derivative_n_s_per_m"] = factor * observer.derivative_n_s_per_m
    return replace(observer, **changed)


def bandwidth_hz(observer: Any, mobility_per_kg: float) -> float:
    """The filter's corner of a noise-aware observer, the natural frequency of a PI observer."""
    if isinstance(observer, KalmanObserver):
        return observer.filter.bandwidth_hz
    return math.sqrt(observer.proportional_n_per_m * mobility_per_kg) / (2.0 * math.pi)


def _parts(linear: LinearLoop, expectation: Expectation) -> tuple[float, float]:
    noise_n = linear.noise_gain_n_per_m() * expectation.noise_std_m
    share = linear.lag_gain(expectation.frequency_hz)
    return noise_n, float(np.sqrt(np.sum(share**2 * expectation.power_n2)))


def _is_stable(poles: Sequence[Pole]) -> bool:
    # An integrator that is switched off leaves a pole at exactly 1, which harms nothing.
    return max((pole.magnitude for pole in poles), default=0.0) < 1.0 + 1e-9


def _keeps(bench: Bench, observer: Any, factor: float) -> bool:
    linear = bench.linear(observer, factor)
    return _is_stable(poles_of(linear.a, linear.interval_s))


def _has_margin(bench: Bench, observer: Any, factor: float) -> bool:
    return _keeps(bench, observer, factor) and _keeps(bench, observer, 1.0 / factor)


_Cost = Callable[[Any], float]
_Choice = tuple[Callable[[Any], Any], list[list[float]]]


def _corners(bench: Bench) -> tuple[float, float]:
    """Bounds of a bandwidth, in rad/s."""
    interval_s = bench.rhythm.interval_ns * 1e-9
    return _NARROWEST_PER_INTERVAL / interval_s, _WIDEST_PER_INTERVAL / interval_s


def _filter(bench: Bench, log_corner: float) -> ErrorFilter:
    low, high = _corners(bench)
    corner = min(max(math.exp(log_corner), low), high)
    return ErrorFilter.within(corner / (2.0 * math.pi), bench.expectation.noise_std_m)


def _kalman(bench: Bench, cost: _Cost) -> _Choice:
    low, high = _corners(bench)

    def make(x: Any) -> KalmanObserver:
        return KalmanObserver("kalman", _filter(bench, float(x[0])), bench.force_limit_n)

    # The error has several least values over the bandwidth where the force has lines.
    grid = np.linspace(math.log(low), math.log(high), _GRID)
    costs = [cost(make([x])) for x in grid]
    return make, [[float(grid[int(np.argmin(costs))])]]


def _pi(bench: Bench, cost: _Cost) -> _Choice:
    low, high = _corners(bench)
    mass_kg = 1.0 / bench.mobility_per_kg

    def make(x: Any) -> PiObserver:
        natural, damping, corner = (float(value) for value in x)
        proportional = mass_kg * math.exp(2.0 * natural)
        return PiObserver(
            proportional_n_per_m=proportional,
            integral_n_per_m_s=_INTEGRAL_SHARE_PER_S * proportional,
            derivative_n_s_per_m=2.0 * mass_kg * math.exp(natural + damping),
            force_limit_n=bench.force_limit_n,
            filter=_filter(bench, corner),
        )

    naturals = np.linspace(math.log(low), math.log(high), _PI_STARTS)[1:-1].tolist()
    starts = [
        [natural, math.log(damping), natural + above]
        for natural, damping, above in itertools.product(naturals, (0.3, 1.0), (0.3, 1.5))
    ]
    costs = [cost(make(start)) for start in starts]
    return make, [starts[i] for i in np.argsort(costs)[:2]]


_CHOICES: dict[str, Callable[[Bench, _Cost], _Choice]] = {"kalman": _kalman, "pi": _pi}


def _rounded(observer: Any) -> Any:
    """Gains with four digits: what stands in a configuration is what was judged."""

    def short(item: Any, *names: str) -> Any:
        return replace(item, **{name: float(f"{getattr(item, name):.4g}") for name in names})

    observer = replace(observer, filter=short(observer.filter, "bandwidth_hz", "noise_std_m"))
    if isinstance(observer, PiObserver):
        names = ("proportional_n_per_m", "integral_n_per_m_s", "derivative_n_s_per_m")
        observer = short(observer, *names)
    return observer
