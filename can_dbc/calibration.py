"""Zero, direction and tare of a sensor: from what it reads to what is measured.

A DBC describes how a sensor counts. How the sensor is mounted is known at the bench alone.
"""

from dataclasses import replace
from typing import NamedTuple

from can_dbc.codec import si_step
from can_dbc.database import Message
from can_dbc.units import Dimension, si_conversion


class Calibration(NamedTuple):
    """Affine map of a reading in SI: `at + sign · (reading - reads)`.

    Attributes:
        reads: What the sensor reads where `at` is measured.
        at: What is measured there.
        is_reversed: Whether the reading falls while what is measured grows; the sign is -1 then.
    """

    reads: float = 0.0
    at: float = 0.0
    is_reversed: bool = False

    @property
    def sign(self) -> float:
        """1, or -1 of a reversed sensor."""
        return -1.0 if self.is_reversed else 1.0

    def apply(self, reading: float) -> float:
        """What is measured at a reading, both in SI."""
        return self.at + self.sign * (reading - self.reads)


def calibrate(
    message: Message, signal_name: str, dimension: Dimension, calibration: Calibration
) -> Message:
    """A message whose signal has the scale, offset and range of what is measured.

    Raises:
        DatabaseError: As for `compile_decoder`.
    """
    si_step(message, signal_name, dimension)  # refuses a signal that cannot be decoded
    signal = message.signal(signal_name)
    unit = si_conversion(signal.unit, dimension)

    def convert(value: float) -> float:
        """A physical value in the signal's unit after the calibration."""
        measured = calibration.apply(unit.factor * value + unit.offset)
        return (measured - unit.offset) / unit.factor

    ends = [None if end is None else convert(end) for end in (signal.minimum, signal.maximum)]
    minimum, maximum = reversed(ends) if calibration.is_reversed else ends
    calibrated = replace(
        signal,
        scale=calibration.sign * signal.scale,
        offset=convert(signal.offset),
        minimum=minimum,
        maximum=maximum,
    )
    return replace(message, signals={**message.signals, signal_name: calibrated})
