"""Scatter of a quantity from run to run, and the changes that cannot be seen in it.

A damper with few runs says little of its own scatter; the scatter of the same quantity in the other
dampers does. Each damper's variance is that of a chi-squared distribution about a variance of its
own, and these are drawn from one distribution of all dampers, whose two parameters are estimated by
moments of the logarithms (empirical Bayes). If the dampers scatter alike, a short series is tested
with the scatter of all; if they differ, with its own.

A slope, or a step, is seen with a chance of 95 % if it is as large as the critical value of its
test and the 95 % quantile of the error about it together. What is smaller cannot be relied upon to
be seen, and a report without an alarm says nothing of it.

References:
    Smyth, Linear models and empirical Bayes methods for assessing differential expression,
    Statistical Applications in Genetics and Molecular Biology 3 (2004), 6.2, for the moments.
    Cohen, Statistical Power Analysis for the Behavioral Sciences (1988), 1.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq  # pyright: ignore[reportUnknownVariableType]
from scipy.special import digamma, polygamma
from scipy.stats import t as student

_FEWEST = 4
"""Series from which on a scatter of all is estimated."""

_MOST_FREEDOM = 1e4
"""Degrees of freedom of the common scatter beyond which it is as good as known."""

POWER = 0.95
"""Chance with which a change that is called visible is seen."""


class Scatter(NamedTuple):
    """A variance from run to run, and its degrees of freedom."""

    variance: float
    freedom: float

    def pooled(self, common: "Scatter | None") -> "Scatter":
        """With what all dampers say of it."""
        if common is None:
            return self
        freedom = self.freedom + common.freedom
        variance = (self.freedom * self.variance + common.freedom * common.variance) / freedom
        return Scatter(variance, freedom)

    def visible_slope(self, squares: float, level: float) -> float:
        """Slope that a test at a level sees with a chance of 95 %.

        `squares` is the sum of squares of the times about their mean, without what other unknowns
        take of it.
        """
        critical = float(student.ppf(1.0 - 0.5 * level, self.freedom))
        more = float(student.ppf(POWER, self.freedom))
        return (critical + more) * (self.variance / squares) ** 0.5


def common_scatter(own: Sequence[Scatter]) -> Scatter | None:
    """The distribution of the variances of several series; None of few, or where one is zero."""
    used = [it for it in own if it.freedom >= 1.0 and it.variance > 0.0]
    if len(used) < _FEWEST:
        return None
    half = 0.5 * np.array([it.freedom for it in used])
    logs = np.log([it.variance for it in used]) - digamma(half) + np.log(half)
    mean, count = float(logs.mean()), len(used)
    more = float(np.sum((logs - mean) ** 2) / (count - 1) - np.mean(polygamma(1, half)))
    freedom = 2.0 * _inverse_trigamma(more) if more > 0.0 else _MOST_FREEDOM
    freedom = min(freedom, _MOST_FREEDOM)
    variance = float(np.exp(mean + digamma(0.5 * freedom) - np.log(0.5 * freedom)))
    return Scatter(variance, freedom)


def _inverse_trigamma(value: float) -> float:
    """Where the trigamma function, which falls, has a value."""

    def excess(x: float) -> float:
        return float(polygamma(1, x)) - value

    high = max(1.0 / value, 1.0) + 1.0  # trigamma(x) < 1/x + 1/x²
    return float(brentq(excess, 1e-3, 2.0 * high)) if excess(1e-3) > 0.0 else 1e-3
