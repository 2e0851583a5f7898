"""Units of the DBC become SI, or the unit is refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.errors import DatabaseError
from can_dbc.units import Dimension, si_conversion


@pytest.mark.parametrize(
    ("unit", "dimension", "value", "si"),
    [
        ("m", Dimension.LENGTH, 1.5, 1.5),
        ("mm", Dimension.LENGTH, 1500.0, 1.5),
        ("cm", Dimension.LENGTH, 2.0, 0.02),
        ("µm", Dimension.LENGTH, 2.0, 2e-6),
        ("in", Dimension.LENGTH, 10.0, 0.254),
        ("kN", Dimension.FORCE, 0.25, 250.0),
        ("lbf", Dimension.FORCE, 1.0, 4.4482216152605),
        ("kgf", Dimension.FORCE, 1.0, 9.80665),
        ("mm/s", Dimension.VELOCITY, 250.0, 0.25),
        ("g", Dimension.ACCELERATION, 2.0, 19.6133),
        ("m/s²", Dimension.ACCELERATION, 2.0, 2.0),
        ("m/s^2", Dimension.ACCELERATION, 2.0, 2.0),
        ("N/mm", Dimension.STIFFNESS, 30.0, 30_000.0),
        ("Ns/m", Dimension.DAMPING, 30.0, 30.0),
        ("lbf/(in/s)", Dimension.DAMPING, 1.0, 175.126835246),
        ("degC", Dimension.TEMPERATURE, 21.0, 21.0),
        ("°C", Dimension.TEMPERATURE, 21.0, 21.0),
        ("degF", Dimension.TEMPERATURE, 212.0, 100.0),
        ("K", Dimension.TEMPERATURE, 273.15, 0.0),
        ("ms", Dimension.TIME, 5.0, 0.005),
        ("%", Dimension.NUMBER, 50.0, 0.5),
        ("", Dimension.NUMBER, 7.0, 7.0),
    ],
)
def test_value_becomes_si(unit: str, dimension: Dimension, value: float, si: float) -> None:
    conversion = si_conversion(unit, dimension)
    assert conversion.factor * value + conversion.offset == pytest.approx(si, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("unit", "dimension", "words"),
    [
        ("N", Dimension.LENGTH, ["'N'", "another dimension", "length", "m"]),
        ("mm", Dimension.FORCE, ["'mm'", "another dimension", "force", "N"]),
        ("degC", Dimension.LENGTH, ["another dimension", "length"]),
        ("smoots per fortnight?", Dimension.VELOCITY, ["not understood", "velocity"]),
        ("furl", Dimension.LENGTH, ["not known", "length"]),
        ("", Dimension.LENGTH, ["give the unit in the DBC"]),
        ("dB", Dimension.NUMBER, ["not linear"]),
        ("m**9", Dimension.LENGTH, ["not understood"]),
        ("9**9**9**9", Dimension.LENGTH, ["not understood"]),
        ("m" * 1000, Dimension.LENGTH, ["not understood"]),
    ],
)
def test_wrong_unit_is_named(unit: str, dimension: Dimension, words: list[str]) -> None:
    with pytest.raises(DatabaseError) as caught:
        si_conversion(unit, dimension)
    for word in words:
        assert word in str(caught.value)


PARTS = ["m", "s", "N", "k", "deg", "C", "dB", "%", "µ", "*", "/", "^", "**", "-1", "2", "(", ")"]


@given(
    unit=st.one_of(st.text(max_size=12), st.lists(st.sampled_from(PARTS), max_size=6).map("".join)),
    dimension=st.sampled_from(Dimension),
)
def test_any_text_is_a_unit_or_refused(unit: str, dimension: Dimension) -> None:
    try:
        conversion = si_conversion(unit, dimension)
    except DatabaseError:
        return
    assert conversion.factor != 0.0
