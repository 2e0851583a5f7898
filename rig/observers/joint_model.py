"""What a joint filter estimates, how that moves, and what each sensor shows of it.

State: errors of the model's coordinates and of their rates, and of each observed strut the residual
force with two further states, a random walk that is integrated twice:

    d²x/dt² = A (x, dx/dt) + B (d - F_v),    dd/dt = e - d / T,    de/dt = f - e / T,

and the same of f, which white noise drives. T is so long that it makes no difference but for forces
that can be in balance with one another: their variances would grow without a bound.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.observers.covariances import discretise, limit_ahead
from rig.observers.error_filter import (
    ACCELERATION_STD_M_PER_S2,
    MOST_OF_MODEL,
    RATE_STD_M_PER_S,
    STEP_OF_MODEL,
    ErrorFilter,
)
from rig.observers.error_model import ErrorModel
from rig.observers.joint_lag import JointLagFilter
from rig.observers.protocol import REFERENCE_HEIGHT, Start
from rig.observers.strut_sensors import STRUT_SENSORS, StrutErrors

Array = NDArray[np.float64]
Inputs = tuple[tuple[int, Array], ...]
"""Virtual forces of the followed struts, and from when on; the oldest first."""

STATES = 3
"""Of a residual force, as in `rig.observers.error_filter`."""

_GRID = 16
"""Parts of the time between two heights to which the variances' times are rounded: at most a
thirtieth of what becomes unknown in that time is added too early or too late."""

_MOST_TRANSITIONS = 256
"""Times on that grid whose transitions are kept: those of all readings but ones behind a gap."""

_UNMEASURED_STD_M, _UNMEASURED_STD_M_PER_S = 0.01, 0.3
"""Of the coordinates (m or rad) that no height shows: the model starts there at rest under its
weight."""

_FORGETTING = 0.01
"""Rate 1 / T at which a residual force is forgotten, over its corner: a millionth of a constant
force is lost, and a variance that nothing bounds ends at 10^9 times that of a sensor."""

_ORDER = 5
"""Order of the Taylor series of the mean; exact where the model's own laws do nothing."""


class FollowedStrut(NamedTuple):
    """A strut whose height the model follows.

    Attributes:
        strut: Its index.
        noise_std_m: Standard deviation of its height.
        filter: Bandwidth of its residual force; None where its law is known.
    """

    strut: int
    noise_std_m: float
    filter: ErrorFilter | None


class ErrorMotion(NamedTuple):
    """How the error moves where the model is.

    Attributes:
        laws: Force of each strut's law by coordinates and rates, shape (struts, 2 n).
        generator: Derivative of the state by itself, shape (N, N).
        per_s: How fast the fastest part of the model moves by itself.
    """

    laws: Array
    generator: Array
    per_s: float


class SensorLine(NamedTuple):
    """A sensor: its reading by the state in SI, its deviation, and their ratio in units."""

    row: Array
    std: float
    scaled: Array


class JointModel:
    """What a joint filter estimates of a model about a state; arrays in SI unless said.

    Args:
        model: Motion of the model.
        starts: Start of each strut.
        followed: Struts whose heights are followed, one at least with a residual force.

    Attributes:
        followed: These, by their indices.
        own: Indices of the observed struts: those whose residual forces are estimated.
        size: Length N of the state.
        forces: Where the residual forces are in the state.
        interval_ns: Time between two heights of the observed strut that is measured least often.
        delay_ns: Largest delay of these heights.
        fastest: Corner of the fastest residual force in rad/s.
        units: Of the state, so that all variances are of one size.
        residuals: Residual force of each strut by the state, shape (struts, N).
        heights: Height of each strut by the state, shape (struts, N).
        rates: Its rate by the state.
        motion: Motion where the filter begins: that of its variances everywhere.
        lines: What is read, by channel and strut.
        steady: Covariance in units after a long time with every height at its interval.
        innovations: Steady variance of what is new in a strut's height, in that of its sensor.
        usual_n2: Steady variance of the struts' forces one interval after a measurement, in N².
        lag: Filter of the innovations that shows a lag.
    """

    def __init__(
        self,
        model: ErrorModel,
        starts: Sequence[Start],
        followed: Sequence[FollowedStrut],
    ) -> None:
        self._model, self.starts = model, tuple(starts)
        self.followed = {item.strut: item for item in followed}
        self._filters = {it.strut: it.filter for it in followed if it.filter is not None}
        self.own = list(self._filters)
        self._n = n = len(model.by_force)
        count = len(self.own)
        self.size = 2 * n + STATES * count
        self.forces = slice(2 * n, 2 * n + count)
        self.interval_ns = max(self.starts[strut].interval_ns for strut in self.own)
        self.delay_ns = max(self.starts[strut].delay_ns for strut in self.followed)
        self.fastest = max(item.omega for item in self._filters.values())
        self._unit_m = min(item.noise_std_m for item in followed)
        self._unit_s = 1.0 / self.fastest
        self.units = self._make_units()
        none = np.zeros((len(model.heights), self.size))
        self.heights, self.rates, self.residuals = none.copy(), none.copy(), none.copy()
        self.heights[:, :n], self.rates[:, n : 2 * n] = model.heights, model.heights
        self.residuals[self.own, np.arange(count) + 2 * n] = 1.0
        force_errors = self.residuals.copy()
        force_errors[:, : 2 * n] = model.laws
        self._scaled_forces = force_errors * self.units
        self._push = np.zeros((self.size, len(self.followed)))
        self._push[n : 2 * n] = -model.by_force[:, list(self.followed)]
        self._generator = self._make_generator()
        self.motion = self.motion_with(model.laws)
        errors = zip(self.heights, self.rates, force_errors, strict=True)
        self.lines = self._make_lines([StrutErrors(*of_strut) for of_strut in errors])
        self._density = self._make_density()
        self._transitions: dict[int, tuple[Array, Array]] = {}
        self.steady, gains, innovations = self._find_steady()
        variances = np.diagonal(innovations).tolist()
        self.innovations = dict(zip(self.followed, variances, strict=True))
        late = 1 + round(self.delay_ns / self.interval_ns)
        self.usual_n2 = np.diagonal(self.force_covariance(self.ahead(self.steady, late * _GRID)))
        self.lag = self._make_lag(gains, innovations)

    def _make_units(self) -> Array:
        of_rate = self._unit_m / self._unit_s
        of_force = of_rate / self._unit_s / self._mobilities_per_kg(self.own)
        of_forces = [of_force / self._unit_s**power for power in range(STATES)]
        of_motion = np.repeat([self._unit_m, of_rate], self._n)
        return np.concatenate([of_motion, *of_forces])

    def _mobilities_per_kg(self, struts: Sequence[int]) -> Array:
        return np.array([self.starts[strut].mobility_per_kg for strut in struts])

    def forces_by_accelerations(self, struts: Sequence[int]) -> Array:
        """Forces in some struts (N) by accelerations of their heights (m/s²)."""
        together = self._model.mobility_per_kg[np.ix_(struts, struts)]
        return np.asarray(np.linalg.pinv(together, rcond=1e-9), np.float64)

    def _make_lines(self, errors: Sequence[StrutErrors]) -> dict[tuple[int, int], SensorLine]:
        found = {
            (REFERENCE_HEIGHT, strut): (errors[strut].height, item.noise_std_m)
            for strut, item in self.followed.items()
        }
        for strut, start in enumerate(self.starts):
            for channel in start.sensors:
                row = STRUT_SENSORS[channel.quantity].error(errors[strut])
                found[channel.index, strut] = row, channel.noise_std
        return {
            key: SensorLine(row, std, row * self.units / std) for key, (row, std) in found.items()
        }

    def _make_generator(self) -> Array:
        """Derivative of the state by itself, without what the model does to its coordinates."""
        n, count = self._n, len(self.own)
        generator = np.zeros((self.size, self.size))
        generator[:n, n : 2 * n] = np.eye(n)
        generator[n : 2 * n, self.forces] = self._model.by_force[:, self.own]
        forces = generator[2 * n :, 2 * n :]
        forces[:] = np.eye(STATES * count, k=count)
        forgetting = [_FORGETTING * item.omega for item in self._filters.values()]
        np.fill_diagonal(forces, np.negative(forgetting * STATES))
        return generator

    def motion_with(self, laws: Array) -> ErrorMotion:
        """Motion with forces of the struts' laws by coordinates and rates, shape (struts, 2 n)."""
        n, generator = self._n, self._generator.copy()
        motion = self._model.free + self._model.by_force @ laws
        generator[n : 2 * n, : 2 * n] = motion
        stiffness, damping = (np.abs(part).sum(axis=1).max() for part in np.hsplit(motion, 2))
        return ErrorMotion(laws, generator, max(math.sqrt(stiffness), float(damping)))

    def with_slopes(
        self, motion: ErrorMotion, slopes: Sequence[tuple[float, float]]
    ) -> ErrorMotion:
        """Motion with stiffness (N/m) and damping (N·s/m) of each strut's law."""
        stiffness, damping = -np.array(slopes).T[:, :, None]
        heights = self._model.heights
        laws = np.hstack([stiffness * heights, damping * heights])
        return motion if np.array_equal(laws, motion.laws) else self.motion_with(laws)

    def _make_density(self) -> Array:
        """Density of the noise that drives the residual forces, in units, (N, N).

        That of one strut alone gives a Butterworth filter (`rig.observers.error_filter`).
        """
        density = np.zeros(self.size)
        for place, (strut, item) in enumerate(self._filters.items(), self.size - len(self.own)):
            interval_s = self.starts[strut].interval_ns * 1e-9
            of_acceleration = item.noise_std_m**2 * item.omega**10 * interval_s
            density[place] = of_acceleration * self._unit_s**9 / self._unit_m**2
        return np.diag(density)

    def _find_steady(self) -> tuple[Array, Array, Array]:
        """Steady covariance and gains after all heights, in units, and innovations' covariance."""
        transition, noise = self._transition(_GRID)
        struts = list(self.followed)
        rows = np.array([self.lines[REFERENCE_HEIGHT, strut].scaled for strut in struts])
        often = self._often()
        ahead = limit_ahead(transition, noise, rows.T @ (often[:, None] * rows))
        seen = ahead @ rows.T
        innovations = rows @ seen + np.diag(1.0 / often)
        gains: Array = np.asarray(np.linalg.solve(innovations, seen.T), np.float64).T
        after: Array = ahead - gains @ seen.T
        return 0.5 * (after + after.T), gains, innovations

    def _often(self) -> Array:
        """How many heights of each followed strut come in an interval."""
        return np.array([self.interval_ns / self.starts[it].interval_ns for it in self.followed])

    def _make_lag(self, gains: Array, innovations: Array) -> JointLagFilter:
        stds_m = np.array([item.noise_std_m for item in self.followed.values()])
        # An innovation stands until the next one: seldom ones act as weakly as often as they come,
        # and are noise of a lower frequency.
        often = self._often()
        in_si = self.units[:, None] * gains / stds_m * often
        stds_m = stds_m / np.sqrt(often)
        struts = list(self.followed)
        n, interval_s = self._n, self.interval_ns * 1e-9
        # What the model itself answers to an error of its heights.
        coordinates = np.linalg.pinv(self._model.heights[struts], rcond=1e-9)
        by_itself = self._model.free + self._model.by_force @ self._model.laws
        own = self._model.heights[self.own] @ by_itself * interval_s
        by_error, by_rate = own[:, :n] @ coordinates, own[:, n:] @ coordinates
        is_own = np.array([[float(strut == own) for strut in struts] for own in self.own])
        return JointLagFilter(
            [item.omega for item in self._filters.values()],
            interval_s,
            (
                self.heights[self.own] @ in_si - by_rate,
                self.rates[self.own] @ in_si - by_error,
                is_own,
            ),
            self.forces_by_accelerations(self.own),
            innovations * np.outer(stds_m, stds_m),
        )

    def prior(self) -> Array:
        """Covariance in units before anything was measured but the heights at the start."""
        n, struts = self._n, list(self.followed)
        rows = self._model.heights[struts]
        spread = np.linalg.pinv(rows, rcond=1e-9)
        unseen = np.eye(n) - spread @ rows
        heights_m2 = np.square([item.noise_std_m for item in self.followed.values()])
        prior = np.zeros((self.size, self.size))
        positions, rates = prior[:n, :n], prior[n : 2 * n, n : 2 * n]
        positions[:] = spread @ np.diag(heights_m2) @ spread.T + _UNMEASURED_STD_M**2 * unseen
        rates[:] = RATE_STD_M_PER_S**2 * spread @ spread.T + _UNMEASURED_STD_M_PER_S**2 * unseen
        corners = np.array([item.omega for item in self._filters.values()])
        forces_n = ACCELERATION_STD_M_PER_S2 / self._mobilities_per_kg(self.own)
        stds = np.concatenate([forces_n * corners**power for power in range(STATES)])
        np.fill_diagonal(prior[2 * n :, 2 * n :], stds**2)
        return prior / np.outer(self.units, self.units)

    def force_covariance(self, covariance: Array) -> Array:
        """Covariance of the errors of the struts' forces in N², (struts, struts), of one in units.

        Of the force that a model's law lacks where the model is.
        """
        return self._scaled_forces @ covariance @ self._scaled_forces.T

    def laws_n(self, mean: Array, motion: ErrorMotion) -> Array:
        """Forces by which the laws err because the model is not where the bench is, (struts,)."""
        return motion.laws @ mean[: 2 * self._n]

    def mean_at(
        self, mean: Array, from_ns: int, to_ns: int, inputs: Inputs, motion: ErrorMotion
    ) -> Array:
        """The state at a later time, under the inputs in between."""
        last = len(inputs) - 1
        for index, (_, force_n) in enumerate(inputs):
            end_ns = to_ns if index == last else min(inputs[index + 1][0], to_ns)
            if end_ns <= from_ns:
                continue
            h = (end_ns - from_ns) * 1e-9
            from_ns = end_ns
            push = self._push @ force_n
            # A step in which the model itself hardly moves: what its law does is a Taylor series.
            count = max(1, math.ceil(min(h * motion.per_s, MOST_OF_MODEL) / STEP_OF_MODEL))
            for _ in range(count):
                mean = _taylor_step(mean, push, h / count, motion.generator)
        return mean

    def ahead(self, covariance: Array, number: int) -> Array:
        """Covariance in units some parts of an interval later (`grid_index`)."""
        if number <= 0:
            return covariance
        transition, noise = self._transition(number)
        ahead = transition @ covariance @ transition.T + noise
        return 0.5 * (ahead + ahead.T)

    def _transition(self, number: int) -> tuple[Array, Array]:
        found = self._transitions.get(number)
        if found is None:
            if len(self._transitions) >= _MOST_TRANSITIONS:
                self._transitions.clear()
            rates = self.motion.generator * np.outer(1.0 / self.units, self.units) * self._unit_s
            time = number / _GRID * self.interval_ns * 1e-9 / self._unit_s
            own = self.motion.per_s * self._unit_s
            found = self._transitions[number] = discretise(rates, self._density, time, own)
        return found

    def grid_index(self, t_ns: int) -> int:
        """Index of a time on the grid of the variances."""
        return round((t_ns - self.starts[0].t_ns) * _GRID / self.interval_ns)

    def numbers(self, mean: Array, forces_n: Sequence[Array]) -> list[float]:
        """State and virtual forces as numbers of one size, all in m."""
        per_force = self._mobilities_per_kg(list(self.followed)) * self._unit_s**2
        parts = [mean * (self._unit_m / self.units), *(force_n * per_force for force_n in forces_n)]
        return np.concatenate(parts).tolist()

    def of_numbers(self, numbers: Sequence[float]) -> tuple[Array, list[Array]]:
        """State and virtual forces that `numbers` returned."""
        mean = np.array(numbers[: self.size]) * (self.units / self._unit_m)
        per_force = self._mobilities_per_kg(list(self.followed)) * self._unit_s**2
        forces = np.array(numbers[self.size :]).reshape(-1, len(self.followed)) / per_force
        return mean, list(forces)


def _taylor_step(mean: Array, push: Array, h: float, generator: Array) -> Array:
    """The state after a step of the linear motion under a constant push."""
    change: Array = generator @ mean
    change += push
    change *= h
    mean = mean + change
    for order in range(2, _ORDER + 1):
        change = generator @ change
        change *= h / order
        mean += change
    return mean
