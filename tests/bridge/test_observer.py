"""The PI observer against its equations."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.observers.pi import PiObserver, PiState
from rig.observers.protocol import Innovation, Start
from tests.bridge.cores import GAINS, gains

BEGIN = Start(0, 0.1, 1_000_000)
START = PiState(0.0, 0.0, 0.0, 0, BEGIN)
MS = 1_000_000


def update(observer: PiObserver, state: PiState, innovation_m: float, t_ns: int) -> PiState:
    """State after a fresh measurement that is so far above the model's height of zero."""
    return observer.step(state, t_ns, Innovation(innovation_m, t_ns))


SMALL = st.floats(-1e-3, 1e-3)
ANY = st.floats(-1.0, 1.0)
SIZEABLE = st.integers(-1000, 1000).map(lambda number: number / 1024)


@given(innovations=st.lists(SMALL, min_size=1, max_size=50), period_ms=st.integers(1, 20))
def test_it_is_the_proportional_and_the_integral_of_the_innovation(innovations, period_ms):
    state = START
    for index, innovation in enumerate(innovations, start=1):
        state = update(GAINS, state, innovation, index * period_ms * MS)
    integral = math.fsum(innovation * period_ms * 1e-3 for innovation in innovations)
    assert state.integral_m_s == pytest.approx(integral, abs=1e-15)
    expected = 1e5 * innovations[-1] + 1e4 * integral
    assert state.virtual_force_n == pytest.approx(expected, abs=1e-9)
    assert state.innovation_m == innovations[-1]
    assert state.measured_ns == len(innovations) * period_ms * MS


@given(innovation=st.floats(1e-5, 1e-2), duration_ms=st.integers(1, 1000))
def test_a_constant_innovation_gives_the_closed_form(innovation, duration_ms):
    """F_v(t) = (K_P + K_I t) e, whatever the times of the measurements were."""
    state = START
    for t_ms in sorted({duration_ms // 3, duration_ms // 2, duration_ms} - {0}):
        state = update(GAINS, state, innovation, t_ms * MS)
    expected = (1e5 + 1e4 * duration_ms * 1e-3) * innovation
    assert state.virtual_force_n == pytest.approx(expected, rel=1e-12)


@given(innovations=st.lists(ANY, max_size=60))
def test_the_force_stays_within_its_limit(innovations):
    state = START
    for index, innovation in enumerate(innovations, start=1):
        state = update(GAINS, state, innovation, index * MS)
        assert abs(state.virtual_force_n) <= GAINS.force_limit_n


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_the_limit_the_integral_does_not_wind_up(sign):
    state = START
    for index in range(1, 5001):
        state = update(GAINS, state, sign * 0.2, index * MS)
    assert state.integral_m_s == 0.0
    # The force leaves its limit with the first measurement that no longer asks for it.
    state = update(GAINS, state, sign * 1e-3, 5001 * MS)
    assert state.virtual_force_n == pytest.approx(sign * 100.0, rel=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_the_limit_the_integral_may_still_unwind(sign):
    wound = PiState(sign * 0.6, 0.0, 0.0, 0, BEGIN)
    state = update(GAINS, wound, sign * -1e-3, MS)
    assert state.virtual_force_n == sign * GAINS.force_limit_n
    assert abs(state.integral_m_s) < 0.6


@given(innovation=SIZEABLE, integral=SIZEABLE, scale=st.sampled_from([0.5, 2.0, 4.0]))
def test_it_is_linear_within_the_limit(innovation, integral, scale):
    unlimited = gains(1e5, 1e4, 1e300)
    once = update(unlimited, PiState(integral, 0.0, 0.0, 0, BEGIN), innovation, MS)
    scaled = update(
        unlimited, PiState(scale * integral, 0.0, 0.0, 0, BEGIN), scale * innovation, MS
    )
    assert scaled.virtual_force_n == scale * once.virtual_force_n


def test_without_a_measurement_nothing_changes():
    state = update(GAINS, START, 1e-3, MS)
    assert GAINS.step(state, 2 * MS, None) is state


@given(integral=ANY, force=ANY)
def test_its_numbers_are_all_that_the_next_state_depends_on(integral, force):
    state = PiState(integral, 0.3, force, 0, BEGIN)
    again = GAINS.with_numbers(START, GAINS.numbers(state))
    after, expected = (update(GAINS, s, 1e-3, MS) for s in (again, state))
    assert after.integral_m_s == pytest.approx(expected.integral_m_s, rel=1e-12)
    assert after.virtual_force_n == pytest.approx(expected.virtual_force_n, rel=1e-12)
