"""What the log keeps of a tick in addition to its frames: the columns, and their numbers."""

from collections.abc import Sequence
from math import nan

from msgspec.structs import astuple

from rig.bridge.values import StepInput, StepOutput, StrutOutput
from rig.channels.channel import Channel, Role

_MEASURED = ("measured_height_m", "measured_t_ns")
_PUBLISHED = StrutOutput.__struct_fields__

STRUT_COLUMNS = (*_MEASURED, *_PUBLISHED)
"""Columns of each strut, prefixed with its name and a dot; NaN where there is no value."""


class LogColumns:
    """Columns of a run's log, and the numbers of a tick in their order.

    First stand the quantities of the bench, then the struts, then the further sensors.

    Args:
        struts: Names of the struts.
        channels: Channels of the bench; their indices are their positions.
    """

    def __init__(self, struts: Sequence[str], channels: Sequence[Channel]) -> None:
        bench = [channel for channel in channels if channel.role is Role.BENCH]
        sensors = [channel for channel in channels if channel.role is Role.SENSOR]
        self._first = [len(bench) + i * len(STRUT_COLUMNS) for i in range(len(struts))]
        begin_of_sensors = len(bench) + len(struts) * len(STRUT_COLUMNS)
        self._column_of = [0] * len(channels)
        for column, channel in enumerate(bench):
            self._column_of[channel.index] = column
        for column, channel in enumerate(sensors):
            self._column_of[channel.index] = begin_of_sensors + 2 * column
        for channel in channels:
            if channel.role is Role.HEIGHT:
                self._column_of[channel.index] = self._first[channel.strut]
        self._is_height = [channel.role is Role.HEIGHT for channel in channels]
        self._blank = [nan] * begin_of_sensors + [nan, 0.0] * len(sensors)
        self.names: tuple[str, ...] = (
            *(channel.column for channel in bench),
            *(f"{strut}.{name}" for strut in struts for name in STRUT_COLUMNS),
            *(name for channel in sensors for name in (channel.column, f"{channel.name}.left_out")),
        )
        """Names of the columns."""

    def numbers(self, step_input: StepInput, output: StepOutput) -> tuple[float, ...]:
        """Numbers of a tick; NaN where nothing arrived or nothing was published."""
        numbers = self._blank.copy()
        for sample in step_input.samples:
            channel = sample.channel
            column = self._column_of[channel]
            numbers[column] = sample.value
            if self._is_height[channel]:
                numbers[column + 1] = sample.t_ns
        if output.struts:
            for first, strut in zip(self._first, output.struts, strict=True):
                numbers[first + 2 : first + 2 + len(_PUBLISHED)] = astuple(strut)
        for channel in output.left_out:
            numbers[self._column_of[channel] + 1] = 1.0
        return tuple(numbers)
