"""The model's height at the time of a measurement."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.observers.strut_sensors import Instant, model_height_m

MS = 1_000_000


@given(
    st.lists(st.floats(-5.0, 5.0), min_size=4, max_size=4),
    st.integers(0, 2 * MS),
    st.integers(1, 2 * MS),
)
def test_between_two_ticks_a_cubic_is_exact(coefficients, late_ns, step_ns):
    a, b, c, d = coefficients

    def at(t_ns):
        t = t_ns * 1e-6  # in ms, so that the terms are of one size
        height = a + b * t + c * t**2 + d * t**3
        return Instant(t_ns, [(height, 1e3 * (b + 2.0 * c * t + 3.0 * d * t**2))], ())

    instants = [at(3 * MS - number * step_ns) for number in range(3)]
    measured_ns = max(3 * MS - late_ns, instants[-1].t_ns)
    expected = at(measured_ns).struts[0][0]
    assert model_height_m(measured_ns, 0, instants) == pytest.approx(expected, abs=1e-9)


def test_before_the_oldest_tick_it_is_first_order():
    instants = [Instant(10 * MS, [(0.5, 2.0)], ()), Instant(9 * MS, [(0.4, 1.0)], ())]
    assert model_height_m(7 * MS, 0, instants) == pytest.approx(0.4 - 2e-3 * 1.0)
    assert model_height_m(10 * MS, 0, instants) == 0.5
