"""The damper of a corrected model in figures: its force and its slope over velocity.

A fit states a damper as a linear damping and laws that add to it or take from it, such as what is
lost beyond a knee. An engineer reads force over velocity, and the slope below and beyond a knee.
Both follow from the parameters; their intervals follow from the covariance of the fit to first
order, which includes that the parameters depend on one another.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C, Effect, effect
from dart_model.effects.calling import STRUT, force_over_arrays
from rig.diagnosis.outcome import DamperForce, Estimate
from rig.diagnosis.problem.problem import (
    Problem,
    ResidualForces,
    mid_stroke_m,
    slots_of,
    strut_constants,
    strut_effects,
)
from rig.diagnosis.search.fit import Fit, FitCovariance, effect_variables

Array = NDArray[np.float64]

_STEPS = (1.0, 2.0, 3.0, 5.0)
"""Speeds of a table in each decade, as on the sheet of a damper."""

_DECADES = 1.3
"""Decades below the largest speed that a table covers: slower, dry friction hides the valves."""

_REACHED = 0.999
"""Share of the time in which a direction's largest speed of the table is not exceeded: where few
samples reach it, its interval shows that."""

_NEAR = 0.02
"""Distance of the two speeds between which a slope is taken, as a share of the speed."""

_STEP = 1e-4
"""Step of a finite difference, in units of a search variable (whose deviation is about one)."""


_DAMPING = STRUT.index("damping_n_s_per_m")


class Damper(NamedTuple):
    """What gives a strut's force over velocity.

    Attributes:
        laws: Laws of the damper, with their parameters.
        constants: Free length, stiffness, linear damping and gravity, which laws may read.
        height_m: Height at which laws that depend on it are evaluated.
    """

    laws: Sequence[tuple[Effect, Sequence[float]]]
    constants: Sequence[float]
    height_m: float

    def force_n(self, velocity_m_per_s: float) -> float:
        """Force, positive when it pushes the bodies apart: negative in rebound."""
        motion = 0.0, self.height_m, velocity_m_per_s, 0.0, AMBIENT_C
        total = -self.constants[_DAMPING] * velocity_m_per_s
        for law, values in self.laws:
            total += force_over_arrays(law)(*motion, (), values, self.constants)
        return total

    def figures(self, velocities_m_per_s: Array) -> Array:
        """Force in N and damping in N·s/m at each velocity, shape (2, N)."""
        rows: list[tuple[float, float]] = []
        for velocity in velocities_m_per_s.tolist():
            near = 0.5 * _NEAR * velocity
            slope = (self.force_n(velocity - near) - self.force_n(velocity + near)) / (2.0 * near)
            rows.append((self.force_n(velocity), slope))
        return np.array(rows).reshape(-1, 2).T


def damper_forces(
    problem: Problem,
    fit: Fit,
    covariance: FitCovariance,
    after: Sequence[ResidualForces | None],
) -> tuple[DamperForce, ...]:
    """Forces of each strut whose damper is described by a law, at speeds that were reached."""
    tracks = [forces.track for forces in after if forces is not None]
    if not tracks:
        return ()
    rows: list[DamperForce] = []
    for index, strut in enumerate(problem.spec.struts):
        described = _describe_damper(problem, fit, index)
        if described is None:
            continue
        motion = np.concatenate([track.velocities_m_per_s[index] for track in tracks])
        with suppress(ArithmeticError, ValueError):  # a law without a value at this motion
            rows += _forces_of(strut.name, described, list_velocities(motion), fit, covariance)
    return tuple(rows)


def _forces_of(
    strut: str,
    described: Callable[[Array], Damper],
    velocities: Array,
    fit: Fit,
    covariance: FitCovariance,
) -> list[DamperForce]:
    """Forces of one damper, which the search variables describe."""
    values, halves = with_half_widths(
        lambda variables: described(variables).figures(velocities), fit, covariance
    )
    return [
        DamperForce(strut, velocity, *(_estimate(values[k, i], halves[k, i]) for k in (0, 1)))
        for i, velocity in enumerate(velocities.tolist())
    ]


def list_velocities(velocity_m_per_s: Array) -> Array:
    """Velocities of a table: round ones that a motion of shape (N,) reaches in each direction."""
    found: list[float] = []
    for sign in (-1.0, 1.0):
        speeds = sign * velocity_m_per_s
        speeds = speeds[speeds > 0.0]
        if not len(speeds):
            continue
        largest = float(np.quantile(speeds, _REACHED))
        if largest <= 0.0:
            continue
        decades = np.arange(np.floor(np.log10(largest)) - 3, np.floor(np.log10(largest)) + 1)
        # Rounded, as a power of ten is not exact.
        grid = [float(f"{step * 10.0**decade:.1g}") for decade in decades for step in _STEPS]
        kept = [speed for speed in grid if 10.0**-_DECADES * largest <= speed <= largest]
        found += [sign * speed for speed in kept]
    return np.array(sorted(found))


def with_half_widths(
    figures: Callable[[Array], Array], fit: Fit, covariance: FitCovariance
) -> tuple[Array, Array]:
    """Figures of a fit and half-widths of their 95 % intervals, to first order.

    `figures` gives them by the values of the search variables.
    """
    best, space = fit.solution.values, fit.space
    at_best = figures(best)
    gradients: list[Array] = []
    for variable in range(len(best)):
        moved = best.copy()
        if space.logarithmic[variable]:
            moved[variable] *= np.exp(_STEP)
        else:
            moved[variable] += _STEP * float(space.scale[variable])
        gradients.append((figures(moved) - at_best) / _STEP)
    gradient = np.stack(gradients)
    variance = np.einsum("i...,ij,j...->...", gradient, covariance.covariance, gradient)
    return at_best, covariance.factor * np.sqrt(np.maximum(variance, 0.0))


def _describe_damper(problem: Problem, fit: Fit, strut: int) -> Callable[[Array], Damper] | None:
    """A strut's damper by the search variables; None without a law, or with one of a state."""
    rows = [
        (row, effect(name))
        for row, (at, name) in enumerate(strut_effects(problem, fit.candidate))
        if at == strut and effect(name).family == "nonlinear_damping"
    ]
    if not rows or any(law.states for _, law in rows):
        return None
    slots, variables = slots_of(problem, fit.candidate).each, effect_variables(problem, fit)
    height_m = mid_stroke_m(problem.motions[strut])
    free, given = np.flatnonzero(fit.free), fit.parts.effects

    def described(values: Array) -> Damper:
        linear = fit.parts.linear.copy()
        linear[free] = values[: len(free)]
        constants = strut_constants(problem, linear)[strut, :4].tolist()
        laws = [
            (law, values[variables[row]] if row in variables else given[slots[row].parameters])
            for row, law in rows
        ]
        return Damper([(law, own.tolist()) for law, own in laws], constants, height_m)

    return described


def _estimate(value: float, half: float) -> Estimate:
    if not np.isfinite(half):
        return Estimate(float(value), None, None)
    return Estimate(float(value), float(value - half), float(value + half))
