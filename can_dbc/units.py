"""Units of a DBC's signals, converted to SI once when a codec is compiled."""

import math
import re
import tokenize
from enum import Enum
from functools import cache
from typing import Any, NamedTuple, cast

import pint

from can_dbc.errors import DatabaseError


class Dimension(Enum):
    """What a signal measures; the value is the unit in which a codec hands it out or takes it."""

    LENGTH = "m"
    VELOCITY = "m/s"
    ACCELERATION = "m/s^2"
    FORCE = "N"
    TORQUE = "N*m"
    STIFFNESS = "N/m"
    DAMPING = "N*s/m"
    TEMPERATURE = "degC"
    MASS = "kg"
    TIME = "s"
    ANGLE = "rad"
    ANGULAR_VELOCITY = "rad/s"
    POWER = "W"
    ENERGY = "J"
    NUMBER = "1"


class SiConversion(NamedTuple):
    """Affine map from a unit to its SI unit: `si = factor * value + offset`."""

    factor: float
    offset: float


IDENTITY = SiConversion(1.0, 0.0)

# Unit strings come from a foreign file and pint evaluates powers, so only products and quotients
# of names with a small exponent get through.
_TERM = r"\(*(?:1|[A-Za-zµμ°Å%_]+0?)(?:(?:\^|\*\*)-?[1-4]|[²³])?\)*"
_UNIT = re.compile(rf"{_TERM}(?:\s*[*/·. ]\s*{_TERM})*")
_UNIT_LENGTH_MAX = 40

# Spellings common in DBC files that mean something else, or nothing, to pint.
_SPELLINGS: dict[tuple[Dimension, str], str] = {
    (Dimension.ACCELERATION, "g"): "standard_gravity",
    (Dimension.TEMPERATURE, "C"): "degC",
    (Dimension.TEMPERATURE, "F"): "degF",
    (Dimension.TEMPERATURE, "deg C"): "degC",
    (Dimension.TEMPERATURE, "deg F"): "degF",
    (Dimension.TORQUE, "Nm"): "N*m",
    (Dimension.ANGLE, "°"): "deg",
    (Dimension.ANGULAR_VELOCITY, "°/s"): "deg/s",
    (Dimension.TORQUE, "mNm"): "mN*m",
    (Dimension.TORQUE, "kNm"): "kN*m",
    (Dimension.DAMPING, "Ns/m"): "N*s/m",
    (Dimension.DAMPING, "Ns/mm"): "N*s/mm",
    (Dimension.DAMPING, "kNs/m"): "kN*s/m",
}


def si_conversion(unit: str, dimension: Dimension) -> SiConversion:
    """Factor and offset from a unit, as the DBC writes it, to the unit that `dimension` names.

    Units are such as `mm`, `in`, `kN`, `lbf`, `degF` or `m/s^2`; `g` is standard gravity where an
    acceleration is expected.

    Raises:
        DatabaseError: The unit is missing, unknown, or of another dimension. The message does
            not know the signal; the caller puts its name in front.
    """
    text = unit.rpartition(":")[2].strip()  # some write `distance:mm`
    if dimension is Dimension.NUMBER and text in {"", "-", "1"}:
        return IDENTITY
    expected = f"expected {dimension.name.lower()} in a unit such as {dimension.value}"
    if not text:
        raise DatabaseError(f"no unit: give the unit in the DBC, {expected}")
    text = _SPELLINGS.get((dimension, text), text)
    if len(text) > _UNIT_LENGTH_MAX or _UNIT.fullmatch(text) is None:
        raise DatabaseError(f"unit {unit!r} is not understood, {expected}")
    try:
        # Two points give an affine map, and the zero of every unit but temperatures is exact.
        offset = _to_si(0.0, text, dimension)
        factor = _to_si(1.0, text, dimension) - offset
        probe = _to_si(100.0, text, dimension)
    except pint.DimensionalityError:
        raise DatabaseError(f"unit {unit!r} is of another dimension, {expected}") from None
    except (pint.PintError, tokenize.TokenError, ArithmeticError, TypeError, ValueError):
        raise DatabaseError(f"unit {unit!r} is not known, {expected}") from None
    except AssertionError:  # raised by pint for products of logarithmic units
        raise DatabaseError(f"unit {unit!r} is logarithmic, {expected}") from None
    if not math.isclose(probe, 100.0 * factor + offset, rel_tol=1e-9):
        raise DatabaseError(f"unit {unit!r} is not linear, {expected}")
    return SiConversion(factor, offset)


@cache
def _registry() -> pint.UnitRegistry[Any]:
    return pint.UnitRegistry()


def _to_si(value: float, unit: str, dimension: Dimension) -> float:
    registry = _registry()
    quantity = cast("Any", registry.Quantity)(value, registry.parse_units(unit))
    target = "dimensionless" if dimension is Dimension.NUMBER else dimension.value
    return float(quantity.to(target).magnitude)
