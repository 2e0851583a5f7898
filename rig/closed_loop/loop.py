"""Model and observers in closed loop, made linear by differences on the step itself.

The map from one measurement to the next is differenced about a slow motion of the bench, in both
directions: friction is infinitely steep at rest, and so is a damper's force that grows with a power
of the speed below one. The model is known by its responses alone.

Reference: Åström and Wittenmark, "Computer-Controlled Systems" (1997), chapter 3.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C
from dart_model.protocol import AnyPlant
from rig.closed_loop.derivatives import central_differences
from rig.closed_loop.strut_response import USUAL_SPEED_M_PER_S, linearise_at
from rig.observers.error_model import ErrorModel
from rig.observers.protocol import AnyObserver, Innovation, Start
from rig.observers.strut_observers import ObserversState, StrutObservers

Array = NDArray[np.float64]

_STEP = 1e-7
"""Step of the central differences, in units of the state: so small that no observer comes near its
limit, and not so small that rounding moves poles (with a tenth of it, by 4e-6)."""

POLE_ROUNDING = 1e-6
"""Error of a pole by these differences: where friction remembers, poles are at exactly 1, and are
found within a tenth of this."""

_ACCELERATION_STEP_M_PER_S2 = 1e-2
"""Step of the residual force, over the effective mass."""


class SampleTiming(NamedTuple):
    """How often a loop is closed, and how many measurement periods old a measurement is then."""

    period_ns: int
    measured_every: int = 1
    delay: int = 0

    @classmethod
    def of(cls, period_ns: int, interval_ns: int, delay_ns: int) -> "SampleTiming":
        """Timing in whole ticks and measurement periods."""
        every = max(1, round(interval_ns / period_ns))
        return cls(period_ns, every, round(delay_ns / (every * period_ns)))

    @property
    def interval_ns(self) -> int:
        """Time between two measurements."""
        return self.period_ns * self.measured_every


class LinearLoop(NamedTuple):
    """The error of a model that follows its bench: ``x+ = a x + b u``, ``y = c x + d u``.

    A step goes from one measurement to the next.

    Attributes:
        a: Shape (n, n).
        b: By noise of a strut's measurement (m) and by its residual force (N), shape (n, 2).
        c: Error of that strut's published force (N), shape (n,).
        d: The same by noise and residual force, shape (2,).
        interval_s: Time between two measurements.
    """

    a: Array
    b: Array
    c: Array
    d: Array
    interval_s: float

    def noise_covariance(self) -> Array:
        """Covariance of x by white noise of unit variance, (n, n); NaN if the loop is unstable."""
        # Sum over all past samples: the discrete Lyapunov equation, by doubling. What lies further
        # back than rounding lets a pole at 1 remember does not count.
        power = (1.0 - POLE_ROUNDING) * self.a
        covariance = np.outer(self.b[:, 0], self.b[:, 0])
        for _ in range(60):
            with np.errstate(over="ignore", invalid="ignore"):
                added = power @ covariance @ power.T
                covariance = covariance + added
                power = power @ power
            if np.abs(added).max(initial=0.0) <= 1e-14 * np.abs(covariance).max(initial=0.0):
                return covariance
        return np.full_like(covariance, np.nan)

    def noise_gain_n_per_m(self) -> float:
        """Standard deviation of the force's error over that of a white sensor noise."""
        variance = float(self.c @ self.noise_covariance() @ self.c) + float(self.d[0]) ** 2
        return variance**0.5 if np.isfinite(variance) and variance >= 0.0 else float("inf")

    def lag_gain(self, frequency_hz: Array) -> Array:
        """Error of the published force over the residual force, at frequencies; shape (N,)."""
        eye = np.eye(len(self.a))
        response = np.empty(len(frequency_hz), np.complex128)
        for index, frequency in enumerate(frequency_hz):
            z = np.exp(2j * np.pi * frequency * self.interval_s)
            shifted: NDArray[np.complex128] = z * eye - self.a
            before = np.linalg.solve(shifted, self.b[:, 1])
            response[index] = self.c @ before + self.d[1]
        return np.abs(response)


class Loop:
    """The map from one measurement to the next, of numbers to numbers.

    Args:
        heights_m: Strut heights at which the bench is assumed to rest.
        assumed: Motion that the observers take the model to have; by differences on it if absent.
    """

    def __init__(
        self,
        plant: AnyPlant,
        observers: Sequence[AnyObserver],
        heights_m: Sequence[float],
        timing: SampleTiming,
        assumed: ErrorModel | None = None,
    ) -> None:
        self._plant, self._observers, self._timing = plant, StrutObservers(observers), timing
        self._heights_m = list(heights_m)
        start = plant.init(heights_m)
        self._no_inputs = (0.0,) * plant.inputs
        law_n = plant.load(start, [0.0] * plant.struts, self._no_inputs, AMBIENT_C).forces_n
        self._law_n: Array = np.array(law_n)
        self._assumed = assumed or linearise_at(plant, heights_m)
        self._state = self._steady_state()
        parts = [
            list(plant.numbers(start)),
            self._observers.numbers(self._state),
            self._heights_m * timing.delay,
        ]
        # Where the numbers of the model, of the observers and of the past heights end.
        self._ends = [0, *itertools.accumulate(len(part) for part in parts)]
        self.at_rest: Array = np.array([*itertools.chain(*parts)])
        """Numbers of model, observers and the model's past heights (the newest first), at rest."""

    def after(
        self,
        x: Array,
        noises_m: Sequence[float] | None = None,
        residuals_n: Sequence[float] | None = None,
        bench_m: Sequence[float] | None = None,
        slopes: Sequence[tuple[float, float]] | None = None,
    ) -> tuple[Array, Array]:
        """Numbers after the next measurement, and the errors of the published forces, (struts,).

        Args:
            x: Numbers after the last one.
            noises_m: Noise of each measurement; none if absent.
            residuals_n: Force that each strut of the bench has and the model's lacks, over the
                interval; the bench's motion is taken as given, and the model gets the forces'
                opposite. None if absent.
            bench_m: Heights of the bench when the measurement was true; at rest if absent.
            slopes: Stiffness (N/m) and damping (N·s/m) of each strut's law that the observers know
                of; those at the start if absent.
        """
        nothing = [0.0] * self._plant.struts
        noises_m, residuals_n = noises_m or nothing, residuals_n or nothing
        measured_m = self._heights_m if bench_m is None else bench_m
        numbers, observed, seen = (
            x[first:end].tolist() for first, end in itertools.pairwise(self._ends)
        )
        model = self._plant.state_of(numbers)
        state = self._observers.with_numbers(self._state, observed)
        if slopes is not None:
            state = self._observers.with_slopes(state, slopes)
        timing, count = self._timing, self._plant.struts
        for tick in range(1, timing.measured_every + 1):
            acting = [
                of_strut.virtual_force_n - residual_n
                for of_strut, residual_n in zip(state.struts, residuals_n, strict=True)
            ]
            loaded = self._plant.load(model, acting, self._no_inputs, AMBIENT_C)
            model = self._plant.step(loaded, timing.period_ns * 1e-9, self._no_inputs)
            now = [height_m for height_m, _ in model.struts]
            t_ns = tick * timing.period_ns
            innovations: list[Innovation | None] = [None] * count
            if tick == timing.measured_every:
                measured_ns = t_ns - timing.delay * timing.interval_ns
                compared = seen[-count:] if timing.delay else now
                innovations = [
                    Innovation(bench_m - model_m + noise_m, measured_ns)
                    for bench_m, model_m, noise_m in zip(
                        measured_m, compared, noises_m, strict=True
                    )
                ]
                seen = (now + seen)[: count * timing.delay]
            state = self._observers.step(state, t_ns, innovations)
        laws_n = self._plant.load(model, nothing, self._no_inputs, AMBIENT_C).forces_n
        found_n = [of_strut.residual_force_n for of_strut in state.struts]
        errors_n = np.array(laws_n) - self._law_n + found_n - residuals_n
        after = [*self._plant.numbers(model), *self._observers.numbers(state), *seen]
        return np.array(after), errors_n

    def linear(self, strut: int = 0, speed_m_per_s: float = USUAL_SPEED_M_PER_S) -> LinearLoop:
        """The loop about a motion at a speed, as one strut's noise and residual force drive it."""
        return self.linear_each([strut], speed_m_per_s)[0]

    def linear_each(
        self, struts: Sequence[int], speed_m_per_s: float = USUAL_SPEED_M_PER_S
    ) -> list[LinearLoop]:
        """The loop as noise and residual force of each of some struts drive it."""
        size, count, chosen = len(self.at_rest), self._plant.struts, list(struts)
        own = np.diagonal(self._assumed.mobility_per_kg)[chosen]
        widths = [_STEP * max(1.0, abs(value)) for value in self.at_rest.tolist()]
        widths += [_STEP] * len(chosen) + (_ACCELERATION_STEP_M_PER_S2 / own).tolist()

        def slopes_at(velocity_m_per_s: float) -> Array:
            moving, bench_m = self._moving(velocity_m_per_s)
            model = self._plant.state_of(moving[: self._ends[1]].tolist())
            slopes = self._plant.slopes(model, self._no_inputs, AMBIENT_C)

            def after(u: Array) -> Array:
                driven = np.zeros((2, count))
                driven[:, chosen] = u[size:].reshape(2, -1)
                noises_m, residuals_n = driven.tolist()
                x, errors_n = self.after(moving + u[:size], noises_m, residuals_n, bench_m, slopes)
                return np.append(x, errors_n[chosen])

            return central_differences(after, widths)

        slopes = 0.5 * (slopes_at(speed_m_per_s) + slopes_at(-speed_m_per_s))
        drives = size + np.arange(2 * len(chosen)).reshape(2, -1).T
        return [
            LinearLoop(
                slopes[:size, :size],
                slopes[:size, drive],
                slopes[size + place, :size],
                slopes[size + place, drive],
                self._timing.interval_ns * 1e-9,
            )
            for place, drive in enumerate(drives)
        ]

    def _moving(self, speed_m_per_s: float) -> tuple[Array, list[float]]:
        """Numbers of a model that has followed a motion, and the bench's heights then measured."""
        timing, count = self._timing, len(self._heights_m)
        model = self._plant.init(self._heights_m, [speed_m_per_s] * count)
        travel_m = speed_m_per_s * timing.interval_ns * 1e-9
        past_m = [
            height_m - number * travel_m
            for number in range(timing.delay)
            for height_m in self._heights_m
        ]
        moving = self.at_rest.copy()
        moving[: self._ends[1]] = self._plant.numbers(model)
        moving[self._ends[-2] :] = past_m
        if timing.delay:
            return moving, past_m[-count:]
        for _ in range(timing.measured_every):
            loaded = self._plant.load(model, [0.0] * count, self._no_inputs, AMBIENT_C)
            model = self._plant.step(loaded, timing.period_ns * 1e-9, self._no_inputs)
        return moving, [height_m for height_m, _ in model.struts]

    def _steady_state(self) -> ObserversState:
        """Observers that have followed a bench at rest for long, their last tick at time zero."""
        timing, observers = self._timing, self._observers
        delay_ns, ticks = timing.delay * timing.interval_ns, timing.delay + 2
        begin_ns = -ticks * timing.interval_ns
        starts = [
            Start(begin_ns - delay_ns, mobility, timing.interval_ns, delay_ns, stiffness, damping)
            for mobility, stiffness, damping in self._assumed.responses()
        ]
        state = observers.steady_state(starts, self._assumed)
        none = [None] * len(starts)
        for number in range(1 - ticks, 1):
            for tick in range(1 - timing.measured_every, 1):
                t_ns = number * timing.interval_ns + tick * timing.period_ns
                seen = [Innovation(0.0, t_ns - delay_ns)] * len(starts)
                state = observers.step(state, t_ns, seen if tick == 0 else none)
        return state
