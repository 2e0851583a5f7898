"""Numbers as an engineer writes them: unit, prefix, and no more digits than are certain."""

import math

from dart_model.effects import Parameter
from rig.diagnosis.outcome import Estimate, ModelErrors

_THIN_SPACE = "\u202f"
_NO_BREAK = "\u00a0"
_MINUS = "\u2212"
_NOT_IDENTIFIABLE = "not identifiable from these data"
_PREFIXES = ((1.0, 1.0, ""), (1e-3, 1e3, "m"), (0.0, 1e6, "µ"))
_OF_UNIT = str.maketrans({"·": "_", "²": "2", "³": "3", "°": "", "^": "", ".": "_"})
_SPELLED = {"coulomb": "Coulomb", "stribeck": "Stribeck"}


def number(value: float, decimals: int) -> str:
    """A number with thin spaces; with negative `decimals` it is rounded before the point."""
    text = f"{round(value, decimals):,.{max(decimals, 0)}f}".replace(",", _THIN_SPACE)
    return text.replace("-", _MINUS)


def three_digits(value: float) -> str:
    """A number with three digits."""
    if not value:
        return "0"
    rounded = float(f"{value:.2e}")  # 0.09996 has the decimals of 0.100
    return number(value, 2 - math.floor(math.log10(abs(rounded))))


def decimals_of(uncertainty: float) -> int:
    """Decimals that show the first two digits of an uncertainty."""
    return 1 - math.floor(math.log10(uncertainty))


def scale_of(largest: float, unit: str) -> tuple[float, str]:
    """Factor and unit in which to show a value; only lengths and times have prefixes."""
    if unit not in {"m", "s"} or largest == 0.0:
        return 1.0, unit
    factor, prefix = next(
        (factor, prefix) for least, factor, prefix in _PREFIXES if largest >= least
    )
    return factor, f"{prefix}{unit}"


def quantity(value: float, unit: str) -> str:
    """A value with three digits and its unit; a dash if it is not finite."""
    if not math.isfinite(value):
        return "–"
    factor, name = scale_of(abs(value), unit)
    scaled = value * factor
    if scaled == 0.0:
        return with_unit("0", unit)
    if not 1e-6 <= abs(scaled) < 1e7:
        return with_unit(f"{scaled:.2e}".replace("-", _MINUS), name)
    return with_unit(three_digits(scaled), name)


def with_unit(text: str, unit: str) -> str:
    """A number and its unit, which no line break separates."""
    return f"{text}{_NO_BREAK}{unit}" if unit else text


def value_and_interval(estimate: Estimate, unit: str) -> tuple[str, str]:
    """Value and 95 % interval with the digits that the interval justifies."""
    plain = quantity(estimate.value, unit)
    low, high = (math.nan if end is None else end for end in (estimate.low, estimate.high))
    if math.isfinite(low) != math.isfinite(high):
        is_low = math.isfinite(low)
        side, end = ("above", "upper") if is_low else ("below", "lower")
        return (
            plain,
            f"{side} {quantity(low if is_low else high, unit)}, {end} end {_NOT_IDENTIFIABLE}",
        )
    if not (math.isfinite(low) and low < high):
        return plain, _NOT_IDENTIFIABLE
    factor, name = scale_of(abs(estimate.value), unit)
    # A value far smaller than its interval keeps its digits too, or it would be shown as zero.
    half = 0.5 * (high - low)
    decimals = decimals_of(min(half, abs(estimate.value) or half) * factor)
    if not -7 < decimals < 7:
        return plain, f"{quantity(low, unit)} to {quantity(high, unit)}"
    value, low_text, high_text = (number(x * factor, decimals) for x in (estimate.value, low, high))
    return with_unit(value, name), f"{low_text} to {with_unit(high_text, name)}"


def plus_minus(value: float, half: float) -> str:
    """A value and half its interval, both with the digits that the interval justifies."""
    if not (math.isfinite(value) and math.isfinite(half) and half > 0.0):
        return three_digits(value) if math.isfinite(value) else "–"
    decimals = decimals_of(half)
    return f"{number(value, decimals)}{_NO_BREAK}±{_NO_BREAK}{number(half, decimals)}"


def ratio(value: float, reference: float) -> str:
    """Value over a reference; a dash where that has no meaning."""
    if not (reference > 0.0 and math.isfinite(value)):
        return "–"
    return f"{times(value / reference)}{_NO_BREAK}×"


def times(factor: float) -> str:
    """A factor with two digits, near 1 with three: 1.206 is above a limit of 1.2."""
    if factor >= 100.0:
        return number(factor, 1 - math.floor(math.log10(factor)))
    if factor < 2.0:
        return f"{factor:.2f}"
    return f"{factor:.1f}" if factor < 10.0 else f"{factor:.0f}"


def change(figure: ModelErrors) -> str:
    """Change from before to after, in per cent."""
    if not (figure.before > 0.0 and math.isfinite(figure.after)):
        return "–"
    share = figure.after / figure.before
    # Whole per cent, but near -100 % as many decimals as show the remaining share.
    decimals = -math.floor(math.log10(100.0 * share)) if 0.0 < share < 0.05 else 0
    sign = "+" if share > 1.0 else ""
    return f"{sign}{number(100.0 * (share - 1.0), min(max(decimals, 0), 4))}{_NO_BREAK}%"


def percent(share: float | None, decimals: int) -> str:
    """A share in per cent; a dash where there is none."""
    if share is None or not math.isfinite(share):
        return "–"
    return f"{number(100.0 * share, decimals)}{_NO_BREAK}%"


def share(part: float) -> str:
    """A share in per cent, with two digits that count."""
    if not math.isfinite(part):
        return "–"
    decimals = 1 - math.floor(math.log10(100.0 * part)) if part else 0
    return percent(part, min(max(decimals, 0), 6))


def capital(text: str) -> str:
    """The text with a capital first letter."""
    return text[:1].upper() + text[1:]


def label(parameter: Parameter) -> str:
    """Name of a parameter in words, without its unit."""
    unit = parameter.unit.lower().translate(_OF_UNIT)
    unit = "per_" + unit[2:] if unit.startswith("1/") else unit.replace("/", "_per_")
    stem = parameter.name.removesuffix(f"_{unit}") if unit else parameter.name
    return " ".join(_SPELLED.get(word, word) for word in stem.split("_"))
