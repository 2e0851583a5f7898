"""The free length of a corrected spring, as one figure for its linear part and its laws.

A fit corrects stiffness and preload about mid-stroke, where they are nearly independent, and the
length about which laws such as a cubic spring act. An engineer signs a free length. The height at
which the linear part is free of force follows from the corrections with its interval; where it
agrees with the centre of the laws, both are estimates of one length, which are combined.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.spec import StrutSpec
from rig.diagnosis.problem.problem import LinearParameter, Problem, mid_stroke_m
from rig.diagnosis.search.fit import Fit, FitCovariance

Array = NDArray[np.float64]


class _Length(NamedTuple):
    """A length in m with the half-width of its 95 % interval."""

    value_m: float
    half_m: float

    def __str__(self) -> str:
        low, high = self.value_m - self.half_m, self.value_m + self.half_m
        return f"{self.value_m:.4f} m (95 %: {low:.4f} to {high:.4f} m)"


def notes_of_springs(
    problem: Problem, fit: Fit, covariance: FitCovariance, corrected: Sequence[StrutSpec]
) -> tuple[str, ...]:
    """What a corrected stiffness, preload and centre of laws amount to, for each strut."""
    notes: list[str] = []
    for index, (before, after) in enumerate(zip(problem.spec.struts, corrected, strict=True)):
        change = _changes(problem.linear, fit.parts.linear, index)
        if not change.get("stiffness") or after.stiffness_n_per_m == 0.0:
            continue
        preload_n = _preload_n(after) - _preload_n(before)
        zero_m = after.free_length_m + preload_n / after.stiffness_n_per_m
        middle_m = mid_stroke_m(problem.motions[index])
        slopes = {
            "preload": 1.0 / after.stiffness_n_per_m,
            "stiffness": (middle_m - zero_m) / after.stiffness_n_per_m,
        }
        gradient = _gradient(problem.linear, fit, index, slopes)
        zero = _Length(zero_m, covariance.factor * _std(covariance, gradient))
        notes.append(
            f"Stiffness and preload of strut {before.name} are corrected about {middle_m:.4g} m. "
            f"The corrected model states the preload about its free_length_m of "
            f"{after.free_length_m:.4g} m, where the same line is {preload_n:+.3g} N: a linear "
            f"spring of the free length {zero}."
        )
        if change.get("free_length"):
            both = np.stack([gradient, _gradient(problem.linear, fit, index, {"free_length": 1.0})])
            lengths_m = np.array([zero_m, after.free_length_m])
            spread = both @ covariance.covariance @ both.T
            note = _compare_lengths(lengths_m, spread, covariance.factor, before.name)
            notes.append(f"{_laws(fit, index)} acts about {after.free_length_m:.4f} m, {note}")
    return tuple(notes)


def _compare_lengths(lengths_m: Array, covariance: Array, factor: float, strut: str) -> str:
    """Whether the length at zero force and the centre of the laws are one length, and which."""
    apart_m = float(lengths_m[0] - lengths_m[1])
    half_m = factor * float(np.array([1.0, -1.0]) @ covariance @ np.array([1.0, -1.0])) ** 0.5
    if abs(apart_m) > half_m:
        return (
            f"{1e3 * abs(apart_m):.2g} mm from that free length (95 %: ±{1e3 * half_m:.2g} mm): a "
            f"constant force acts in strut {strut}, or another law."
        )
    length_m, variance_m2 = combine(lengths_m, covariance)
    return (
        "which agrees with that free length; both together give "
        f"{_Length(length_m, factor * variance_m2**0.5)}."
    )


def combine(values: Array, covariance: Array) -> tuple[float, float]:
    """Best estimate of one quantity from correlated estimates (n,), and its variance.

    That of least variance (Gauss and Markov).
    """
    weights = np.linalg.pinv(covariance, rcond=1e-13) @ np.ones(len(values))
    variance = 1.0 / float(weights.sum())
    return variance * float(weights @ values), variance


def _changes(linear: Sequence[LinearParameter], values: Array, strut: int) -> dict[str, float]:
    return {
        parameter.kind: float(value)
        for parameter, value in zip(linear, values, strict=True)
        if parameter.strut == strut
    }


def _preload_n(strut: StrutSpec) -> float:
    return sum(it.parameters["force_n"] for it in strut.effects if it.name == "preload")


def _laws(fit: Fit, strut: int) -> str:
    """The found laws of a strut that act about its free length."""
    names = [
        name for at, name in fit.candidate.new if at == strut and effect(name).about_free_length
    ]
    return " and ".join(names) or "the law of the given model"


def _gradient(
    linear: Sequence[LinearParameter], fit: Fit, strut: int, slopes: dict[str, float]
) -> Array:
    """Gradient of a length by the variables of a fit, shape (variables,)."""
    gradient = np.zeros(len(fit.solution.values))
    free = [p for p, is_free in zip(linear, fit.free, strict=True) if is_free]
    for variable, parameter in enumerate(free):
        if parameter.strut == strut and parameter.kind in slopes:
            gradient[variable] = slopes[parameter.kind] * float(fit.space.scale[variable])
    return gradient


def _std(covariance: FitCovariance, gradient: Array) -> float:
    return float(np.sqrt(max(gradient @ covariance.covariance @ gradient, 0.0)))
