"""What the log keeps of a tick beside its frames: named numbers, and where they come from."""

from collections.abc import Sequence
from math import nan

from msgspec.structs import astuple

from rig.core.contract import StepInput, StepOutput, StrutOutput
from rig.core.quantities import PLACES, Quantity

_MEASURED = ("measured_height_m", "measured_t_ns")
_PUBLISHED = StrutOutput.__struct_fields__

STRUT_COLUMNS = (*_MEASURED, *_PUBLISHED)
"""Columns of each strut, prefixed with its name and a dot; NaN where there is nothing."""

_NOTHING_MEASURED = (nan,) * len(_MEASURED)
_NOTHING_PUBLISHED = (nan,) * len(_PUBLISHED)


def columns(struts: Sequence[str], measured: Sequence[Quantity]) -> tuple[str, ...]:
    """Names of the numbers that `Record` gives.

    Args:
        struts: Names of the struts.
        measured: Quantities beside heights that the bench sends.
    """
    of_struts = [f"{strut}.{name}" for strut in struts for name in STRUT_COLUMNS]
    return (*(quantity.column for quantity in measured), *of_struts)


class Record:
    """The numbers of a tick, in the order of `columns`.

    Args:
        measured: Quantities beside heights that the bench sends.
    """

    def __init__(self, measured: Sequence[Quantity]) -> None:
        self._places = tuple(PLACES[quantity] for quantity in measured)

    def numbers(self, given: StepInput, output: StepOutput) -> tuple[float, ...]:
        """Numbers of a tick; NaN where nothing came or nothing was published."""
        numbers: list[float] = []
        for place in self._places:
            value = given.others[place]
            numbers.append(nan if value is None else value)
        for index, measured in enumerate(given.heights):
            if measured is None:
                numbers += _NOTHING_MEASURED
            else:
                numbers += (measured.height_m, measured.t_ns)
            numbers += astuple(output.struts[index]) if output.struts else _NOTHING_PUBLISHED
        return tuple(numbers)
