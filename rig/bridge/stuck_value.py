"""Whether a value that repeats itself exactly is that of a sensor which measures no more.

A sensor repeats a value where its bench rests, where motion turns, or where friction holds; how
often in a row is learnt from the run. One that repeats it for longer is stuck unless the bench
rests: then something else that is measured, a witness, is calm as well.
"""

import math

from msgspec import Struct

_FEWEST = 3
"""Repeats that are nothing unusual before any was seen."""

_CALM_NS = 1_000_000_000
"""Time after which a witness that stayed within its noise is calm: a slower motion errs little."""

_NOISE = 8.0 / math.sqrt(6.0)
"""Deviations of noise up to which a witness stays where it is, over the root of the mean square of
its second differences, which is the root of 6 for white noise of a deviation of 1."""

_UNKNOWN = -1
"""Repeats of a value before it has ever changed: it may rest."""


class Repeats(Struct, frozen=True, gc=False):
    """A value's repeats.

    Attributes:
        count: How often the value came again without a change; -1 before the first change.
        usual: How often it does.
        is_stuck: Whether it has come more often, and the witness is not calm.
        witness: The witness at the last repeat.
        change: By how much it had changed.
        squares: Sum of squares of its second differences since the value is the same.
        calm: What it has stayed near.
        calm_ns: Since when; a whole calm time ago until it leaves it.
    """

    count: int = _UNKNOWN
    usual: int = 0
    is_stuck: bool = False
    witness: float = 0.0
    change: float = 0.0
    squares: float = 0.0
    calm: float = 0.0
    calm_ns: int = 0


def update_repeats(
    repeats: Repeats, is_repeated: bool, witness: float, step: float, t_ns: int
) -> Repeats:
    """State after a value, which is the one before or is not, and a witness in steps of `step`.

    A value that was repeated more often than is usual, and changes at last, makes up to twice as
    many usual, and no more: a sensor that recovers was stuck.
    """
    count, usual = repeats.count, repeats.usual
    if not is_repeated:
        return Repeats(0, max(usual, min(count, 2 * usual + _FEWEST))) if count else repeats
    if count == _UNKNOWN:
        return repeats
    if not count:
        return Repeats(1, usual, False, witness, 0.0, 0.0, witness, t_ns - _CALM_NS)
    count += 1
    change = witness - repeats.witness
    squares = repeats.squares + (change - repeats.change) ** 2
    calm, calm_ns = repeats.calm, repeats.calm_ns
    if abs(witness - calm) > _NOISE * math.sqrt(squares / (count - 1)) + step:
        calm, calm_ns = witness, t_ns
    is_stuck = count > 2 * usual + _FEWEST and t_ns - calm_ns < _CALM_NS
    return Repeats(count, usual, is_stuck, witness, change, squares, calm, calm_ns)
