"""Numbers as an engineer writes them."""

import math
import re

from hypothesis import given
from hypothesis import strategies as st

from rig.diagnosis.outcome import Estimate
from rig.pages.number_formats import number, quantity, value_and_interval

THIN, NO_BREAK, MINUS = "\u202f", "\u00a0", "\u2212"


def read(text):
    return float(text.replace(THIN, "").replace(MINUS, "-"))


@given(st.floats(-1e8, 1e8), st.integers(-3, 6))
def test_a_number_is_read_back_within_its_last_digit(value, decimals):
    text = number(value, decimals)
    assert abs(read(text) - value) <= 0.5 * 10.0**-decimals * (1.0 + 1e-9)
    assert "-" not in text
    assert not re.search(r"\d{4}", text.split(".")[0])


@given(st.floats(1e-9, 1e6), st.sampled_from(["m", "s", "N", "N/m"]))
def test_a_quantity_has_three_digits_and_its_unit(value, unit):
    text, shown = quantity(value, unit).split(NO_BREAK)
    factor = {"mm": 1e3, "µm": 1e6, "ms": 1e3, "µs": 1e6}.get(shown, 1.0)
    assert math.isclose(read(text), factor * value, rel_tol=5.1e-3)


@given(st.one_of(st.just(0.0), st.floats(1e-3, 1e4), st.floats(-1e4, -1e-3)), st.floats(1e-3, 1e3))
def test_value_and_ends_of_an_interval_have_the_same_digits(value, half):
    text, interval = value_and_interval(Estimate(value, value - half, value + half), "N")
    low, high = interval.split(" to ")
    texts = [text.split(NO_BREAK)[0], low, high.split(NO_BREAK)[0]]
    assert len({len(item.partition(".")[2]) for item in texts}) == 1
    least = half if value == 0.0 else min(half, abs(value))
    for item, exact in zip(texts, (value, value - half, value + half), strict=True):
        assert abs(read(item) - exact) <= 0.5 * least
