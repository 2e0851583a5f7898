"""Meaning of an object that a device maps into its PDOs: name, number format, scale and unit.

References: CiA 406, "Device profile for encoders" (6004h position, 6005h measuring step, 6030h
speed, 6503h alarms); CiA 404, "Device profile for measuring devices and closed-loop controllers"
(6130h process value, 6131h unit, 6132h decimal digits, 6150h status), as printed in manuals of
devices.
"""

from dataclasses import dataclass

from can_dbc.errors import DatabaseError
from can_dbc.units import Dimension, si_conversion
from rig.sensors.canopen_objects import CanOpenObjects, number
from rig.sensors.canopen_units import unit_name

ENCODER, MEASURING_DEVICE = 406, 404
_LINEAR = (0x08, 0x0A)
"""Encoder types that measure a length; the others turn."""

_POSITIONS, _SPEED, _ACCELERATION = (0x6004, 0x6020), 0x6030, 0x6040
_STEPS, _STEP_OF_DISPLAY, _STEPS_PER_TURN = 0x6005, 0x6501, 0x6001
_ALARMS, _WARNINGS = 0x6503, 0x6505
_NM, _SPEED_STEP_MM_PER_S = 1e-6, 0.01
"""Units of the two steps: 1 nm in mm, and 0.01 mm/s."""

_PROCESS_VALUES, _FIELD_VALUES = (0x6130, 0x7130, 0x8130, 0x9130), (0x6100, 0x7100, 0x8100, 0x9100)
_UNIT, _DIGITS, _STATUS = 0x6131, 0x6132, 0x6150
_REAL = 0x6000
"""Family of the objects of a measuring device that are REAL32; the others are signed integers."""

_BY_DIMENSION = {
    Dimension.LENGTH: "POSITION",
    Dimension.FORCE: "FORCE",
    Dimension.TEMPERATURE: "TEMPERATURE",
    Dimension.VELOCITY: "SPEED",
    Dimension.ACCELERATION: "ACCELERATION",
}
_PRESSURES = ("Pa", "bar", "psi")


@dataclass(frozen=True)
class Meaning:
    """Meaning of an object.

    Attributes:
        name: Name of its signal in a DBC.
        is_float: Whether it is a REAL32 or REAL64.
        scale: Physical value of one raw step, in `unit`.
        unit: Unit as a DBC has it, empty if not known.
        is_alarm: Whether a value other than zero reports a fault.
        note: Remark for the reader of a scan, empty if none.
    """

    name: str
    is_signed: bool = False
    is_float: bool = False
    scale: float = 1.0
    unit: str = ""
    is_alarm: bool = False
    note: str = ""

    @property
    def dimension(self) -> Dimension | None:
        """Measured dimension; None for one that this project does not use."""
        return _dimension(self.unit)


def meaning(objects: CanOpenObjects, device_type: int, index: int, subindex: int) -> Meaning:
    """Meaning of an object that a device of some type (content of 1000h) maps into a PDO."""
    profile = device_type & 0xFFFF
    known = None
    if profile == ENCODER:
        known = _encoder_meaning(objects, device_type >> 16, index, subindex)
    elif profile == MEASURING_DEVICE:
        known = _channel_meaning(objects, index, subindex)
    return known or Meaning(f"X{index:04X}_{subindex}", bool(objects.is_signed(index, subindex)))


def _encoder_meaning(
    objects: CanOpenObjects, kind: int, index: int, subindex: int
) -> Meaning | None:
    ending = f"_{subindex}" if subindex > 1 else ""
    known = objects.is_signed(index, subindex)
    if index in _POSITIONS and kind in _LINEAR:
        step = number(objects, _STEPS, 1) or number(objects, _STEP_OF_DISPLAY)
        missing = "measuring step (6005h)"
        return _meaning_in_steps(f"POSITION{ending}", known is not False, step, _NM, "mm", missing)
    if index in _POSITIONS:
        return _angle(objects, f"POSITION{ending}", is_signed=bool(known))
    if index == _SPEED:
        step = number(objects, _STEPS, 2) if kind in _LINEAR else None
        missing = "speed step (6005h.2)"
        return _meaning_in_steps(
            f"SPEED{ending}", True, step, _SPEED_STEP_MM_PER_S, "mm/s", missing
        )
    if index == _ACCELERATION:
        return Meaning(f"ACCELERATION{ending}", True, note="its unit is not known")
    if index in (_ALARMS, _WARNINGS):
        name = "ALARMS" if index == _ALARMS else "WARNINGS"
        return Meaning(name, is_alarm=index == _ALARMS)
    return None


def _meaning_in_steps(
    name: str, is_signed: bool, step: int | None, size: float, unit: str, missing: str
) -> Meaning:
    """Meaning of a value in steps of so many times a size."""
    if step:
        return Meaning(name, is_signed, scale=step * size, unit=unit)
    return Meaning(name, is_signed, note=f"the device reports no {missing}")


def _angle(objects: CanOpenObjects, name: str, *, is_signed: bool) -> Meaning:
    note = "an angle: it gives a height only with the circumference of the drum"
    steps = number(objects, _STEPS_PER_TURN) or number(objects, _STEP_OF_DISPLAY)
    if steps:
        return Meaning(name, is_signed, scale=1.0 / steps, unit="turn", note=note)
    return Meaning(name, is_signed, note=note)


def _channel_meaning(objects: CanOpenObjects, index: int, subindex: int) -> Meaning | None:
    ending = f"_{subindex}"
    is_float = index & 0xF000 == _REAL
    if index == _STATUS:
        return Meaning(f"STATUS{ending}", is_alarm=True)
    if index in _FIELD_VALUES:
        note = "a raw input before scaling: the device does not report its unit"
        return Meaning(f"INPUT{ending}", not is_float, is_float, note=note)
    if index not in _PROCESS_VALUES:
        return None
    digits = 0 if is_float else number(objects, _DIGITS, subindex) or 0
    code = number(objects, _UNIT, subindex)
    unit = None if code is None else unit_name(code)
    if unit is None or digits > 9:
        why = "reports no unit (6131h)" if code is None else f"reports unit code {code:#010x}"
        note = f"the device {why}: write the unit into the DBC"
        return Meaning(f"VALUE{ending}", not is_float, is_float, note=note)
    note = "a mass, taken for the force of its weight" if unit.endswith("gf") else ""
    name = f"{_channel_name(unit)}{ending}"
    return Meaning(name, not is_float, is_float, 10.0**-digits, unit, note=note)


def _channel_name(unit: str) -> str:
    dimension = _dimension(unit)
    if dimension is not None:
        return _BY_DIMENSION[dimension]
    return "PRESSURE" if unit.endswith(_PRESSURES) else "VALUE"


def _dimension(unit: str) -> Dimension | None:
    for dimension in _BY_DIMENSION:
        try:
            si_conversion(unit, dimension)
        except DatabaseError:
            continue
        return dimension
    return None
