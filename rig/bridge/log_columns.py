"""What the log keeps of a tick beside its frames: named numbers, and where they come from."""

from collections.abc import Sequence
from math import nan

from msgspec.structs import astuple

from rig.bridge.contract import Sensor, StepInput, StepOutput, StrutOutput
from rig.plan.quantities import FURTHER, PLACES, Quantity

_MEASURED = ("measured_height_m", "measured_t_ns")
_PUBLISHED = StrutOutput.__struct_fields__

STRUT_COLUMNS = (*_MEASURED, *_PUBLISHED)
"""Columns of each strut, prefixed with its name and a dot; NaN where there is nothing."""

_NOTHING_MEASURED = (nan,) * len(_MEASURED)
_NOTHING_PUBLISHED = (nan,) * len(_PUBLISHED)


def columns(
    struts: Sequence[str], measured: Sequence[Quantity], sensors: Sequence[Sensor] = ()
) -> tuple[str, ...]:
    """Names of the numbers that `Record` gives.

    Args:
        struts: Names of the struts.
        measured: Quantities beside heights that the bench sends.
        sensors: Further sensors.
    """
    of_struts = [f"{strut}.{name}" for strut in struts for name in STRUT_COLUMNS]
    of_sensors = [
        f"{sensor.name}.{name}"
        for sensor in sensors
        for name in (FURTHER[sensor.measures.value].column, "left_out")
    ]
    return (*(quantity.column for quantity in measured), *of_struts, *of_sensors)


class Record:
    """The numbers of a tick, in the order of `columns`.

    Args:
        measured: Quantities beside heights that the bench sends.
        sensors: How many further sensors there are.
    """

    def __init__(self, measured: Sequence[Quantity], sensors: int = 0) -> None:
        self._places = tuple(PLACES[quantity] for quantity in measured)
        self._sensors = sensors

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
        if self._sensors:
            read = {reading.sensor: reading.value for reading in given.readings}
            for sensor in range(self._sensors):
                numbers += (read.get(sensor, nan), float(sensor in output.left_out))
        return tuple(numbers)
