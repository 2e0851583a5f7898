"""What held-out data leave of a verdict."""

from math import isfinite

from rig.identify.diagnosis import BeforeAfter, Verdict

_CONFIRMED = 3.0
"""Error on held-out data, as a multiple of the floor, up to which a law holds there too."""

_WORSE = 1.1
"""A law that makes the error on held-out data larger by more than a tenth is wrong."""


def confirmed(verdict: Verdict, error: BeforeAfter, floor: float) -> Verdict:
    """The verdict that held-out data leave: a law that fails there explains nothing.

    Args:
        verdict: Verdict on the data that the law was learnt from.
        error: Error on held-out data without and with the law, in m or N.
        floor: What a perfect model would leave there, in the same unit.
    """
    if verdict == "nothing_missing" or error.after < _CONFIRMED * floor:
        return verdict
    if not isfinite(error.after) or error.after > _WORSE * error.before:
        return "not_explained"
    return "partly_explained" if verdict in ("explained", "ambiguous") else verdict
