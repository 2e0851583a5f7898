"""The motion of a body between two times: the polynomial of fifth degree through both.

Position, velocity and acceleration at both ends determine it, and are its derivatives everywhere:
what rides on the body feels each change of its velocity as an acceleration. The functions take
floats, or arrays with one entry for each piece of a motion.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", float, NDArray[np.float64])


def coefficients(
    begin: Sequence[Value], end: Sequence[Value], duration_s: Value
) -> tuple[Value, Value, Value, Value, Value, Value]:
    """Coefficients of the position in the share of the duration, the constant first.

    Args:
        begin: Position (m), velocity (m/s) and acceleration (m/s²) at the beginning.
        end: The same at the end.
        duration_s: Time between them, above zero.
    """
    (p0, v0, a0), (p1, v1, a1), h = begin, end, duration_s
    first, second = v0 * h, 0.5 * a0 * h * h
    distance = p1 - p0 - first - second
    faster = v1 * h - first - 2.0 * second
    harder = 0.5 * (a1 - a0) * h * h
    return (
        p0,
        first,
        second,
        10.0 * distance - 4.0 * faster + harder,
        -15.0 * distance + 7.0 * faster - 2.0 * harder,
        6.0 * distance - 3.0 * faster + harder,
    )


def evaluate(
    parts: tuple[Value, Value, Value, Value, Value, Value], share: Value, duration_s: Value
) -> tuple[Value, Value, Value]:
    """Position, velocity and acceleration at a share of the duration."""
    c0, c1, c2, c3, c4, c5 = parts
    s, rate = share, 1.0 / duration_s
    position = c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
    velocity = c1 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))
    acceleration = 2.0 * c2 + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5))
    return position, rate * velocity, rate * rate * acceleration
